"""The devices and processes that train together, as command lines name them."""

import contextlib
import io
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax
from jax.sharding import Mesh

from hgail_envs.validation import check_count, counted
from hgail_jax.devices.sharding import is_first_process, make_mesh, most_devices

_MOST_PORT = 65535
_PATIENCE = 300.0  # seconds to wait for the first process
_NO_CLUSTER = (
    "--distributed auto finds no processes that Slurm, Open MPI or Kubernetes started, or not all of their variables;"
    " start this one by srun or mpirun, or name the processes by --coordinator, --num-processes and --process-id"
)

HEARTBEAT_TIMEOUT = 100
"""Seconds after which a process that is silent counts as dead; JAX's own default."""
RESUME = "the same command with --resume FOLDER resumes it, with as many processes as are left"
"""Advice once a process of several died."""


def join(
    coordinator: str | None,
    num_processes: int = 1,
    process_id: int = 0,
    auto: bool = False,
    heartbeat_timeout: int = HEARTBEAT_TIMEOUT,
) -> None:
    """Joins this process to the others of a training, before JAX is first used; alone without a coordinator or `auto`.

    The `coordinator` is host:port of the first process; `auto` takes it and the numbers from Slurm, Open MPI or
    Kubernetes, as `jax.distributed` finds them. The others end if a process is silent for `heartbeat_timeout` seconds.

    Raises:
      ValueError: the numbers do not fit, the first process does not answer, or no cluster is found.
    """
    check_count("num_processes", num_processes)
    check_count("process_id", process_id, least=0, most=num_processes - 1)
    check_count("heartbeat_timeout", heartbeat_timeout)
    if auto:
        if coordinator is not None or num_processes > 1:
            raise ValueError("--distributed auto finds the processes itself; leave --coordinator and its numbers away")
        return _initialize(heartbeat_timeout)
    if coordinator is None:
        if num_processes > 1:
            raise ValueError("several processes need --coordinator, the host:port of the first")
        return
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) <= _MOST_PORT):
        raise ValueError(f"coordinator is {coordinator!r}; it must be host:port")
    if process_id > 0:
        _wait_for(host.strip("[]"), int(port))
    _initialize(heartbeat_timeout, coordinator_address=coordinator, num_processes=num_processes, process_id=process_id)


def _initialize(heartbeat_timeout: int, **numbers: Any) -> None:
    """Starts `jax.distributed` with these numbers, or with those of the cluster."""
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(**numbers, heartbeat_timeout_seconds=heartbeat_timeout)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        if not numbers:
            raise ValueError(f"{_NO_CLUSTER} ({reason})") from None
        raise ValueError(f"cannot join the processes at {numbers['coordinator_address']}: {reason}") from None


def _wait_for(host: str, port: int) -> None:
    """Returns once the first process answers; without an answer JAX itself would end the process with a dump."""
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            return socket.create_connection((host, port), timeout=5.0).close()
        except OSError as error:
            if time.monotonic() > end:
                raise ValueError(f"no process answers at {host}:{port}: {error.strerror or error}") from None
            time.sleep(0.5)


def choose_mesh(seeds: int, num_envs: int, devices: int | None) -> Mesh:
    """Returns the mesh over `devices` devices; by default one, or all that several processes have.

    A ValueError says that there are not so many, or do not divide, or that some process would be left without.
    """
    available = jax.devices()
    if devices is None:
        devices = most_devices(seeds, num_envs, len(available)) if jax.process_count() > 1 else 1
    check_count("devices", devices)
    if devices > len(available):
        raise ValueError(f"devices is {devices}; JAX finds {counted(len(available), 'device')} here")
    if jax.process_count() > 1 and devices < len(available):
        raise ValueError(
            f"{counted(seeds, 'seed')} of {counted(num_envs, 'environment')} on {counted(devices, 'device')} would"
            f" leave some of the {len(available)} devices of {jax.process_count()} processes without work; they must"
            " divide over all"
        )
    return make_mesh(seeds, num_envs, available[:devices])


@contextlib.contextmanager
def silent_but_first() -> Iterator[Path | None]:
    """Yields None in the first process; in another drops the output and yields a temporary folder for its run."""
    if is_first_process():
        yield None
        return
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        yield Path(folder) / "run"


def end_without_the_others(line: str) -> NoReturn:
    """Ends this process with one line and exit code 1 at once: JAX's own end of it would wait for one that died."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)
    os._exit(1)
