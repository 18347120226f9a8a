"""C MuJoCo on the host's cores, called back from within a compiled program.

An action of all environments of all seeds is one call of `mujoco.rollout`, whose pool has a thread for each core that
this process may use. The host keeps nothing between calls: all state goes in and out, so that a call may be repeated or
left out, a run resumes exactly, and the result does not depend on the number of threads.

Such callbacks do not go together with JAX's asynchronous dispatch on a CPU, under which they can wait for one another
for ever; `envs._platform` turns that off before JAX starts.
"""

import math
import os
import threading
import weakref
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from envs.engines.base import Control, Engine, StateT

_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT)

_START = 1.0  # seconds on the clock at the start of an action, more than one lasts


class CEngine(Engine):
    """C MuJoCo; see `Engine` for the arguments. It starts the constraint solver anew with every action.

    A simulation that MuJoCo warns of (a position that is not finite, an ill-conditioned inertia, a full arena) gives
    positions that are not a number, so that its episode is left out. A warning in the last physics step of an action
    alone goes unseen, but for one that resets the simulation.
    """

    name = "c"

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        super().__init__(model, period, substeps, worlds)
        self._host = HostRollout(self.model, substeps, usable_cores())

    def step(self, state: StateT, control: Control) -> StateT:
        """See `Engine`; the warm start is passed on unused."""
        shapes = (
            jax.ShapeDtypeStruct((self.model.nq,), jnp.float32),
            jax.ShapeDtypeStruct((self.model.nv,), jnp.float32),
            jax.ShapeDtypeStruct((self.model.nsensordata,), jnp.float32),
        )
        mocap_pos, mocap_quat = control.mocap_pos.reshape(-1), control.mocap_quat.reshape(-1)
        qpos, qvel, sensordata = jax.pure_callback(
            self._host,
            shapes,
            state.qpos,
            state.qvel,
            jnp.concatenate([control.ctrl, mocap_pos, mocap_quat]),
            vmap_method="broadcast_all",
        )
        return state.replace(qpos=qpos, qvel=qvel, sensordata=sensordata)

    def with_substeps(self, substeps: int) -> Self:
        """See `Engine`."""
        return type(self)(self.model, self.period, substeps, worlds=0)


class HostRollout:
    """Steps a batch of environments with C MuJoCo, NumPy arrays in and out.

    JAX must not be used in here, not even to convert an array: it may wait for the very program that waits for this.

    Args:
      model: the scene, whose time step is taken.
      substeps: physics steps in a call.
      threads: of the pool.

    """

    def __init__(self, model: mujoco.MjModel, substeps: int, threads: int) -> None:
        self._model, self._substeps, self._threads = model, substeps, threads
        self._lock = threading.Lock()  # several devices of a process call from threads of their own
        self._pool: rollout.Rollout | None = None
        self._datas = [mujoco.MjData(model) for _ in range(threads)]
        _HOSTS.add(self)

    def __call__(self, qpos: Any, qvel: Any, control: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns positions `[..., nq]`, velocities `[..., nv]` and sensors `[..., nsensordata]` after a call's steps.

        Args:
          qpos: `[..., nq]`.
          qvel: `[..., nv]`.
          control: `[..., nu + 7 nmocap]`: controls, then positions and quaternions of the mocap bodies.

        """
        qpos, qvel, control = (np.asarray(array) for array in (qpos, qvel, control))  # JAX hands over arrays of its own
        model, batch = self._model, qpos.shape[:-1]
        start = np.zeros((math.prod(batch), self._state_size()))
        start[:, 0] = _START  # time comes first
        start[:, 1 : 1 + model.nq] = qpos.reshape(-1, model.nq)
        start[:, 1 + model.nq : 1 + model.nq + model.nv] = qvel.reshape(-1, model.nv)
        controls = control.reshape(len(start), 1, -1).astype(np.float64)
        with self._lock:
            states, sensors = self._open().rollout(
                model, self._datas, start, np.repeat(controls, self._substeps, axis=1), control_spec=_CONTROL
            )
        end, sensordata = states[:, -1], sensors[:, -1].astype(np.float32)
        # MuJoCo resets a simulation that breaks down, and its clock with it; after any warning it stops early.
        broken = ~(end[:, 0] > _START + (self._substeps - 0.5) * model.opt.timestep)
        positions = np.where(broken[:, None], np.nan, end[:, 1 : 1 + model.nq]).astype(np.float32)
        velocities = end[:, 1 + model.nq : 1 + model.nq + model.nv].astype(np.float32)
        return positions.reshape(*batch, -1), velocities.reshape(*batch, -1), sensordata.reshape(*batch, -1)

    def _state_size(self) -> int:
        return mujoco.mj_stateSize(self._model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))

    def _open(self) -> rollout.Rollout:
        if self._pool is None:
            mujoco.set_mju_user_warning(_ignore)
            self._pool = rollout.Rollout(nthread=self._threads)
        return self._pool

    def close(self) -> None:
        """Ends the pool's threads; the next call starts others."""
        with self._lock:
            self._pool = None


_HOSTS: weakref.WeakSet[HostRollout] = weakref.WeakSet()


def _close_all() -> None:
    """Ends all threads before a fork: the child would wait for ever for those that it does not have."""
    for host in list(_HOSTS):
        host.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_close_all)


def usable_cores() -> int:
    """Returns how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _ignore(message: str) -> None:
    """Takes MuJoCo's warnings, which would go to the terminal and a log file; broken episodes are counted instead."""
