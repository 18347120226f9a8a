"""The part that tasks around another task have in common."""

from typing import Any

from hgail_envs.base import GoalEnv

_SAME = (
    *("goal_size", "goal_layout", "action_size", "action_layout"),
    *("episode_length", "success_threshold", "goal_kinds", "lift_test_steps"),
    *("observation_limit", "control_period", "scene", "robot", "instruction", "target_body", "shows_goal"),
    *("reference", "training"),
)


class Wrapper(GoalEnv):
    """A task around another one, `task`, whose goals, actions and episodes it has; `others` are more that it has."""

    action_size = 0  # brax.Env declares it a property, which an instance could not set

    def __init__(self, task: GoalEnv, others: tuple[str, ...] = ()) -> None:
        self.task = task
        for name in (*_SAME, *others):
            setattr(self, name, getattr(task, name))

    @property
    def max_worlds(self) -> int | None:  # type: ignore[override]
        """Environments that the physics of `task` can step at once; None is any number."""
        return self.task.max_worlds

    def __getattr__(self, name: str) -> Any:
        if name not in ("impl", "substeps"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.task, name)  # not copied when it is made: a task may start JAX to find its engine
