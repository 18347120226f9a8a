"""Base class of tasks in which a part on a joint is brought to a position: a drawer, a door, a button, a lid."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.layout import Layout
from hgail_envs.randomization import OF_OBJECT
from hgail_envs.robots.kinematics import Chain
from hgail_envs.scenes import check_names
from hgail_envs.tasks.base import CONTROL_PERIOD, ArmEnv
from hgail_envs.tasks.objects import OBSERVATIONS, ObjectEnv, ObjectPhysics, object_goal
from hgail_envs.validation import check_name
from hgail_envs.variation import SensorErrors


class JointPhysics(ObjectPhysics, kw_only=True):
    """`ObjectPhysics` and the errors of the sensors."""

    site_error: jax.Array
    """`[2, 3]`: errors of the site's observed position and of its displacement in the last action, metres."""


class JointEnv(ObjectEnv):
    """A task in which a slide or a hinge of the scene is brought to a position.

    A goal is that of `ObjectEnv`: a position, which is where the site `object_site` would be, a handle for instance,
    and a flag. Starts and targets are drawn as positions of the joint, metres or radians; success is a distance of the
    site. Between the world and the site there are slides and hinges alone, of which the others keep their start.

    A task sets `object_name`, which is the joint's, `object_site`, `object_title`, `joint_targets`, the scene, and
    `features_layout`, which begins with the gripper's quantities and the object's.
    """

    object_site: str
    """Name of a site, or else of a geom, on the part that the joint moves."""
    joint_targets: tuple[float, float]
    """Least and largest position of the joint at a target, metres or radians."""
    joint_starts: tuple[float, float] = (0.0, 0.0)
    """Least and largest position of the joint at the start, metres or radians."""

    def _check_scene(self) -> None:
        ArmEnv._check_scene(self)
        title = type(self).__name__
        if self.is_free(self.object_name):
            raise ValueError(
                f"{title}.object_name is {self.object_name!r}, a free joint, which is for an ObjectEnv;"
                " a JointEnv's is a slide or a hinge"
            )
        joint = self.model.jnt(self.object_name)
        least, most = joint.range if self.model.jnt_limited[joint.id] else (-np.inf, np.inf)
        for name in ("joint_starts", "joint_targets"):
            bounds = getattr(self, name, (least, most))  # a task may draw its goals otherwise
            if np.shape(bounds) != (2,) or not least <= bounds[0] <= bounds[1] <= most:
                raise ValueError(
                    f"{title}.{name} is {bounds}; it must be two positions, the smaller one first, from"
                    f" {least:g} to {most:g}, the range of {self.object_name!r}"
                )

    @functools.cached_property
    def _chain(self) -> Chain:
        is_geom = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, self.object_site) >= 0
        check_names(self.model, self.robot.scene, "geom" if is_geom else "site", self.object_site)
        return Chain(self.model, self.object_site)

    @functools.cached_property
    def not_randomized(self) -> tuple[str, ...]:  # type: ignore[override]
        """All sizes of objects but the errors of the sensors."""
        return tuple(name for name in OF_OBJECT if name not in ("object_noise", "object_offset"))

    @classmethod
    def features_with(cls, **options: Any) -> Layout:
        check_name("observation", options.get("observation", OBSERVATIONS[0]), OBSERVATIONS[:1])
        return cls.features_layout

    def place(self, qpos: jax.Array, qvel: jax.Array) -> JointPhysics:
        start = self._chain.site(jnp.asarray(qpos, jnp.float32))
        return JointPhysics(**vars(ArmEnv.place(self, qpos, qvel)), object_start=start, site_error=jnp.zeros((2, 3)))

    def joint_position(self, physics: Any) -> jax.Array:
        """Returns the joint's position, `[]`, metres or radians."""
        return physics.qpos[self.qpos_of(self.object_name).start]

    def object_position(self, physics: Any) -> jax.Array:
        """Returns the site's position, `[3]`, metres, world frame."""
        return self._chain.site(physics.qpos) + physics.site_error[0]

    def _object_velocity(self, physics: Any) -> jax.Array:
        velocity = self._chain.pose(physics.qpos, physics.qvel).site_velocity
        return velocity * CONTROL_PERIOD + physics.site_error[1]

    def reset_physics(self, rng: jax.Array) -> Any:
        physics: Any = ArmEnv.reset_physics(self, rng)
        qpos = self._with_joint(physics.qpos, self._draw(rng, self.joint_starts))
        return physics.replace(qpos=qpos, object_start=self._chain.site(qpos))

    def sample_goal(self, rng: jax.Array, physics: Any) -> jax.Array:
        qpos = self._with_joint(physics.qpos, self._draw(rng, self.joint_targets))
        return object_goal(self._chain.site(qpos))

    def add_sensor_noise(self, physics: Any, errors: SensorErrors) -> Any:
        seen: Any = super().add_sensor_noise(physics, errors)
        return seen.replace(site_error=jnp.stack([errors.object, errors.object_motion]))

    def _with_joint(self, qpos: jax.Array, position: jax.Array) -> jax.Array:
        return qpos.at[self.qpos_of(self.object_name)].set(position)

    def _draw(self, rng: jax.Array, bounds: tuple[float, float]) -> jax.Array:
        return jax.random.uniform(rng, (), minval=bounds[0], maxval=bounds[1])
