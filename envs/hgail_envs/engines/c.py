"""C MuJoCo on the host's cores, called back from within a compiled program.

An action of all environments of all seeds is one call of `mujoco.rollout`, whose pool has a thread for each core that
this process may use. The host keeps no state between calls: all state goes in and out, so that a call may be repeated
or left out, a run resumes exactly, and the result does not depend on the number of threads.

A call uses no JAX, not even to convert an array. So it cannot wait for the program that waits for it, as a callback
under JAX's asynchronous dispatch on a CPU otherwise can.
"""

import copy
import functools
import hashlib
import math
import os
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from hgail_envs.engines.base import Control, Engine, StateT
from hgail_envs.engines.host_call import host_call

_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT)

_CGROUP = Path("/sys/fs/cgroup")

_START = 1.0  # seconds on the clock at the start of an action: after a reset to 0 it ends earlier than this


class CEngine(Engine):
    """C MuJoCo; see `Engine` for the arguments. The constraint solver starts from zero in every action.

    A simulation with a MuJoCo warning (a position that is not finite, an ill-conditioned inertia, a full arena) gives
    positions that are not a number, so that its episode is left out. A warning in the last physics step of an action is
    not noticed, except one that resets the simulation.
    """

    name = "c"

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        super().__init__(model, period, substeps, worlds)
        self._host = HostRollout(self.model, substeps, usable_cores())
        self._name = f"rollout.{digest(self.model)}.{substeps}"

    def step(self, state: StateT, control: Control) -> StateT:
        """Steps on the host, without use of the warm start; see `Engine`."""
        sizes = (self.model.nq, self.model.nv, self.model.nsensordata)
        mocap_pos, mocap_quat = control.mocap_pos.reshape(-1), control.mocap_quat.reshape(-1)
        fields = dict(sorted((control.model or {}).items()))
        self._check_fields(self.model, fields)
        commands = jnp.concatenate([control.ctrl, mocap_pos, mocap_quat])
        # host_call reads memory as single precision, and under jax_enable_x64 some of these are double.
        given = [state.qpos, state.qvel, commands, *(values.reshape(-1) for values in fields.values())]
        qpos, qvel, sensordata = host_call(
            ".".join([self._name, *fields]),
            functools.partial(self._host, names=tuple(fields)),
            [jax.ShapeDtypeStruct((size,), jnp.float32) for size in sizes],
            *(jnp.asarray(values, jnp.float32) for values in given),
        )
        return state.replace(qpos=qpos, qvel=qvel, sensordata=sensordata)


class HostRollout:
    """Steps a batch of environments by `substeps` of the model's time step, NumPy arrays in and out."""

    def __init__(self, model: mujoco.MjModel, substeps: int, threads: int) -> None:
        self._model, self._substeps, self._threads = model, substeps, threads
        self._lock = threading.Lock()  # several devices of a process call from separate threads
        self._pool: rollout.Rollout | None = None
        self._datas = [mujoco.MjData(model) for _ in range(threads)]
        self._room = _Room(model, substeps, 0)
        self._copies: dict[tuple[str, ...], _Copies] = {}
        _HOSTS.add(self)

    def __call__(
        self, qpos: np.ndarray, qvel: np.ndarray, control: np.ndarray, *fields: np.ndarray, names: Sequence[str] = ()
    ) -> tuple[np.ndarray, ...]:
        """Returns positions `[..., nq]`, velocities `[..., nv]` and sensors `[..., nsensordata]` after a call's steps.

        `control` is `[..., nu + 7 nmocap]`: controls, then positions and quaternions of the mocap bodies; without such
        bodies there may be controls for each step, `[..., substeps * nu]`. `fields`,
        each `[..., size]` in single precision, are values of the model's fields of these `names`.
        """
        model, batch = self._model, qpos.shape[:-1]
        count, velocities = math.prod(batch), 1 + model.nq  # time comes first
        with self._lock:
            room = self._room = self._room if self._room.count == count else _Room(model, self._substeps, count)
            room.start[:, 1:velocities] = qpos.reshape(count, -1)
            room.start[:, velocities : velocities + model.nv] = qvel.reshape(count, -1)
            width = room.control.shape[2]
            room.control[:] = control.reshape(count, max(control.shape[-1] // max(width, 1), 1), width)
            models = room.models
            if names:
                copies = self._copies.setdefault(tuple(names), _Copies(model, names))
                models = copies.with_fields(np.concatenate([values.reshape(count, -1) for values in fields], axis=1))
            if self._pool is None:
                # MuJoCo's warnings would go to the terminal and a log file; invalid episodes are counted instead.
                mujoco.set_mju_user_warning(lambda message: None)
                self._pool = rollout.Rollout(nthread=self._threads)
            self._pool.rollout(
                models,
                self._datas,
                room.start,
                room.control,
                control_spec=_CONTROL,
                skip_checks=True,  # they copy, and cost as much as a physics step of a few environments
                nstep=self._substeps,
                state=room.states,
                sensordata=room.sensors,
            )
            end, sensordata = room.states[:, -1].astype(np.float32), room.sensors[:, -1].astype(np.float32)
        # MuJoCo resets a simulation that diverges, and its clock with it; after any other warning it stops early.
        broken = ~(end[:, 0] > _START + (self._substeps - 0.5) * model.opt.timestep)
        if broken.any():
            end[broken, 1:velocities] = np.nan
        parts = end[:, 1:velocities], end[:, velocities : velocities + model.nv], sensordata
        return tuple(part.reshape(*batch, -1) for part in parts)

    def close(self) -> None:
        """Ends the pool's threads; the next call starts new ones."""
        with self._lock:
            self._pool = None


class _Room:
    """Arrays that `mujoco.rollout` on `count` environments reads and writes, kept from call to call."""

    def __init__(self, model: mujoco.MjModel, substeps: int, count: int) -> None:
        self.count = count
        self.models = [model] * count
        state_size = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self.start = np.zeros((count, state_size))
        self.start[:, 0] = _START
        self.control = np.empty((count, substeps, mujoco.mj_stateSize(model, _CONTROL)))
        self.states = np.empty((count, substeps, state_size))
        self.sensors = np.empty((count, substeps, model.nsensordata))


class _Copies:
    """Copies of a model that differ in the fields of some names, made once and kept from call to call."""

    def __init__(self, model: mujoco.MjModel, names: Sequence[str]) -> None:
        self._model, self._names = model, names
        self._models: list[mujoco.MjModel] = []
        self._written = np.empty((0, sum(getattr(model, name).size for name in names)), np.float32)

    def with_fields(self, values: np.ndarray) -> list[mujoco.MjModel]:
        """Returns a model for each row of `values`, the fields one after another; writes only rows that changed."""
        missing = len(values) - len(self._models)
        if missing > 0:  # NaN differs from every value, so that the new rows are written below
            self._models += [copy.copy(self._model) for _ in range(missing)]
            self._written = np.append(self._written, np.full((missing, values.shape[1]), np.nan, np.float32), axis=0)
        changed = np.flatnonzero((self._written[: len(values)] != values).any(axis=1))
        for index in changed:
            first = 0
            for name in self._names:
                field = getattr(self._models[index], name)
                field[...] = values[index, first : first + field.size].reshape(field.shape)
                first += field.size
        self._written[changed] = values[changed]
        return self._models[: len(values)]


_HOSTS: weakref.WeakSet[HostRollout] = weakref.WeakSet()


def _close_all() -> None:
    """Ends all threads before a fork: the child has none of them, and would wait for them for ever."""
    for host in list(_HOSTS):
        host.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_close_all)


def digest(model: mujoco.MjModel) -> str:
    """Returns a hash of a scene, the same in every process."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()[:32]


def usable_cores() -> int:
    """Returns the number of processors that this process may use, by its affinity and its container's limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _container_limit(_CGROUP) or cores)


def _container_limit(folder: Path) -> int | None:
    """Returns a container's limit in processors, rounded up; None without a limit.

    `folder` is the mount point of Linux's cgroups, of version 2 or 1.
    """
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            quota, period = (int(word) for file in files for word in (folder / file).read_text().split())
        except (OSError, ValueError):  # not there, or "max"
            continue
        if quota > 0:
            return math.ceil(quota / period)
    return None
