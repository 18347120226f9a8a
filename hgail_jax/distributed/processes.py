"""The devices and processes that train together, as command lines name them."""

import contextlib
import io
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
from jax.sharding import Mesh

from hgail_jax.distributed.sharding import is_first_process, make_mesh, most_devices
from hgail_jax.validation import check_count

_MOST_PORT = 65535
_PATIENCE = 300.0  # seconds to wait for the first process


def join(coordinator: str | None, num_processes: int, process_id: int) -> None:
    """Joins this process to the others of a training, before JAX is first used; alone without a coordinator.

    Raises:
      ValueError: the numbers do not fit, or nobody answers.

    """
    check_count("num_processes", num_processes)
    check_count("process_id", process_id, least=0, most=num_processes - 1)
    if coordinator is None:
        if num_processes > 1:
            raise ValueError("several processes need --coordinator, the host:port of the first")
        return
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) <= _MOST_PORT):
        raise ValueError(f"coordinator is {coordinator!r}; it must be host:port")
    if process_id > 0:
        _wait_for(host.strip("[]"), int(port))
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"cannot join the processes at {coordinator}: {str(error).splitlines()[0]}") from None


def _wait_for(host: str, port: int) -> None:
    """Returns once the first process answers; JAX itself ends the process with a dump where nobody does."""
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            return socket.create_connection((host, port), timeout=5.0).close()
        except OSError as error:
            if time.monotonic() > end:
                raise ValueError(f"nobody answers at {host}:{port}: {error.strerror or error}") from None
            time.sleep(0.5)


def choose_mesh(seeds: int, num_envs: int, devices: int | None) -> Mesh:
    """Returns the mesh over `devices` devices; by default one, or all that there are where several processes train.

    Raises:
      ValueError: there are not so many, or they do not divide, or some process would be left without.

    """
    available = jax.devices()
    if devices is None:
        devices = most_devices(seeds, num_envs, len(available)) if jax.process_count() > 1 else 1
    check_count("devices", devices, most=len(available))
    if jax.process_count() > 1 and devices < len(available):
        raise ValueError(
            f"{seeds} seeds of {num_envs} environments on {devices} devices leave some of the {len(available)} devices"
            f" of {jax.process_count()} processes without work; they must divide over all"
        )
    return make_mesh(seeds, num_envs, available[:devices])


@contextlib.contextmanager
def silent_but_first() -> Iterator[Path | None]:
    """Yields None in the first process; in another, whose output is dropped, a folder whose content nobody wants."""
    if is_first_process():
        yield None
        return
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        yield Path(folder) / "run"
