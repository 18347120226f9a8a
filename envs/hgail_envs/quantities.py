"""Describes the numbers that a task's policy reads and those that it commands."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from hgail_envs.layout import Layout, past
from hgail_envs.registry import check_options, find_class


class Description(NamedTuple):
    """The numbers that a policy of a task reads and commands, in their order."""

    features: Layout
    """Of the observation before the goal, with the past if it has one."""
    goal: Layout
    action: Layout
    """Each from -1 to 1."""

    @property
    def observation(self) -> Layout:
        """Of the whole observation."""
        return self.features + self.goal


def describe(
    task: str, history: int = 0, known_delay: int = 0, sizes: Sequence[int] = (), **options: Any
) -> Description:
    """Describes the numbers of a task with its options, as its class declares them.

    `task` is a name in `hgail_envs.TASKS`, or `"module:Class"`; see `Randomization` for `history` and `known_delay`.
    With `sizes`, of features without history, goal and action, the class is not imported, since it may be of an
    untrusted file's choice, and the numbers are numbered.

    Raises:
      ValueError: no such task or option, or an option has an unknown value.

    >>> describe("reach").features.numbers[3].name
    'gripper velocity x'
    >>> describe("reach", history=1).features.numbers[0].title
    'gripper displacement x, 1 step earlier'
    """
    if sizes:
        features, goal, action = map(Layout.numbered, ("feature", "goal", "action"), sizes)
    else:
        check_options(task, options)
        of_class = find_class(task)
        goal, action = of_class.goal_layout, of_class.action_layout
        features = of_class.seen_layout or of_class.features_with(**options)
    return Description(past(features, action, history, known_delay) + features, goal, action)
