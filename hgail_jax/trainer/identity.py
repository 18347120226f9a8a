"""Refuses the files of another run, with the first difference."""

import json
from pathlib import Path
from typing import Any


class AnotherRunError(ValueError):
    """A folder or checkpoint belongs to another run; the message names the first difference."""


def refuse_another_run(folder: Path | str, there: dict, here: dict) -> None:
    """Raises an AnotherRunError that names the first entry in which two nested dicts, of JSON's types, differ."""
    difference = _difference(there, as_json(here))
    if difference is not None:
        name, *values = difference
        of_there, of_here = ("given" if isinstance(value, dict) else value for value in values)
        raise AnotherRunError(f"{folder} holds another run: {name} is {of_there} there and {of_here} here")


def _difference(there: Any, here: Any, name: str = "") -> tuple[str, Any, Any] | None:
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return None if there == here else (name, there, here)
    for key in [*here, *(key for key in there if key not in here)]:
        found = _difference(there.get(key, "absent"), here.get(key, "absent"), f"{name}.{key}" if name else key)
        if found is not None:
            return found
    return None


def as_json(content: Any) -> Any:
    """Returns `content` as JSON gives it back: tuples are lists, keys are text."""
    return json.loads(json.dumps(content, default=lambda number: number.tolist()))  # NumPy's
