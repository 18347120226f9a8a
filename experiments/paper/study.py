"""What a study is: settings that one table or figure compares, and the seeds that it is trained with."""

import dataclasses
from typing import Any

from hgail_jax.seeds import check_seeds

PAPER_DEMONSTRATIONS = 20
"""Demonstrations of GAIL-demo; the paper does not say how many it has."""
REPORTED_SEEDS = range(0, 8)
"""Of the tables and figures. No setting is chosen by what comes of them."""
TUNING_SEEDS = range(1000, 1004)
"""Of the studies that settings are chosen by. Nothing that comes of them is reported as a method's result."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One line of a figure and row of a table."""

    name: str
    panel: str = ""
    """The row of a figure that the line is in."""
    method: str = "hgail"
    config: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Changes to the method's config."""
    hyperparameters: dict[str, Any] = dataclasses.field(default_factory=dict)
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class beside those of its training, e.g. `observation`."""
    steps: float | dict[str, float] = 1
    """Environment steps, as a multiple of those that HGAIL takes by default; by task, and 1 on others,
    where tasks differ."""
    preset: str = "parallel"
    demonstrations: int = 0
    paper: dict[str, tuple[str, str]] = dataclasses.field(default_factory=dict)
    """By task, the paper's success rate and L1 distance (m)."""

    def steps_on(self, task: str) -> float:
        """Returns the multiple of steps on a task."""
        return self.steps.get(task, 1) if isinstance(self.steps, dict) else self.steps

    @property
    def label(self) -> str:
        """Name and panel: what tells it from the others of its study."""
        return ", ".join(filter(None, (self.name, self.panel)))


@dataclasses.dataclass(frozen=True)
class Study:
    """What one training serves: a table, a figure, or both."""

    name: str
    """Of its files: `<name>-<task>.json` and `.md`."""
    title: str
    settings: tuple[Setting, ...]
    table: int | None = None
    """The paper's number; more than one study may belong to it."""
    figure: int | None = None
    """The paper's number."""
    reference: str = ""
    """Name of the setting that the others are compared with; by default the first."""
    tuning: bool = False
    """Whether settings are chosen by it: it then has seeds of its own, see `choose_seeds`."""

    def compared_with(self, setting: Setting) -> Setting | None:
        """Returns the setting to compare one with: the reference of its panel, else the first of that name.

        None for the reference itself.
        """
        name = self.reference or self.settings[0].name
        named = [other for other in self.settings if other.name == name]
        found = next((other for other in named if other.panel == setting.panel), named[0])
        return None if found.label == setting.label else found


def choose_seeds(tuning: bool, count: int | None = None) -> range:
    """Returns the seeds of a study: those above or, from the same start, `count` of them.

    Raises:
      ValueError: there are none, or so many that seeds for reporting are also seeds for choosing.

    >>> choose_seeds(tuning=True), choose_seeds(tuning=False, count=2)
    (range(1000, 1004), range(0, 2))

    """
    whole = TUNING_SEEDS if tuning else REPORTED_SEEDS
    if count is None:
        return whole
    check_seeds(whole.start, count)
    if not tuning and count > TUNING_SEEDS.start:
        raise ValueError(f"seeds is {count}; from {TUNING_SEEDS.start} on they are for choosing settings")
    return range(whole.start, whole.start + count)


def describe_seeds(seeds: list[int]) -> str:
    """Says of consecutive seeds what they are for.

    >>> describe_seeds([0, 1])
    'Seeds 0 to 1 are for reporting; settings are chosen on others, from 1000 on.'
    """
    these = f"Seeds {seeds[0]} to {seeds[-1]}"
    if seeds[0] >= TUNING_SEEDS.start:
        return f"{these} are for choosing settings; what is reported comes from others, from {REPORTED_SEEDS.start} on."
    return f"{these} are for reporting; settings are chosen on others, from {TUNING_SEEDS.start} on."
