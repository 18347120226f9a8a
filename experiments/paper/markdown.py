"""Writes Markdown tables of studies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]
"""Setting of a study with its results, as `experiments.paper.tables.make_rows` makes it."""


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table.

    >>> print(table(["a", "b"], [["1", "2"]]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    lines = [f"| {' | '.join(cells)} |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def study_table(rows: Sequence[Row], header: Mapping[str, str]) -> str:
    """Returns a table of settings.

    Args:
      rows: of a study; an entry `label` stands for setting and panel, `better` for the comparison with the reference.
      header: names of the columns, in `_CELLS`, and their titles.
    """
    return table(list(header.values()), [[_CELLS[column](row) for column in header] for row in rows])


def label(row: Row) -> str:
    """Returns name and panel of a setting.

    >>> label({"setting": "PPO", "panel": ""}), label({"setting": "r1", "panel": "with pre-training"})
    ('PPO', 'r1, with pre-training')
    """
    return ", ".join(filter(None, (row["setting"], row["panel"])))


def plus_minus(mean: float, half: float | None) -> str:
    """Returns a mean and the half width of its interval, if it has one.

    >>> plus_minus(0.9, 0.02), plus_minus(0.9, None)
    ('0.900 ± 0.020', '0.900')
    """
    return f"{mean:.3f}" if half is None else f"{mean:.3f} ± {half:.3f}"


def with_bounds(row: Row, name: str, digits: int) -> str:
    """Returns a statistic and its interval, if it has one.

    >>> with_bounds({"iqm": 0.9, "iqm_low": 0.8, "iqm_high": 1.0}, "iqm", 2)
    '0.90 (0.80 to 1.00)'
    """
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return f"{value:.{digits}f}" + ("" if low is None else f" ({low:.{digits}f} to {high:.{digits}f})")


_CELLS: dict[str, Callable[[Row], str]] = {
    "label": lambda row: row["label"],
    "seeds": lambda row: str(len(row["identity"]["seeds"])),
    "paper_success": lambda row: row["paper_success"],
    "success": lambda row: plus_minus(row["success_rate"], row["success_ci95"]),
    "success_iqm": lambda row: with_bounds(row, "success_iqm", 3),
    "better": lambda row: row["better"],
    "worst_seed": lambda row: f"{row['worst_seed']:.3f}",
    "paper_distance_l1": lambda row: row["paper_distance_l1"],
    "distance_l1": lambda row: plus_minus(row["distance_l1"], row["distance_l1_ci95"]),
    "distance_l1_mean": lambda row: f"{row['distance_l1']:.3f}",
    "distance_l1_iqm": lambda row: with_bounds(row, "distance_l1_iqm", 3),
    "env_steps": lambda row: f"{row['env_steps_per_seed']:,}",
    "seconds": lambda row: f"{row['seconds']:.1f}",
}
