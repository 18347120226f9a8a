"""Default settings of each task, by learner and platform, with the reasons for them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax

from hgail_envs import TASKS, GoalEnv
from hgail_envs.base import TrainingDefaults
from hgail_envs.validation import check_name
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners import CRL, LEARNERS, PPO, TD3
from hgail_jax.settings.methods import METHODS
from hgail_jax.settings.presets import (
    OBJECT_SUBSTEPS,
    PRESETS,
    Preset,
    contrastive,
    ppo_with_object,
    student,
    td3,
    wide,
)

EVALUATION_EPISODES = {"cpu": 128, "gpu": 512}
"""Least number of episodes per seed in a final evaluation, by platform."""

_REACH_SUBSTEPS = {"substeps": 4}
_LARGE_BUFFER: dict[str, Any] = {"buffer_episodes": 16384, "final_learning_rate": 0.1}

# Neither noise on target actions nor many random ones: where a hit or a grasp must be exact, the critics must
# distinguish such actions from those beside them (docs/lab/off-policy.md).
_EXACT: dict[str, Any] = {"target_noise": 0.0, "epsilon": 0.1}

# Sixteen rounds are enough on a CPU (grasp-hgail-cpu-8: .995, worst .975), with a BC weight of 1. On a GPU runs of
# 16 rounds leave a seed behind now and then (docs/lab/ppo.md, smaller trainings), so 40 stay.
_PPO_GRASP = {
    "cpu": ppo_with_object(num_envs=512, rounds=16, hidden=256, evaluate_every=2, bc_weight=1.0),
    "gpu": ppo_with_object(num_envs=1024, rounds=40, hidden=None, evaluate_every=1),
}


def _td3_grasp(**options: Any) -> dict[str, Preset]:
    """Returns the settings of the grasps with TD3, by platform.

    A goal is a place and whether the cube is held there. Negatives under goals that their own episode achieves later
    leave the place out of it: .88 to .95 after 589 k steps, .998 under the goals pursued, weighed twice
    (docs/adversary.md). On a CPU HER is ahead still.
    """
    sizes: dict[str, dict[str, Any]] = {"cpu": {"rounds": 12}, "gpu": {"num_envs": 256, "rounds": 8, **_LARGE_BUFFER}}
    method = {"cpu": "her", "gpu": "hgail"}
    return td3(sizes, OBJECT_SUBSTEPS | options, method, negative_p_ht=0.0, negative_weight=2.0, **_EXACT)


# Solved samples count in full: holding still at the goal is a skill here, and at .3 half the success is lost (study
# parts-pick-and-place).
_PPO_PICKING = {
    "cpu": ppo_with_object(num_envs=1024, rounds=26, hidden=256),
    "gpu": ppo_with_object(num_envs=1024, rounds=60, hidden=256),
}


def _stacking(epsilon: float = 0.2, **sizes: dict[str, Any]) -> dict[str, Preset]:
    """Returns the settings of stack and tower with TD3, by platform, as `sizes` are.

    Target networks that follow slowly decide stack: after 781 k steps two seeds had .22 at .02 and .85 at .01. A p_ht
    of .6 ends at .99, one of .8 at .95 (by HER). On a GPU stack's rounds are those after which each of four seeds
    had .99 by the adversary. The discriminator's learning rate falls as that of actor and critics does: the worst of
    sixteen stacks has .974 for .954 without, the mean .993 for .995; tower .945 (worst .925) for .930 (.857), with
    fewer random actions too (docs/adversary.md); two stacks on a CPU .98 and .92 for .97 and .86 (docs/off-policy.md).
    """
    falling = {"final_discriminator_learning_rate": 0.1}
    changes = {platform: _LARGE_BUFFER | falling | own for platform, own in sizes.items()}
    return td3(changes, OBJECT_SUBSTEPS, tau=0.01, p_ht=0.6, negative_p_ht=0.6, epsilon=epsilon)


def _td3_randomized(gpu_rounds: int, **options: Any) -> dict[str, Preset]:
    """Returns the settings with TD3 of a task whose episodes are randomised, by platform.

    Of pick and place with the goal test alone a p_ht of .6 has .87 under `full` where .8 has .82; with a quarter of the
    goal test it is behind that by .03 (docs/lab/robust.md, off-policy). On push nothing else was tried. The rounds on a
    GPU are what `full-known-delay` needs; under `other-arms` 18 are enough.
    """
    sizes = {"cpu": {"rounds": 36, **_LARGE_BUFFER}, "gpu": {"num_envs": 256, "rounds": gpu_rounds, **_LARGE_BUFFER}}
    return td3(sizes, OBJECT_SUBSTEPS | options, "her", **_EXACT | {"p_ht": 0.6})


SHARED: dict[str, dict[str, Preset]] = {
    # a task without contacts is learnt in few gradient steps, as the point is
    "td3": td3({"cpu": {"rounds": 6, "updates": 64}, "gpu": {"rounds": 4}}),
    "ppo": {"cpu": Preset(Config(PPO(), num_envs=64, rounds=6)), "gpu": Preset(Config(PPO(), num_envs=256, rounds=4))},
    "student": student(rounds=120),
}
"""Settings of tasks that have none here, by learner and platform; `GoalEnv.training` changes them."""

SHARED_WITH_SCENE = SHARED | {"td3": td3({"cpu": {"rounds": 10}, "gpu": {"rounds": 10}}, OBJECT_SUBSTEPS)}
"""The same of tasks that have a scene: TD3 with push's sizes, since there are things to be moved."""


DEFAULTS: dict[str, dict[str, dict[str, Preset]]] = {
    "point": {
        "ppo": SHARED["ppo"],
        "td3": td3({"cpu": {"rounds": 4, "updates": 64}, "gpu": {"rounds": 4}}),
    },
    "reach": {
        "ppo": {
            # On two cores each roll-out counts. With the BC loss beside PPO a third of them is enough, and batches of a
            # quarter learn as well (docs/reach.md: without BC one or two of eight seeds end below .98).
            "cpu": Preset(
                Config(
                    PPO(policy_phases=2, discriminator_phases=1, bc_batch=512, pretrain_policy_batch=128),
                    num_envs=64,
                    rounds=4,
                    discriminator_batch=128,
                ),
                Hyperparameters(bc_weight=3.0),
                task_options=_REACH_SUBSTEPS,
            ),
            "gpu": Preset(Config(PPO(), num_envs=256, rounds=4), task_options=_REACH_SUBSTEPS),
        },
        "td3": td3(
            {
                "cpu": {"num_envs": 16, "rounds": 8, "rollouts": 1, "updates": 128},
                "gpu": {"num_envs": 16, "rounds": 5, "rollouts": 1},
            },
            _REACH_SUBSTEPS,
            # with a CPU's sizes four seeds have .90 (.69) of it by the adversary, after 7,200 steps
            {"cpu": "her", "gpu": "hgail"},
            **_EXACT,
        ),
        "student": student(rounds=20),
    },
    # Off-policy a policy that sees the cube at each step learns in 400 k steps; with its place at the start alone it is
    # not quite learnt in 1.5 M (docs/lab/off-policy.md). PPO, the default, learns that.
    "grasp": {"ppo": _PPO_GRASP, "td3": _td3_grasp(cube="tracked"), "student": student(rounds=40)},
    "push": {
        "td3": td3({"cpu": {"rounds": 10}, "gpu": {"rounds": 8}}, OBJECT_SUBSTEPS),
        # Networks 256 wide reach .95 in 40 to 55 rounds where those 64 wide take 49 to 102 or never do (docs/lab/
        # ppo.md); their number on a CPU is from docs/lab/ppo.md. Solved samples, whose cube is at the goal
        # already, count .3 times: at full weight they take more than half of push's success (study parts-push), and at
        # .1 it is .85 for .93 (docs/lab/ppo.md, push).
        "ppo": {
            "cpu": ppo_with_object(num_envs=512, rounds=80, hidden=256, solved_weight=0.3),
            "gpu": ppo_with_object(num_envs=1024, rounds=120, hidden=256, solved_weight=0.3),
        },
        "student": student(rounds=40),  # a trial had .98 after 40 on a GPU
    },
    "pick-and-place": {
        # On a CPU exact critics, and target networks that follow slowly: one seed has 1.00 in the last three tests for
        # .94 to 1.00.
        "td3": td3({"cpu": {"rounds": 15}, "gpu": {"rounds": 12}}, OBJECT_SUBSTEPS, on_cpu=_EXACT | {"tau": 0.01}),
        "ppo": _PPO_PICKING,
        "student": student(rounds=80),  # a trial had 1.00 after 90
    },
    # Untried: PPO on tower, and on stack with other settings than pick and place's, by which it stacks nothing; tower
    # on a CPU, where its buffer has half as many episodes, each twice as long. Stack on a CPU with half the
    # environments and half the updates was at .89 after 30 rounds; tower on a GPU with half of both had .06 after 3.6 M
    # steps (docs/lab/off-policy.md).
    "stack": {
        "td3": _stacking(
            cpu={"num_envs": 128, "rounds": 26, "updates": 512, "discriminator_batch": 512, **wide(128, layers=3)},
            gpu={"rounds": 26},
        ),
        "ppo": _PPO_PICKING,
        "student": student(rounds=100),  # a trial had 1.00 after 100
    },
    "tower": {
        "td3": _stacking(
            epsilon=0.1,
            cpu={"rounds": 60, "buffer_episodes": 8192},
            gpu={"num_envs": 256, "rounds": 24, "updates": 1024},
        ),
        "ppo": _PPO_PICKING,
        "student": student(rounds=120),
    },
    "slide": {
        # Places that the puck only passes count as achieved: at rest alone fewer targets are hit. Batches of 2,048 and
        # solved samples at .3, most of which are of a puck that lies still, are ahead by .01 to .03 each. The puck
        # only has to come to rest within 5 cm: positives from all of that are ahead of those from half of it (.90 and
        # .86 after 3.5 M steps), and negatives under goals pursued in the same episode (.905 and .880).
        "td3": td3(
            {
                # one seed: three layers and as many environments as on a GPU end at .80, two layers and 64 environments
                # at .67 (docs/lab/off-policy.md, on two cores)
                "cpu": {"num_envs": 256, "rounds": 36, "updates": 512, **_LARGE_BUFFER, **wide(128, layers=3)},
                "gpu": {
                    "num_envs": 256,
                    "rounds": 34,
                    "rollouts": 10,
                    "batch": 2048,
                    "final_discriminator_learning_rate": 0.1,  # .912, worst .881, for .907 and .856 without
                    **_LARGE_BUFFER,
                },
            },
            OBJECT_SUBSTEPS | {"achieved": "passed"},
            goal_jitter=1.0,
            negative_p_ht=0.0,
            negative_weight=2.0,
            solved_weight=0.3,
            final_exploration_noise=0.1,
            **_EXACT,
        ),
        # The deviation shrinks from .2 to .2 × .075 = .015: a wide one finds the puck sooner, later noise in the hand's
        # speed is noise in where the puck stops (docs/lab/ppo.md, slide: trials that also
        # chose the BC weight of .03). 165 rounds: 190 are no better (.744 for .771). The learning
        # rate of 2e-3 was hardly ahead of 1e-3, .58 for .56.
        "ppo": dict.fromkeys(
            ("cpu", "gpu"),
            ppo_with_object(
                num_envs=1024,
                rounds=165,
                hidden=256,
                solved_weight=0.3,
                exploration_noise=0.2,
                final_exploration_noise=0.075,
                bc_weight=0.03,
                policy_learning_rate=2e-3,
            ),
        ),
        "student": student(rounds=80),
    },
}
"""Settings of each task that comes with the package, by learner and platform; the learner that stands first is the
task's default."""

RANDOMIZED: dict[str, dict[str, dict[str, Preset]]] = {
    "grasp": {"td3": _td3_randomized(24, cube="tracked")},
    "push": {"td3": _td3_randomized(30)},
    "pick-and-place": {"td3": _td3_randomized(36)},
}
"""Settings of tasks whose episodes are randomised, by learner and platform; the others keep those of `DEFAULTS`."""


def default_learner(task_class: type[GoalEnv]) -> str:
    """Returns the name of a task's default learner: the first in its settings, or TD3's where it has none.

    Raises:
      ValueError: the task's `training` names no learner.
    """
    name = _name(task_class)
    return next(iter(DEFAULTS[name] if name else _training(task_class)), TD3.name)


def has_own_settings(task_class: type[GoalEnv], learner: str, platform: str) -> bool:
    """Returns whether a task comes with settings for a learner on a platform; otherwise it uses the shared ones."""
    name = _name(task_class)
    return learner in DEFAULTS[name] if name else platform in _training(task_class).get(learner, {})


def platform_name() -> str:
    """Returns the kind of device that JAX runs on, as defaults distinguish platforms: `"cpu"` or `"gpu"`."""
    return "cpu" if jax.default_backend() == "cpu" else "gpu"


def task_preset(
    task_class: type[GoalEnv],
    platform: str,
    preset: str = "parallel",
    learner: str = PPO.name,
    randomized: bool = False,
) -> Preset:
    """Returns a preset with a task's own settings on a platform.

    Only `parallel` takes a task's own sizes and hyperparameters; another preset has its own for all tasks.

    Args:
      task_class: the task; one that is not in `DEFAULTS` has those of the class it extends, or `SHARED`
        (with a scene `SHARED_WITH_SCENE`) with the changes of its `training`.
      platform: `"cpu"` or `"gpu"`.
      preset: a name in `PRESETS`.
      learner: a name in `hgail_jax.LEARNERS`, or that of the student.
      randomized: whether episodes are randomised, for which some tasks have other settings of TD3.

    Raises:
      ValueError: there is no such preset, not for this learner, or the task's `training` names no fields or values.
    """
    check_name("preset", preset, PRESETS)
    if preset != "parallel" and learner != PPO.name:
        raise ValueError(f"the preset {preset} is of the learner {PPO.name}")
    if learner == CRL.name:
        usual_td3 = task_preset(task_class, platform, preset, TD3.name, randomized)
        return _changed(contrastive(usual_td3), task_class, learner, platform)
    name = _name(task_class)
    if name is None:
        shared = SHARED if task_class.scene is None else SHARED_WITH_SCENE
        own = _changed(shared[learner][platform], task_class, learner, platform)
    else:
        usual = DEFAULTS[name].get(learner, SHARED[learner])
        own = (RANDOMIZED.get(name, {}).get(learner, usual) if randomized else usual)[platform]
    if preset == "parallel":
        return own
    return dataclasses.replace(PRESETS[preset], task_options=own.task_options, evaluate_every=own.evaluate_every)


def _changed(shared: Preset, task_class: type[GoalEnv], learner: str, platform: str) -> Preset:
    """Returns shared settings with the changes that a task brings for a learner and a platform, if it brings any."""
    where = f"{task_class.__name__}.training"
    own = _training(task_class).get(learner, {})
    if platform not in own:
        return shared
    changes = own[platform]
    try:
        check_name("method", changes.method, METHODS)
        return Preset(
            shared.config.replace(**changes.config),
            shared.hyperparameters.replace(**changes.hyperparameters),
            changes.method,
            {**shared.task_options, **changes.options},
            changes.evaluate_every,
        )
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{where}[{learner!r}][{platform!r}] is not TrainingDefaults of fields that there are: {error}"
        ) from error


def _training(task_class: type[GoalEnv]) -> Mapping[str, Mapping[str, TrainingDefaults]]:
    for learner in task_class.training:
        check_name(f"learner in {task_class.__name__}.training", learner, LEARNERS)
    return task_class.training


def _name(task_class: type[GoalEnv]) -> str | None:
    """Returns the task of the package that a class is, or extends without its own `training`; else None."""
    names = {place: name for name, place in TASKS.items()}
    for base in task_class.__mro__:
        if (name := names.get(f"{base.__module__}:{base.__qualname__}")) in DEFAULTS:
            return name
        if "training" in vars(base):
            return None
    return None
