"""Writes pictures as a film, in the format that its name says."""

import contextlib
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np

from hgail_jax.io.files import replace_path

Append = Callable[[np.ndarray], None]
"""Adds the next picture, `[height, width, 3]`, uint8."""

# One palette for all pictures of a GIF: palettes per picture would flicker.
_PALETTE = "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none"
_ENCODERS: dict[str, dict[str, Any]] = {
    ".mp4": {"quality": 8},
    ".gif": {"codec": "gif", "pix_fmt_out": "pal8", "quality": None, "output_params": ["-lavfi", _PALETTE]},
    ".webp": {"codec": "libwebp", "quality": None, "output_params": ["-loop", "0", "-quality", "80", "-f", "webp"]},
}
FORMATS = tuple(_ENCODERS)
"""Endings of a film's name."""


def check_film(path: Path) -> None:
    """Refuses a name under which no new film can be written.

    Raises:
      ValueError: it is no such name.

    """
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} is not the name of a film; it must end in {', '.join(FORMATS)}")
    if path.exists() or path.is_symlink():
        raise ValueError(f"{path} exists already; name another file, or remove it")
    if not path.parent.is_dir():
        raise ValueError(f"there is no folder {path.parent} to write {path.name} into")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ValueError(f"the folder {path.parent} cannot be written to")


@contextlib.contextmanager
def open_film(path: Path, frame_period: float) -> Iterator[Append]:
    """Opens a film, which takes its name once it is whole; a failure leaves no file.

    Args:
      path: ends in one of `FORMATS`.
      frame_period: seconds between two pictures.

    """
    encoders: list[Generator[None, np.ndarray | None, None]] = []

    def append(frame: np.ndarray) -> None:
        if not encoders:  # FFmpeg learns the size from the first picture
            options = _ENCODERS[path.suffix.lower()]
            output = f"file:{temporary}"  # without which FFmpeg reads a:b as b by the protocol a
            size = frame.shape[1::-1]
            encoders.append(imageio_ffmpeg.write_frames(output, size, fps=1.0 / frame_period, **options))
            encoders[0].send(None)
        encoders[0].send(np.ascontiguousarray(frame))

    with replace_path(path) as temporary:
        try:
            yield append
        finally:
            for encoder in encoders:
                encoder.close()
