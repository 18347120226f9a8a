"""The interface between a task and the physics engine that steps its scene."""

import abc
import copy
from collections.abc import Mapping
from typing import Any, Self, TypeVar

import jax
import mujoco
import numpy as np
from flax import struct


class EngineState(struct.PyTreeNode):
    """What an engine carries from one action to the next, of a single environment; `jax.vmap` makes batches."""

    qpos: jax.Array
    """`[nq]`: joint positions."""
    qvel: jax.Array
    """`[nv]`: joint velocities."""
    warmstart: jax.Array
    """`[nv]`: accelerations of the last step, where the constraint solver starts; an engine may leave it at 0."""
    sensordata: jax.Array
    """`[nsensordata]`: as of the last physics step."""
    overflow: jax.Array
    """`[]` boolean: whether contacts or constraints ever exceeded their buffers (MJX-Warp alone has such)."""


StateT = TypeVar("StateT", bound=EngineState)


class Control(struct.PyTreeNode):
    """What acts on a scene during an action, constant over its physics steps."""

    mocap_pos: jax.Array
    """`[nmocap, 3]`: positions of the mocap bodies, metres."""
    mocap_quat: jax.Array
    """`[nmocap, 4]`: their orientations, quaternions that need not be normalised."""
    ctrl: jax.Array
    """`[nu]`: controls of the actuators."""
    model: Mapping[str, jax.Array] | None = None
    """Fields of the model that are others in this environment, by their names in `mujoco.MjModel`: whole arrays. What
    MuJoCo has worked out from a field when it compiled the scene, such as inverse weights, is a field of its own."""


class Engine(abc.ABC):
    """Carries out actions on a scene.

    Args:
      model: the scene; the engine steps a copy of it.
      period: seconds that an action lasts.
      substeps: physics steps that it is carried out in.
      worlds: environments that are stepped at once at most, where the engine has buffers for them.

    """

    name: str
    """What `impl` calls it."""
    max_worlds: int | None = None
    """Environments that it can step at once; None is any number."""

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        del worlds
        self.period, self.substeps = period, substeps
        self.model = copy.copy(model)
        self.model.opt.timestep = period / substeps

    @abc.abstractmethod
    def step(self, state: StateT, control: Control) -> StateT:
        """Returns the state after an action, `substeps` physics steps under one control.

        Pure and batched by `jax.vmap`. A simulation that breaks down gives positions that are not finite; the fields
        that a subclass of `EngineState` adds are left as they are.

        Raises:
          ValueError: the engine cannot vary a field of `control.model`.

        """

    def prepare(self) -> None:
        """Does what the first step would otherwise wait for, see `GoalEnv.prepare`; by default nothing."""
        return

    def _check_fields(self, model: Any, fields: Mapping[str, jax.Array]) -> None:
        """Refuses fields that `model`, the engine's own, does not have as arrays of these sizes."""
        for name, values in fields.items():
            there = getattr(model, name, None)
            if not isinstance(there, np.ndarray | jax.Array) or there.size != values.size:
                raise ValueError(
                    f"impl {self.name!r} cannot vary {name} {np.shape(values)} from one environment to another;"
                    " use impl 'c', and a field of mujoco.MjModel"
                )

    @abc.abstractmethod
    def with_substeps(self, substeps: int) -> Self:
        """Returns an engine for the same scene and period with another number of physics steps."""
