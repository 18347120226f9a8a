"""Distributes programs over processes, each on a GPU of its own."""

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.synchronize import Event

from experiments.paper.work import Job
from hgail_jax.cli.command_line import prepare_process

_LISTEN = 0.5  # seconds between two checks of the stop signal


def carry_out(jobs: list[Job], gpus: list[str], stop: threading.Event, after_each: Callable[[], None]) -> None:
    """Carries jobs out, several at a time.

    Args:
      jobs: programs to train.
      gpus: as CUDA_VISIBLE_DEVICES names them, a process each; with a single one this process trains by itself.
      stop: once set, each process saves a checkpoint and ends after its present round.
      after_each: called after each job.

    Raises:
      OSError: a checkpoint cannot be written, or a process ended.
      OverflowError, FloatingPointError: see `train_program`.

    """
    if len(gpus) < 2:
        for index, job in enumerate(jobs):
            if stop.is_set():
                return
            print(f"program {index + 1} of {len(jobs)}: {job.names}", flush=True)
            job.carry_out(stop)
            after_each()
        return
    with ExitStack() as held:
        context = multiprocessing.get_context("spawn")
        shared, waiting = context.Event(), queue.SimpleQueue[Job]()
        for job in sorted(
            jobs, key=_size, reverse=True
        ):  # the longest first, so that all GPUs end at about the same time
            waiting.put(job)
        pools = [held.enter_context(_pool(gpu, context, shared)) for gpu in gpus[: len(jobs)]]
        running = {_next(pool, waiting): pool for pool in pools}
        try:
            _work_off(running, waiting, stop, shared, after_each)
        except BrokenProcessPool:
            raise ChildProcessError("a process that trains a program ended") from None
        finally:
            shared.set()  # the others stop with a checkpoint


def _work_off(
    running: dict[Future, ProcessPoolExecutor],
    waiting: "queue.SimpleQueue[Job]",
    stop: threading.Event,
    shared: Event,
    after_each: Callable[[], None],
) -> None:
    while running:
        done, _ = wait(running, timeout=_LISTEN, return_when=FIRST_COMPLETED)
        if stop.is_set():
            shared.set()
        for future in done:
            pool = running.pop(future)
            future.result()
            after_each()
            if not (stop.is_set() or waiting.empty()):
                running[_next(pool, waiting)] = pool


def _next(pool: ProcessPoolExecutor, waiting: "queue.SimpleQueue[Job]") -> Future:
    job = waiting.get()
    print(f"{waiting.qsize()} programs left after {job.names}", flush=True)
    return pool.submit(_carry_out, job)


@contextmanager
def _pool(gpu: str, context: multiprocessing.context.SpawnContext, shared: Event) -> Iterator[ProcessPoolExecutor]:
    """Yields a pool of one process on one GPU, started with this environment variable set."""
    before = dict(os.environ)
    os.environ |= {"CUDA_VISIBLE_DEVICES": gpu, "TQDM_DISABLE": "1"}
    os.environ.pop("XLA_PYTHON_CLIENT_PREALLOCATE", None)
    try:
        pool = ProcessPoolExecutor(1, context, _prepare, (shared,))
        pool.submit(os.getpid)
    finally:
        os.environ.clear()
        os.environ |= before
    with pool:
        yield pool


_stop = threading.Event()


def _prepare(shared: Event) -> None:
    """Prepares a training process: it leaves interrupts to its parent, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threading.Thread(target=_stop_with_all, args=(shared,), daemon=True).start()
    prepare_process()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _stop_with_all(shared: Event) -> None:
    shared.wait()
    _stop.set()


def _carry_out(job: Job) -> None:
    job.carry_out(_stop)


def _size(job: Job) -> int:
    """Returns a job's approximate number of roll-out episodes, to sort by."""
    config = job.trials[0].config
    phases = config.rounds * (config.learner.policy_phases + config.learner.discriminator_phases + 1)
    return phases * config.num_envs * len(job.trials) * len(job.trials[0].seeds)
