"""Renders many scenes in several processes."""

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

import jax
import numpy as np

from hgail_envs.vision.pictures import Pictures


def render(pictures: Pictures, batches: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yields the pictures of batches of scenes, uint8 `[N, cameras, size, size, 3]`, one batch after another.

    A batch, `[N, joints + draws]`, has the joint positions and the draws of the look of each scene. OpenGL renders in
    as many processes as there are cores, for one of them hardly fills one; few batches wait, for pictures are large.
    """
    if pictures.renderer != "opengl":
        _keep(pictures)
        yield from map(_render, batches)
        return
    spawn = multiprocessing.get_context("spawn")  # a process in which JAX runs must not fork
    cores = os.cpu_count() or 1
    submitted: deque[Future[np.ndarray]] = deque()
    with ProcessPoolExecutor(cores, spawn, _keep, (pictures,)) as pool:
        for batch in batches:
            if len(submitted) == 2 * cores:
                yield submitted.popleft().result()
            submitted.append(pool.submit(_render, batch))
        while submitted:
            yield submitted.popleft().result()


_kept: dict[str, Any] = {}


def _keep(pictures: Pictures) -> None:
    see: Callable[..., jax.Array] = jax.jit(pictures)
    _kept.update(joints=pictures.joints, see=see)


def _render(scenes: np.ndarray) -> np.ndarray:
    return np.asarray(_kept["see"](*np.split(scenes, [_kept["joints"]], axis=-1)))
