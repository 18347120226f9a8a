"""File of measurements, and the printing of its rows."""

import json
import tempfile
from pathlib import Path
from typing import Any

from hgail_jax.io.files import write_json

_SAME = (
    "section",
    "task",
    "impl",
    "num_envs",
    "substeps",
    "seeds",
    "num_envs_per_seed",
    "devices",
    "what",
    "renderer",
    "look",
    "kind",
    "size",
    "seed",
    "options",
    "quick",
)
"""Entries that identify a row; it replaces an older one with the same entries and device."""


class Results:
    """Rows of a JSON file, which is written with each new row.

    Args:
      path: the file, which may be missing; its folder is made.

    Raises:
      ValueError: the file exists and is not one of measurements.
      OSError: the folder cannot be made, or the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, Any]] = []
        """All rows, each with its provenance in `made_by`."""
        self.added: list[dict[str, Any]] = []
        """The rows of this process."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            try:
                self.rows = json.loads(path.read_text())["rows"]
                for row in self.rows:
                    _key(row)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(f"{path} is no file of measurements: {error!r}") from None
        with tempfile.TemporaryFile(dir=path.parent):  # fail now, not after a measurement
            pass

    def add(self, row: dict[str, Any], made_by: dict[str, Any]) -> None:
        """Adds a row, in place of an older one with the same `_SAME` and device.

        Args:
          row: quantities by name.
          made_by: as from `provenance`.
        """
        self.added.append(row)
        row = row | {"made_by": made_by}
        self.rows = [old for old in self.rows if _key(old) != _key(row)] + [row]
        write_json(self.path, {"rows": self.rows})


def _key(row: dict[str, Any]) -> tuple:
    """Returns the identity of a row."""
    return *(row.get(name) for name in _SAME), json.dumps(row["made_by"]["device"], sort_keys=True)


def table(rows: list[dict[str, Any]]) -> str:
    """Returns rows as text: a line for each quantity, a column for each row."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[name, *(_short(row.get(name, "")) for row in rows)] for name in names]
    widths = [max(len(line[column]) for line in cells) for column in range(len(rows) + 1)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def _short(value: Any) -> str:
    """Formats a number to three digits, a list as its first and last, anything else as text.

    >>> _short(1234567.8), _short(0.98765), _short(4), _short([0.1, 0.2, 0.3])
    ('1,230,000', '0.988', '4', '0.1 ... 0.3')
    """
    if isinstance(value, list):
        return f"{_short(value[0])} ... {_short(value[-1])}" if value else ""
    if not isinstance(value, float):
        return str(value)
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}" if abs(rounded) >= 100 else f"{rounded:g}"
