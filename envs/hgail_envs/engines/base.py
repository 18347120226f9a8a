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
    """State of an engine from one action to the next, of a single environment; `jax.vmap` makes batches."""

    qpos: jax.Array
    """`[nq]`: joint positions."""
    qvel: jax.Array
    """`[nv]`: joint velocities."""
    warmstart: jax.Array
    """`[nv]`: accelerations of the last step, initial guess of the constraint solver; an engine may leave it at 0."""
    sensordata: jax.Array
    """`[nsensordata]`: sensors at the last physics step."""
    overflow: jax.Array
    """`[]` boolean: whether contacts or constraints ever exceeded their buffers, which MJX-Warp alone has."""


StateT = TypeVar("StateT", bound=EngineState)


class Control(struct.PyTreeNode):
    """Inputs to a scene during an action, constant over its physics steps."""

    mocap_pos: jax.Array
    """`[nmocap, 3]`: positions of the mocap bodies, metres."""
    mocap_quat: jax.Array
    """`[nmocap, 4]`: their orientations, quaternions that need not be normalised."""
    ctrl: jax.Array
    """`[nu]`: controls of the actuators."""
    model: Mapping[str, jax.Array] | None = None
    """Fields of the model that this environment replaces, whole arrays by their names in `mujoco.MjModel`. Quantities
    that MuJoCo derives from a field at compilation, such as inverse weights, are separate fields."""


class Engine(abc.ABC):
    """Carries out actions on a scene.

    Args:
      model: the scene; the engine steps a copy of it.
      period: seconds that an action lasts.
      substeps: physics steps per action.
      worlds: most environments that are stepped at once, for engines with buffers for them.
    """

    name: str
    """Value of `impl` that selects it."""
    max_worlds: int | None = None
    """Most environments that it can step at once; None is any number."""

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        self.period, self.substeps = period, substeps
        self.model = copy.copy(model)  # the task's keeps its time step
        self.model.opt.timestep = period / substeps

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies an engine by how it was made: threads, locks and libraries' own models are made anew."""
        return type(self), (self.model, self.period, self.substeps, self.max_worlds or 0)

    @abc.abstractmethod
    def step(self, state: StateT, control: Control) -> StateT:
        """Returns the state after an action, `substeps` physics steps under one control.

        Pure and batched by `jax.vmap`. A simulation that diverges gives positions that are not finite; the fields that
        a subclass of `EngineState` adds are left as they are.

        Raises:
          ValueError: the engine cannot vary a field of `control.model`.
        """

    def prepare(self) -> None:
        """Warms up the engine, see `GoalEnv.prepare`; by default nothing."""
        return

    def _check_fields(self, model: Any, fields: Mapping[str, jax.Array]) -> None:
        """Refuses fields that `model`, the engine's own, does not have as arrays of these sizes."""
        for name, values in fields.items():
            own = getattr(model, name, None)
            if not isinstance(own, np.ndarray | jax.Array) or own.size != values.size:
                raise ValueError(
                    f"impl {self.name!r} cannot vary {name} {np.shape(values)} from one environment to another;"
                    " use impl 'c', and a field of mujoco.MjModel"
                )

    def with_substeps(self, substeps: int) -> Self:
        """Returns an engine for the same scene and period with another number of physics steps."""
        return type(self)(self.model, self.period, substeps, self.max_worlds or 0)
