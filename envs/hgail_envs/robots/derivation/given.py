"""The options of `hgail robot`, from which with the MJCF or URDF a description is derived."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Given:
    """What a user says about an arm."""

    model: Path
    """MJCF or URDF of the arm, or of the arm and its hand."""
    hand: Path | None = None
    """MJCF or URDF of a hand that is attached at the `flange`."""
    flange: str = ""
    """Site or body of the arm."""
    pads: Sequence[str] = ()
    """Of a hand with more than two fingers the two sides that meet, each the names of bodies with commas between."""
    top_speed: Sequence[float] = ()
    """Radians per second, one number or one for each joint."""
    torque: Sequence[float] = ()
    """N m, one number or one for each joint, where the model has no limits."""
