"""Makes a task from its name."""

import contextlib
import importlib
import inspect
from collections.abc import Iterable
from typing import Any

from hgail_envs.base import GoalEnv

_ROWS = {  # class, imported when it is made, and the steps of an episode, which Gymnasium must know before
    "point": ("hgail_envs.point:Point", 50),
    "reach": ("hgail_envs.tasks.reach:Reach", 50),
    "grasp": ("hgail_envs.tasks.grasp:Grasp", 50),
    "push": ("hgail_envs.tasks.push:Push", 50),
    "pick-and-place": ("hgail_envs.tasks.pick_and_place:PickAndPlace", 50),
    "slide": ("hgail_envs.tasks.slide:Slide", 50),
    "stack": ("hgail_envs.tasks.stack:Stack", 100),
    "tower": ("hgail_envs.tasks.tower:Tower", 200),
}

TASKS = {task: place for task, (place, _) in _ROWS.items()}
"""Names of the tasks that come with the package, and their classes."""

GYMNASIUM_IDS = {
    task: f"hgail_envs/{'' if task == 'point' else 'Fetch'}{task.title().replace('-And-', 'And').replace('-', '')}-v0"
    for task in TASKS
}
"""Gymnasium's identifiers of the tasks, e.g. `hgail_envs/FetchPush-v0`."""


def register_gymnasium() -> None:
    """Registers `GYMNASIUM_IDS` for `gymnasium.make` and `gymnasium.make_vec`, if Gymnasium is installed."""
    with contextlib.suppress(ImportError):
        import gymnasium

        for task, (_, steps) in _ROWS.items():
            name = GYMNASIUM_IDS[task]
            if name not in gymnasium.registry:
                gymnasium.register(
                    name,
                    "hgail_envs.single:GoalSingleEnv",
                    vector_entry_point="hgail_envs.vector:make_vector",
                    max_episode_steps=steps,
                    kwargs={"task": task},
                )


def make(task: str, **options: Any) -> GoalEnv:
    """Makes a task.

    `task` is a name in `TASKS`, or `"module:Class"` for a user's task; the options are passed to the class, e.g. `impl`
    and `substeps` of the Fetch tasks.

    Raises:
      ValueError: no such task, or the task has no such option or refuses its value.

    >>> make("point").observation_size
    6
    >>> make("poke")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: unknown task 'poke'; choose from point, reach, grasp, ...
    """
    check_options(task, options)
    return find_class(task)(**options)


def check_options(task: str, options: Iterable[str]) -> None:
    """Refuses options, by name, that a task does not take."""
    allowed = accepted_options(task)
    for option in options:
        if option not in allowed:
            raise ValueError(f"task {task!r} has no option {option!r}; it takes {', '.join(allowed) or 'none'}")


def accepted_options(task: str) -> tuple[str, ...]:
    """Returns the names of the options that a task's class takes, e.g. `impl`, `substeps` and `worlds`; see `make`.

    A constructor with `**kwargs` takes those of the next base class, too.
    """
    names: list[str] = []
    for base in find_class(task).__mro__:
        parameters = inspect.signature(vars(base)["__init__"]).parameters if "__init__" in vars(base) else {}
        named = [name for name, one in parameters.items() if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
        names = named[1:] + [name for name in names if name not in named]  # the first is self
        if parameters and not any(one.kind == one.VAR_KEYWORD for one in parameters.values()):
            break
    return tuple(names)


def check_takes_robot(task: str) -> None:
    """Raises a ValueError if a task is none of an arm, and so has no choice of its robot."""
    if "robot" not in accepted_options(task):
        raise ValueError(f"--robot is for the tasks of an arm; {task!r} is none")


def find_class(task: str) -> type[GoalEnv]:
    """Returns the class of a task; see `make`."""
    if not isinstance(task, str):
        raise ValueError(f"task is {task!r}; it must be a name, one of {', '.join(TASKS)}, or 'module:Class'")
    module, separator, name = TASKS.get(task, task).partition(":")
    names = f"choose from {', '.join(TASKS)}, or name a GoalEnv of your own as 'module:Class'"
    if not (module and separator and name):
        raise ValueError(f"unknown task {task!r}; {names}")
    try:
        task_class = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"cannot load task {task!r}: {error}; {names}") from error
    if not (inspect.isclass(task_class) and issubclass(task_class, GoalEnv)):
        raise ValueError(f"task {task!r} is not a GoalEnv; {names}")
    return task_class
