"""Renders many scenes, and uses their pictures, in several processes."""

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import forkserver
from typing import Any, TypeVar

import jax
import numpy as np

from hgail_envs.engines.c import usable_cores
from hgail_envs.vision.pictures import Pictures

T = TypeVar("T")


def start_server(module: str) -> None:
    """Starts the process that those of `use_pictures` are forked from; it imports a module whose functions they use.

    Imports take as long as the rest, so that it is worth while to start them early. A process in which JAX runs must
    not fork, and in this one it does not.
    """
    multiprocessing.set_forkserver_preload([module])
    forkserver.ensure_running()


def use_pictures(
    pictures: Pictures, batches: Iterable[np.ndarray], use: Callable[..., T], *arguments: Iterable[Any]
) -> Iterator[T]:
    """Yields what `use` returns of the pictures of batches of episodes, called in as many processes as there are cores.

    A batch, `[M, N, joints + draws]`, has the joint positions and the draws of the look of each of `N` scenes of `M`
    episodes. `use` is called with its pictures, uint8 `[M, N, cameras, size, size, 3]`, and one of each of the
    `arguments`; it must be importable, see `start_server`. OpenGL renders in these processes too, for one of them
    hardly fills a core; a GPU renders in this one. Few batches wait, for pictures are large.
    """
    opengl = pictures.renderer == "opengl"
    if not opengl:
        _keep(pictures)
    start_server(use.__module__)
    context, cores = multiprocessing.get_context("forkserver"), usable_cores()
    submitted: deque[Future[T]] = deque()
    with ProcessPoolExecutor(cores, context, *((_keep, (pictures,)) if opengl else ())) as pool:
        for batch, *others in zip(batches, *arguments, strict=True):
            if len(submitted) == 2 * cores:
                yield submitted.popleft().result()
            if opengl:
                submitted.append(pool.submit(_render_and_use, use, batch, *others))
            else:
                submitted.append(pool.submit(use, _render(batch), *others))
        while submitted:
            yield submitted.popleft().result()


_kept: dict[str, Any] = {}


def _keep(pictures: Pictures) -> None:
    see: Callable[..., jax.Array] = jax.jit(pictures)
    _kept.update(joints=pictures.joints, see=see)


def _render(episodes: np.ndarray) -> np.ndarray:
    """Returns the pictures of a batch; an episode at a time, so that there is one shape to compile for."""
    return np.stack([np.asarray(_kept["see"](*np.split(scenes, [_kept["joints"]], axis=-1))) for scenes in episodes])


def _render_and_use(use: Callable[..., T], episodes: np.ndarray, *arguments: Any) -> T:
    return use(_render(episodes), *arguments)
