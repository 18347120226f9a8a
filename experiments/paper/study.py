"""Study: the settings that a table or figure compares, and the seeds they are trained with."""

import dataclasses
from typing import Any

from hgail_jax.seeds import check_seeds

PAPER_DEMONSTRATIONS = 20
"""Demonstrations of GAIL-demo; the paper does not say how many it has."""
MOST_DEMONSTRATIONS = 100
"""The most that a setting has; they are recorded together, and the first of them are the smaller sets."""
PART_STEPS = {"pick-and-place": 1 / 2, "push": 1 / 3, "slide": 1 / 5}
"""Environment steps of studies of PPO with an object, as multiples of the task's own: 8 to 10 million."""
REPORTED_SEEDS = range(0, 8)
"""Seeds of the tables and figures. Settings are chosen by the results of others, from 1000 on."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One line of a figure and row of a table."""

    name: str
    panel: str = ""
    """Row of the figure that has the line."""
    method: str | None = None
    """Name of the method; None is the task's default."""
    learner: str = "ppo"
    config: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Changes to the method's config."""
    hyperparameters: dict[str, Any] = dataclasses.field(default_factory=dict)
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Further options of the task's class, e.g. `observation`."""
    steps: float | dict[str, float] = 1
    """Environment steps, as a multiple of HGAIL's default; a dict has it by task, and 1 for the others."""
    preset: str = "parallel"
    demonstrations: int = 0
    paper: dict[str, tuple[str, str]] = dataclasses.field(default_factory=dict)
    """The paper's success rate and L1 distance (m), by task."""

    def steps_on(self, task: str) -> float:
        """Returns the multiple of steps on a task."""
        return self.steps.get(task, 1) if isinstance(self.steps, dict) else self.steps

    @property
    def label(self) -> str:
        """Name and panel, unique within a study."""
        return ", ".join(filter(None, (self.name, self.panel)))


@dataclasses.dataclass(frozen=True)
class Study:
    """Settings trained for a table, a figure, or both."""

    name: str
    """Name, also of its files `<name>-<task>.json` and `.md`."""
    title: str
    settings: tuple[Setting, ...]
    table: int | None = None
    """The paper's number, which several studies may have."""
    figure: int | None = None
    """The paper's number, or that of the methods by TD3."""
    curves: bool = False
    """Whether its results have the learning curves; those of a study with a figure always do."""
    reference: str = ""
    """Name of the setting that the others are compared with; by default the first."""

    def compared_with(self, setting: Setting) -> Setting | None:
        """Returns the setting to compare with: the reference of the same panel, else the first of that name.

        None for the reference itself.
        """
        name = self.reference or self.settings[0].name
        named = [other for other in self.settings if other.name == name]
        found = next((other for other in named if other.panel == setting.panel), named[0])
        return None if found.label == setting.label else found


def choose_seeds(count: int | None = None) -> range:
    """Returns the first `count` seeds from 0 on, or those of the tables; a ValueError if `count` is below 1.

    >>> choose_seeds(), choose_seeds(2)
    (range(0, 8), range(0, 2))
    """
    if count is None:
        return REPORTED_SEEDS
    check_seeds(REPORTED_SEEDS.start, count)
    return range(count)
