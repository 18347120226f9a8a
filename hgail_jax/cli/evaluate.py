"""Measures the success of trained policies on their task, with its 95 % interval, and how near they come."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import hgail_envs
from hgail_envs.base import EpisodeMetrics
from hgail_envs.engines import ENGINES
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.registry import check_takes_robot
from hgail_envs.tasks.reference import ReferenceFetch, reference_episode
from hgail_envs.validation import check_name, counted
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.reference_pictures import ReferencePictures
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.cli.policies import PolicyOptions, describe_policy, find_policies, find_task, make_task, randomization
from hgail_jax.io.files import from_here
from hgail_jax.io.policy import AnyPolicy
from hgail_jax.io.provenance import installed
from hgail_jax.play.evaluation import Evaluation
from hgail_jax.terminal import StatusLine
from hgail_jax.trainer.statistics import confidence_interval, success_interval
from hgail_jax.trainer.train_options import unless_given
from hgail_jax.vision.policy import CameraPolicy

PROGRAM = "hgail evaluate"
Measure = Callable[[], EpisodeMetrics]
"""Returns the means over a policy's episodes."""
Where = dict[str, str]
"""The engine or the reference's environment, and of a policy of pictures the look of the scene and the renderer."""
Act = Callable[[np.ndarray], np.ndarray]
"""An observation, `[observation_size]`, to an action, `[4]`."""


@dataclasses.dataclass(frozen=True)
class Options(PolicyOptions):
    """Measures the success of trained policies, with its 95 % interval: Wilson's, or of several seeds Student's."""

    episodes: int = 200
    """Episodes of each policy; from 513 on rounded up to whole roll-outs."""
    impl: Annotated[str | None, unless_given("auto", "|".join(["auto", *ENGINES]))] = None
    """Physics engine of the Fetch tasks, always with the reference's 20 steps per action."""
    reference: bool = False
    """Run with the maker's full model of an arm instead, or for the Fetch in Gymnasium-Robotics (extra `compare`), one
    episode after another; there a policy of pictures sees that scene, through cameras like its own."""
    json: bool = False
    """Print a JSON object instead of text."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    try:
        _check(options)
        task = find_task(options.task, options.policy)
        policies = find_policies(task, options.policy, options.randomize)
        found = [policy for _, policy in policies]
        on_the_fetch = options.reference and _robot(task, options, found) == "fetch"
        where, episodes, measures = (_reference if on_the_fetch else _simulation)(task, options, found)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    rows = []
    try:
        with StatusLine(f"compiling and running {counted(options.episodes, 'episode')} of {task}"):
            for (path, _), measure in zip(policies, measures, strict=True):
                rows.append(_row(path, measure(), episodes))
    except OverflowError as error:
        fail(PROGRAM, error, 1)
    if options.json:
        print(json.dumps(_report(task, where, options, policies[0][1], rows), indent=2))
        return
    for (path, policy), row in zip(policies, rows, strict=True):
        level = "none" if options.reference else options.randomize
        described = describe_policy(path, policy, level, options.robot)
        print(", ".join([described, *(f"{name} {value}" for name, value in where.items())]))
        print(_text(row))
    if len(rows) > 1:
        mean = _mean(rows)
        over = ", interval over seeds" if "low" in mean else ""
        print(f"mean of {len(rows)} seeds: success {_interval(mean)}{over}")


def _check(options: Options) -> None:
    options.check(options.episodes)
    if options.impl is not None:
        check_name("impl", options.impl, ["auto", *ENGINES])
    if options.reference and (options.impl or options.randomize not in (None, "none")):
        raise ValueError("the reference is one engine, not randomised; leave out --impl and --randomize")


def _robot(task: str, options: Options, policies: list[AnyPolicy]) -> str:
    """Returns the robot that policies are evaluated on, which must be the same for all."""
    if options.robot is not None:
        check_takes_robot(task)
        return options.robot
    robots = {str(policy.task_options.get("robot", "fetch")) for policy in policies}
    if len(robots) > 1:
        raise ValueError(f"policies of {', '.join(sorted(robots))} have no reference in common; name one by --robot")
    return robots.pop()


def _simulation(task: str, options: Options, policies: list[AnyPolicy]) -> tuple[Where, int, list[Measure]]:
    """Returns where it is, the number of episodes, and functions that measure the policies in the task here."""
    if options.impl and "impl" not in hgail_envs.accepted_options(task):
        raise ValueError(f"task {task!r} has no engines to choose from; leave out --impl")
    evaluations: dict[str, Evaluation] = {}
    measures: list[Measure] = []
    for policy in policies:
        trained = repr((policy.task_options, policy.randomization, _sees(policy)))
        if trained not in evaluations:
            level, impl = ("none", "reference") if options.reference else (options.randomize, options.impl)
            env = make_task(policy, task, level, impl=impl, robot=options.robot)
            evaluations[trained] = Evaluation(env, options.seed, options.episodes)
        measures.append(functools.partial(evaluations[trained], policy))
    where = {"engine": getattr(env, "impl", "JAX")}
    if isinstance(env, CameraEnv):
        where |= {"look": env.pictures.look, "renderer": env.pictures.renderer}
    return where, evaluations[trained].episodes, measures


def _sees(policy: AnyPolicy) -> Any:
    """Returns what decides the task that a policy is evaluated in, beside its options."""
    if isinstance(policy, CameraPolicy):
        return policy.cameras, policy.size, policy.target, policy.kind
    return policy.observation_size


def _reference(task: str, options: Options, policies: list[AnyPolicy]) -> tuple[Where, int, list[Measure]]:
    """Returns where it is, the number of episodes, and functions that measure the policies in it."""
    measures: list[Measure] = []
    for policy in policies:
        env = make_task(policy, task, "none")  # refuses a policy that does not fit
        observed = {name: value for name, value in policy.task_options.items() if name in ("observation", "cube")}
        try:
            reference = ReferenceFetch(task, **observed)
        except ModuleNotFoundError as error:
            raise ValueError(f"--reference needs the package {error.name}: pip install 'hgail-jax[compare]'") from None
        act = _seeing(reference, env, policy) if isinstance(policy, CameraPolicy) else policy
        measures.append(functools.partial(_run_in_reference, reference, act, policy.randomization, options))
    where = {"engine": str(hgail_envs.find_class(task).reference)}
    if isinstance(policy, CameraPolicy):
        where |= {"look": "the reference's", "renderer": "opengl"}
    return where, options.episodes, measures


def _seeing(reference: ReferenceFetch, env: hgail_envs.GoalEnv, policy: CameraPolicy) -> Act:
    """Returns a policy that sees the reference's pictures as a function of an observation."""
    assert isinstance(env, CameraEnv)  # by `make_task`
    see = ReferencePictures(reference, env.task, policy.cameras, policy.size, env.pictures.marker, policy.kind)
    return lambda observation: policy(see(), observation[env.known])


def _run_in_reference(reference: ReferenceFetch, act: Act, trained: Randomization, options: Options) -> EpisodeMetrics:
    ends = [reference_episode(reference, act, Past(trained), options.seed, index) for index in range(options.episodes)]
    names = [field.name for field in dataclasses.fields(EpisodeMetrics)]
    return EpisodeMetrics(**{name: float(np.mean([getattr(end, name) for end in ends])) for name in names})


def _row(path: Path, outcome: EpisodeMetrics, episodes: int) -> dict[str, Any]:
    rates = {
        name: round(getattr(outcome, name) * episodes) / episodes for name in ("success", "achieved", "success_l1")
    }
    success = success_interval(rates["success"], episodes)
    distances = {name: getattr(outcome, name) for name in ("distance_l1", "distance_l2")}
    return {
        "policy": str(from_here(path)),
        "episodes": episodes,
        **rates,
        **{"low": success.low, "high": success.high},
        # where the simulation of every episode broke down there is none
        **{name: value if np.isfinite(value) else None for name, value in distances.items()},
    }


def _mean(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Returns the mean success of several seeds and, from three on, its interval by Student's t."""
    success = np.array([row["success"] for row in rows])
    mean, half = float(success.mean()), float(confidence_interval(success))
    return {"success": mean} | ({"low": max(mean - half, 0.0), "high": min(mean + half, 1.0)} if half >= 0 else {})


def _report(task: str, where: Where, options: Options, policy: AnyPolicy, rows: list[dict[str, Any]]) -> dict[str, Any]:
    sizes = randomization(policy, "none" if options.reference else options.randomize)
    return {
        "task": task,
        **where,
        "seed": options.seed,
        "randomization": dataclasses.asdict(sizes),
        "policies": rows,
        **({"mean": _mean(rows)} if len(rows) > 1 else {}),
        "versions": installed("hgail-jax", "jax", "mujoco", "gymnasium-robotics"),
    }


def _text(row: dict[str, Any]) -> str:
    success = f"success {_interval(row)} in {counted(row['episodes'], 'episode')}"
    if row["distance_l1"] is None:
        return success
    return f"{success}; L1 distance {row['distance_l1']:.4f} m, Euclidean {row['distance_l2']:.4f} m"


def _interval(row: dict[str, Any]) -> str:
    bounds = f" [{row['low']:.3f}, {row['high']:.3f}]" if "low" in row else ""
    return f"{row['success']:.3f}{bounds}"
