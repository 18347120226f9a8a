"""Writes pictures as a film, in the format that its name says."""

import contextlib
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

from hgail_jax.io.files import replace_path

Append = Callable[[np.ndarray], None]
"""Adds the next picture, `[height, width, 3]`, uint8."""

FORMATS = (".mp4", ".gif", ".webp")
"""Endings of a film's name."""

_COLOURS = 256  # of a GIF
_PALETTE_SAMPLES = 12  # pictures that they are taken from
_WEBP_QUALITY = 80  # per cent
_MP4_QUALITY = 8  # of 10


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
    with replace_path(path) as temporary:
        if path.suffix.lower() == ".mp4":
            with contextlib.closing(_Mp4(temporary, 1.0 / frame_period)) as writer:
                yield writer.append
        else:
            pictures: list[Image.Image] = []
            yield lambda frame: pictures.append(Image.fromarray(frame))
            _save_animation(temporary, path.suffix.lower(), pictures, frame_period)


class _Mp4:
    """Encodes pictures as they come, by FFmpeg, which learns their size from the first."""

    def __init__(self, path: Path, rate: float) -> None:
        self._path, self._rate = path, rate
        self._encoder: Generator[None, np.ndarray | None, None] | None = None

    def append(self, frame: np.ndarray) -> None:
        if self._encoder is None:
            height, width, _ = frame.shape
            output = f"file:{self._path}"  # without which FFmpeg reads a:b as b by the protocol a
            self._encoder = imageio_ffmpeg.write_frames(
                output, (width, height), fps=self._rate, quality=_MP4_QUALITY, output_params=["-f", "mp4"]
            )
            self._encoder.send(None)
        self._encoder.send(np.ascontiguousarray(frame))

    def close(self) -> None:
        if self._encoder is not None:
            self._encoder.close()


def _save_animation(path: Path, suffix: str, pictures: list[Image.Image], frame_period: float) -> None:
    """Writes a GIF or a WebP that plays for ever."""
    options = {"save_all": True, "duration": round(1000 * frame_period), "loop": 0}
    if suffix == ".webp":
        pictures[0].save(path, "WEBP", append_images=pictures[1:], quality=_WEBP_QUALITY, method=4, **options)
        return
    # One palette for all pictures, from some of them: palettes of their own would flicker.
    sampled = np.linspace(0, len(pictures) - 1, min(len(pictures), _PALETTE_SAMPLES)).astype(int)
    samples = Image.fromarray(np.concatenate([np.asarray(pictures[index]) for index in sampled]))
    palette = samples.quantize(_COLOURS)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, "GIF", append_images=others, **options)
