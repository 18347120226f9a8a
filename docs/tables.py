"""Tables of README and pages, of results and of layouts; `python -m docs.tables` writes them with cog.

A page has such a table between two comments, the first of which calls one of the functions below by name:

    <!-- [[[cog show(suite) ]]] -->
    <!-- [[[end]]] -->
"""

import dataclasses
import functools
import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from cogapp import Cog

from experiments.paper.markdown import plus_minus, table
from hgail_envs.quantities import describe
from hgail_envs.randomization import LEVELS, Randomization

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "experiments" / "results"
_WITH_TABLES = ("index", "adversary", "camera", "suite", "off-policy", "robust", "tasks", "transfer")
PAGES = ("README.md", *(f"docs/{page}.md" for page in _WITH_TABLES))
"""Pages with tables."""

Row = dict[str, Any]

_HEADLINE = (  # a run, its task's name, the run by HER, and the methods whose figures stand beside it
    ("reach-hgail", "reach", None, ("the paper",)),
    ("grasp-hgail", "grasp, with a lift test", None, ("the paper",)),
    ("grasp-td3", "grasp, the cube seen at each step", "grasp-td3-her", ()),
    ("push-td3", "push", "push-td3-her", ("RHER", "DDPG + HER")),
    ("pick-and-place-td3", "pick and place", "pick-and-place-td3-her", ("RHER", "DDPG + HER")),
    ("slide-td3", "slide", "slide-td3-her", ("TQC + HER",)),
    ("stack-td3", "put a cube on another, and let go", "stack-td3-her", ()),
    ("tower-td3", "put three cubes on one another, in a given order", "tower-td3-her", ()),
)
_SUITE = ("reach-hgail", "grasp-hgail", "push-td3", "pick-and-place-td3", "slide-td3")
_WITH_HER = ("push", "pick-and-place", "grasp", "slide", "stack", "tower")
_OFF_POLICY = (
    "reach-td3",
    *(f"{task}-td3{method}" for task in _WITH_HER for method in ("", "-her")),
    *(f"{task}-hgail" for task in ("reach", "push", "pick-and-place", "slide", "grasp")),
)
_CPU = (
    *(f"{task}-td3-cpu" for task in ("push", "pick-and-place", "grasp", "slide")),
    *("stack-td3-cpu", *(f"stack-td3-cpu-{seed}" for seed in (1, 2, 3)), "grasp-hgail-cpu"),
)
_BESIDE_PUBLISHED = (  # a run, and the success looked for, or None for how it ended
    *((run, "0.95") for run in ("push-td3", "push-hgail", "pick-and-place-td3", "pick-and-place-hgail")),
    *(("slide-td3", "0.80"), ("slide-td3", None), ("slide-hgail", None)),
)
_CAMERA = (
    *("push-camera", "pick-and-place-camera", "stack-camera", "grasp-camera"),
    *("push-depth-camera", "pick-and-place-depth-camera", "push-wide-camera", "pick-and-place-wide-camera"),
)
_RANDOMISED = ("-robust", "-other-arms", "-known-delay")
_POLICIES = {"other arms": "under `other-arms`", "known delay": "known delay", "robust": "robust policy"}


def show(rows: Callable[[], list[list[str]]]) -> None:
    """Prints a table, of which `rows` returns the header and the rows, where a page is made by cog."""
    import cog  # exists while cog runs

    header, *body = rows()
    cog.out("\n" + table(header, body).replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}") + "\n\n")


def observation(task: str) -> Callable[[], list[list[str]]]:
    """Returns the table of the numbers that a policy of a task reads, by default options."""
    described = describe(task)
    rows, first, features = [["index", "quantity", "unit", "frame"]], 0, described.features.size
    for quantity in described.observation:
        place, last = f"{first}", first + quantity.size
        of_goal = f"{first - features}"
        if quantity.size > 1:
            place, of_goal = f"{place}:{last}", f"{of_goal}:{last - features}"
        index = place if first < features else f"{place}, the goal's {of_goal}"
        rows.append([index, quantity.name, quantity.unit, quantity.frame])
        first = last
    return lambda: rows


def headline() -> list[list[str]]:
    """Figures of the front page, the unflattering ones too."""
    sizes = _study("ablations", "reach", setting="the paper's sizes", panel="with pre-training")
    success = plus_minus(float(np.mean(sizes["success"])), sizes["success_ci95"])
    ends = ["never", _count(sizes["env_steps_per_seed"]), "", "", _elsewhere("reach", "the paper")]
    header = ["task", "learner", "success without reward", "worst seed", "steps to .95", "steps in all", "training"]
    return [
        [*header, "HER: success, steps to .95", "elsewhere"],
        *(_headline(_run(run), name, _run(her) if her else None, beside) for run, name, her, beside in _HEADLINE),
        ["reach with the paper's own sizes", "PPO", success, f"{min(sizes['success']):.3f}", *ends],
    ]


def _headline(run: Row, name: str, her: Row | None, beside: Iterable[str]) -> list[str]:
    elsewhere = "; ".join(_elsewhere(run["task"], what) for what in beside)
    figures = [name, run["learner"].upper(), _success(run), f"{run['worst']:.3f}", *_steps(run)]
    return [*figures, _seconds(run["seconds"]["train"]), _beside(her), elsewhere]


def _beside(her: Row | None) -> str:
    """Returns success and steps to .95 of a run by HER."""
    return f"{her['success']['mean']:.3f}, {_steps(her)[0]}" if her else ""


def _elsewhere(task: str, what: str) -> str:
    if what == "the paper":
        rate = _study("table1", task, setting="HGAIL")["paper_success"]  # ".98 ± .02"
        return re.sub(r"(?<!\d)\.", "0.", rate) + f", {what}"
    row = _pick(_read("published")["rows"], task=task, what=what)
    return f"{row['success']} after {row['env_steps']}, {what}"


def suite() -> list[list[str]]:
    """Eight seeds of each task of the Fetch suite, by the task's default learner."""
    header = ["task", "method", "learner", "reward", "success", "worst seed", "L1 distance", "env steps", "training"]
    return [[*header, "whole run"], *map(_suite, map(_run, _SUITE))]


def _suite(run: Row) -> list[str]:
    sizes = [f"{run['worst']:.3f}", f"{run['distance_l1']:.3f} m", _count(run["env_steps"])]
    return [run["task"], *_trained_by(run), _success(run), *sizes, *_times(run)]


def off_policy() -> list[list[str]]:
    """Eight seeds of each task by either learner."""
    header = ["task", "method", "learner", "reward", "success", "worst seed", "steps to .95", "all steps", "training"]
    return [[*header, "whole run", "MuJoCo"], *map(_off_policy, map(_run, _OFF_POLICY))]


def _off_policy(run: Row) -> list[str]:
    sizes = [f"{run['worst']:.3f}", *_steps(run), *_times(run), _mujoco(run)]
    return [run["task"], *_trained_by(run), _success(run), *sizes]


def adversary() -> list[list[str]]:
    """Eight seeds of the tasks with an object, by the discriminator's reward alone and by the goal test alone."""
    header = ["task", "no reward", "worst seed", "steps to .95", "HER", "worst seed", "steps to .95", "all steps"]
    return [header, *(_adversary(_run(f"{task}-td3"), _run(f"{task}-td3-her")) for task in _WITH_HER)]


def _adversary(run: Row, her: Row) -> list[str]:
    figures = [part for each in (run, her) for part in (_success(each), f"{each['worst']:.3f}", _steps(each)[0])]
    return [run["task"], *figures, _steps(run)[1]]


def on_a_cpu() -> list[list[str]]:
    """One seed of each task with a CPU's sizes."""
    header = ["task", "method", "learner", "seed", "success", "all steps", "whole run", "cores", "MuJoCo"]
    return [header, *map(_on_a_cpu, map(_run, _CPU))]


def _on_a_cpu(run: Row) -> list[str]:
    (seed,) = run["seeds"]
    figures = [f"{seed}", f"{run['success']['mean']:.3f}", _count(run["env_steps"]), _seconds(run["seconds"]["total"])]
    return [run["task"], *_trained_by(run)[:2], *figures, f"{run['cpu_cores']}", _mujoco(run)]


def camera() -> list[list[str]]:
    """Eight seeds of policies that see pictures."""
    header = [
        "task",
        "pictures",
        "look",
        "success",
        "worst seed",
        "steps to .95",
        "all steps",
        "training of eight seeds",
        "whole run",
    ]
    return [header, *(_camera(_run(name)) for name in _CAMERA)]


def _camera(run: Row) -> list[str]:
    shown = [run["task"], run["kind"], f"`{run['look']}`"]
    return [*shown, _success(run), f"{run['worst']:.3f}", *_steps(run), *_times(run)]


def robust() -> list[list[str]]:
    """Success of randomised trainings on the Fetch, under their level and undisturbed."""
    header = ["task", "method", "learner", "level", "success under it", "undisturbed", "worst seed, undisturbed"]
    runs = sorted((run for run in _read("runs") if run["name"].endswith(_RANDOMISED)), key=lambda run: run["name"])
    return [[*header, "plain policies, undisturbed", "env steps", "start to end", "MuJoCo"], *map(_robust, runs)]


def _robust(run: Row) -> list[str]:
    plain = _run(next(run["name"].removesuffix(end) for end in _RANDOMISED if run["name"].endswith(end)))
    nominal = run["nominal_success"]
    rates = [run["success"]["mean"], nominal["mean"], min(nominal["per_seed"]), plain["success"]["mean"]]
    ends = [_count(run["env_steps"]), _seconds(run["seconds"]["total"]), _mujoco(run)]
    return [run["task"], *_trained_by(run)[:2], f"`{run['level']}`", *(f"{rate:.3f}" for rate in rates), *ends]


def levels() -> list[list[str]]:
    """Sizes of the named randomisation levels, without those that only show the policy more."""
    named = {name: sizes for name, sizes in LEVELS.items() if not (sizes.history or sizes.known_delay)}
    del named["none"]
    units = {"delay": "steps", "z_bias": "of a displacement", "hand_opening": "of the widest", "ramp": "of the rounds"}
    rows = []
    for field in dataclasses.fields(Randomization):
        values = [getattr(sizes, field.name) for sizes in named.values()]
        unit = units.get(field.name, "times" if isinstance(values[0], tuple) else "m")
        texts = [" to ".join(f"{number:g}" for number in np.atleast_1d(value)) for value in values]
        texts = ["–" if value == field.default else text for value, text in zip(values, texts, strict=True)]
        rows.append([f"`{field.name}`", unit, *texts])
    hidden = ("`history`", "`known_delay`")
    return [["size", "unit", *named], *(row for row in rows if row[0] not in hidden)]


def robots() -> list[list[str]]:
    """Table 4 with the simulator's goal: policies run unchanged on other robots."""
    rows = {(*_situation(row), row["policy"]): row for row in _read("table4")["rows"] if row["stage"] == "exact goal"}
    situations = [(*situation,) for *situation, policy in rows if policy == "plain"]
    policies = ("plain", *_POLICIES, "script")
    header = ["robot", "task", "hand at the start, action", "plain policies", *_POLICIES.values(), "script"]
    return [
        header,
        *([*each, *(_with_interval(rows.get((*each, policy))) for policy in policies)] for each in situations),
    ]


def _situation(row: Row) -> list[str]:
    robot = row["robot"].removesuffix(" on C MuJoCo").removesuffix(", C MuJoCo")
    return [robot, row["task"], f"{row['hand_at_start']}, {row['milliseconds_per_action']:.0f} ms"]


def _with_interval(row: Row | None) -> str:
    return "–" if row is None else "{success_rate:.3f} ({success_low:.2f} to {success_high:.2f})".format(**row)


def published() -> list[list[str]]:
    """Success over environment steps and over time, here and as others published it."""
    columns = ("task", "what", "success", "env_steps", "time", "source")
    rows = [*_read("published")["rows"], *(_ours(_run(name), least) for name, least in _BESIDE_PUBLISHED)]
    rows.sort(key=lambda row: ("push", "pick-and-place", "slide").index(row["task"]))
    header = ["task", "what", "success", "env steps per seed", "time", "source"]
    return [header, *([row[name] for name in columns] for row in rows)]


def _ours(run: Row, least: str | None) -> Row:
    """Returns when the mean of a run's seeds reached a success, or how the run ended where `least` is None."""
    end = {"env_steps": run["env_steps"], "seconds": run["seconds"]["train"]}
    there = end if least is None else run["reached"][least]
    method, learner, _ = _trained_by(run)
    gpu = run["device"]["kind"].split()[1]
    return {
        "task": run["task"],
        "what": f"{method} with {learner}, here",
        "success": f"{run['success']['mean']:.2f}" if least is None else least,
        "env_steps": _rate(there["env_steps"]),
        "time": f"{_seconds(there['seconds'])} for eight seeds on one {gpu}",
        "source": "",
    }


@functools.cache
def _read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text())


def _pick(rows: Iterable[Row], **wanted: Any) -> Row:
    (row,) = [row for row in rows if wanted.items() <= row.items()]
    return row


def _run(name: str) -> Row:
    return _pick(_read("runs"), name=name)


def _study(study: str, task: str, **wanted: str) -> Row:
    return _pick(_read("studies")["rows"], study=study, task=task, **wanted)


def _trained_by(run: Row) -> list[str]:
    """Returns a run's method and learner, and the reward of the environment that its policy sees."""
    weight = run["environment_reward"]
    reward = "goal test alone" if weight == 1.0 else f"goal test × {weight:.2f}" if weight else "none"
    return [run["method"].upper(), run["learner"].upper(), reward]


def _success(run: Row) -> str:
    return plus_minus(run["success"]["mean"], run["success_ci95"])


def _steps(run: Row) -> list[str]:
    """Returns the steps after which the mean of the seeds was first at .95, and all steps."""
    reached = run["reached"]["0.95"]
    return [_count(reached["env_steps"]) if reached else "never", _count(run["env_steps"])]


def _times(run: Row) -> list[str]:
    return [_seconds(run["seconds"][part]) for part in ("train", "total")]


def _mujoco(run: Row) -> str:
    """Returns the version of MuJoCo that a run was made with, without its last number."""
    return run["versions"]["mujoco"].rpartition(".")[0]


def _rate(value: float) -> str:
    value, suffix = (value / 1e6, "M") if value >= 1e6 else (value / 1e3, "k")
    return f"{value:.{0 if value >= 99.95 else 1 if value >= 9.995 else 2}f} {suffix}"


def _count(value: float) -> str:
    return f"{round(value):,}"


def _seconds(value: float) -> str:
    return f"{value:.{1 if value < 9.95 else 0}f} s"


def main(options: Iterable[str] = ("-r",)) -> int:
    """Writes the tables into the pages, or with other `options` does what cog then does; returns cog's exit status."""
    prologue = ["-I", str(ROOT), "-p", "from docs.tables import *"]
    return Cog().main(["cog", *options, *prologue, *(str(ROOT / page) for page in PAGES)])


if __name__ == "__main__":
    sys.exit(main())
