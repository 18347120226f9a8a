"""The text of a description's file."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from hgail_envs.robots.description import Description
from hgail_envs.robots.hand import PADS

_UNITS = (
    "Metres, radians, newtons, newton metres, seconds; a pose is in the frame of its body: x is where the hand points"
)


def write_description(arm: Description, heading: Sequence[str]) -> str:
    """Returns the text of a description's file, with comments as its first lines."""
    fields = dataclasses.asdict(arm)
    tables = {name: fields.pop(name) for name in ("tool", "palm", *PADS, "hand")}
    defaults = {field.name: field.default for field in dataclasses.fields(Description)}
    lines = [f"# {line}" for line in (*heading, _UNITS)]
    lines += _lines({name: value for name, value in fields.items() if value != defaults[name]})
    for name, table in tables.items():
        shown = {field: value for field, value in table.items() if name != "tool" or field != "size"}
        lines += ["", f"[{name}]", *_lines(shown)]
    return "\n".join(lines) + "\n"


def _lines(values: dict[str, Any]) -> list[str]:
    return [f"{name} = {_toml(value)}" for name, value in values.items()]


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float | int):
        return repr(round(float(value), 6) + 0.0)
    return f"[{', '.join(map(_toml, value))}]"
