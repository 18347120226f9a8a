"""Changes a robot's model for an episode: friction, the cube's mass, and gravity compensation."""

import contextlib
from collections.abc import Iterator

import mujoco

from experiments.transfer.robots.base import Robot


@contextlib.contextmanager
def changed(robot: Robot, friction: float, object_mass: float, gravity: float) -> Iterator[None]:
    """Changes the robot's model, and undoes it in the end.

    Args:
      robot: the robot with the model.
      friction: factor on the friction of all contacts.
      object_mass: factor on the mass of the cube, if there is one.
      gravity: fraction of the arm's weight that is not compensated, in a model that compensates it.

    """
    if (friction, object_mass, gravity) == (1.0, 1.0, 0.0):
        yield
        return
    model = robot.model
    names = ("geom_friction", "pair_friction", "body_mass", "body_inertia", "body_gravcomp")
    before = {name: getattr(model, name).copy() for name in names}
    cube = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, robot.cube)
    try:
        model.geom_friction *= friction
        model.pair_friction *= friction
        model.body_gravcomp *= 1.0 - gravity
        if cube >= 0:
            body = model.geom_bodyid[cube]
            model.body_mass[body] *= object_mass
            model.body_inertia[body] *= object_mass
        _derive(model, object_mass)
        yield
    finally:
        for name, values in before.items():
            getattr(model, name)[...] = values
        _derive(model, object_mass)


def _derive(model: mujoco.MjModel, object_mass: float) -> None:
    """Recomputes the model's constants that derive from masses, if these have changed."""
    if object_mass != 1.0:
        mujoco.mj_setConst(model, mujoco.MjData(model))
