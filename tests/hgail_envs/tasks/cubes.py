"""Scenes of stack and tower with cubes put down by hand, simulated by C MuJoCo."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.stats import kstest, uniform

import hgail_envs
from hgail_jax.rollout import rollout

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
MANY = 3000
SIDES = ("right", "left")


class CubeScene:
    """A task's scene, with the programs that its tests share."""

    def __init__(self, task):
        self.env = env = hgail_envs.make(task, impl="c", substeps=8)
        self.model = env.model
        joints = [self.model.joint(index).name for index in range(self.model.njnt)]
        self.names = [name for name in joints if name.startswith("cube")]
        self.cubes = [int(self.model.joint(name).qposadr[0]) for name in self.names]
        self.velocities = [int(self.model.joint(name).dofadr[0]) for name in self.names]
        self.fingers = [int(self.model.joint(f"{side}_finger").qposadr[0]) for side in SIDES]
        self.step, self.outcome, self.achieved = (jax.jit(each) for each in (env.step, env.outcome, env.achieved_goal))
        self.put = jax.jit(env.place)
        self._advance = jax.jit(lambda start, physics, plan: env._advance(start, physics, plan, start.info["step"]))

    @functools.cached_property
    def begun(self):
        """The start of an episode."""
        return jax.jit(self.env.reset)(jax.random.key(0))

    @functools.cached_property
    def starts(self):
        """Starts of `MANY` episodes to be measured and of as many to learn from."""
        reset = jax.jit(jax.vmap(self.env.reset, in_axes=(0, None)))
        keys = jax.random.split(jax.random.key(0), MANY)
        return [jax.tree.map(np.asarray, reset(keys, training_goals)) for training_goals in (False, True)]

    @functools.cache  # noqa: B019  (a scene lives as long as its tests)
    def _arm(self, hand):
        start = self.env.robot.settle().site("grip").xpos
        return self.env.robot.settle(offset=np.subtract(hand, start)).qpos.copy()

    def data(self, hand, places, velocities=None, gap=None):
        """Returns MuJoCo's data with an arm at rest whose gripper is at `hand`, and cubes upright at `places`."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self._arm(tuple(hand))
        if gap is not None:
            data.qpos[self.fingers] = gap / 2
        for index, place in enumerate(places):
            data.qpos[self.cubes[index] :][:7] = [*place, *UPRIGHT]
            if velocities is not None:
                data.qvel[self.velocities[index] :][:6] = velocities[index]
        mujoco.mj_forward(self.model, data)
        return data

    def state(self, data, plan=None, **changes):
        """Returns the state of an episode with this data, and changes of its physics."""
        physics = self.put(data.qpos, data.qvel)
        physics = physics.replace(sensordata=jnp.asarray(data.sensordata, jnp.float32), **changes)
        return self._advance(self.begun, physics, self.begun.info["plan"] if plan is None else plan)

    def forward(self, physics):
        """Returns MuJoCo's data of a state's joints."""
        data = mujoco.MjData(self.model)
        data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
        mujoco.mj_forward(self.model, data)
        return data

    def by_role(self, physics, of="qpos", size=3):
        """Returns numbers of the cubes, `[..., cubes, size]`, of `qpos` or `qvel`; a tower's top is first."""
        values, first = (physics.qpos, self.cubes) if of == "qpos" else (physics.qvel, self.velocities)
        each = np.stack([values[..., index : index + size] for index in first], axis=-2)
        if not hasattr(physics, "order"):
            return each
        return np.take_along_axis(each, np.asarray(physics.order)[..., None], axis=-2)

    def outcome_of(self, state):
        """Returns the outcome of an episode that ends in a state, with the test that the tower stands."""
        action, later = jnp.full(4, -1.0), state
        for _ in range(self.env.lift_test_steps):
            action = self.env.lift_test_action(action)
            later = self.step(later, action)
        return self.outcome(state, later)

    def after_ten_seconds(self, data, substeps):
        """Simulates with the hand at rest; returns of each cube displacement and turn, `[cubes, 6]`, at their most."""
        start, period = data.qpos.copy(), self.model.opt.timestep
        data.mocap_pos[0], data.mocap_quat[0] = data.body("gripper").xpos, data.body("gripper").xquat
        try:
            self.model.opt.timestep = 0.04 / substeps
            mujoco.mj_step(self.model, data, nstep=250 * substeps)
        finally:
            self.model.opt.timestep = period
        moved = data.qpos - start
        return np.array([[*moved[first : first + 3], *data.qpos[first + 4 : first + 7]] for first in self.cubes])


def is_left(cube, velocity, gripper, gap):
    """Returns whether cubes, `[..., 3]`, are left; velocities are in metres per second."""
    away = np.linalg.norm(cube - gripper, axis=-1) >= 0.05
    return away & (gap >= 0.08) & (np.linalg.norm(velocity, axis=-1) <= 0.05)


def is_in_place(apart):
    """Returns whether a cube, `[..., 3]` from its place on another, is on it."""
    return (np.hypot(apart[..., 0], apart[..., 1]) <= 0.025) & (np.abs(apart[..., 2]) <= 0.01)


def check_goals_elsewhere(scene, elsewhere):
    """Training goals `elsewhere`, `[MANY]`, an eighth, are at random places of the gripper and of each cube alike."""
    goal, flags = scene.starts[1].info["desired_goal"], np.eye(len(scene.cubes) + 1)[:, :-1]
    assert abs(elsewhere.mean() - 0.125) < 0.025
    for whose in flags:
        chosen = goal[elsewhere & (goal[:, 3:-1] == whose).all(axis=1)]
        assert abs(len(chosen) / MANY - 0.125 / len(flags)) < 0.015
        assert not chosen[:, -1].any()
        offset = chosen[:, :3] - scene.env.initial_gripper_position
        for axis in range(2):
            assert kstest(offset[:, axis], uniform(-0.15, 0.3).cdf).pvalue > 1e-4
        assert np.allclose(chosen[:, 2], 0.425, atol=2e-4) if whose.any() else (np.ptp(chosen[:, 2]) > 0.1)


def check_that_features_suffice_to_test_goals(scene, to_leave, count):
    """A buffer's goals: by brute force, whether a cube has moved or not; the first `to_leave` cubes may be left."""
    env, rng, cubes = scene.env, np.random.default_rng(0), len(scene.cubes)
    physics = jax.tree.map(lambda leaf: leaf[:count].copy(), scene.starts[0].pipeline_state)
    physics.qpos[:, scene.fingers] = rng.choice([0.035, 0.05], (count, 1))
    whose, near = rng.integers(cubes + 1, size=count), rng.random(count) < 0.3  # the last is the gripper
    velocity = rng.normal(scale=0.02, size=(count, 3)).astype(np.float32)
    numbers = physics.order[np.arange(count), whose % cubes] if hasattr(physics, "order") else whose % cubes
    for index, cube in enumerate(numbers):
        if near[index]:
            physics.qpos[index, scene.cubes[cube] :][:3] = physics.gripper_position[index] + [0.0, 0.0, -0.02]
        physics.qvel[index, scene.velocities[cube] :][:3] = velocity[index]
    positions = np.concatenate([scene.by_role(physics), physics.gripper_position[:, None]], axis=1)
    position, shift = positions[np.arange(count), whose], rng.normal(scale=[0.02, 0.02, 0.01], size=(count, 3))
    wanted = (whose < to_leave) & (rng.random(count) < 0.5)
    flags = np.column_stack([np.eye(cubes + 1)[whose][:, :-1], wanted])
    goals = np.column_stack([position + shift, flags]).astype(np.float32)
    left = is_left(position, velocity, physics.gripper_position, physics.qpos[:, scene.fingers].sum(axis=1))
    as_wanted = (whose >= to_leave) | (left == wanted)
    near_enough = np.where(wanted, is_in_place(shift), np.linalg.norm(shift, axis=1) <= 0.05)
    features, achieved = jax.jit(jax.vmap(lambda one: (env.features(one), env.achieved_goal(one))))(physics)
    expected = near_enough & as_wanted
    np.testing.assert_array_equal(jax.jit(env.goal_test)(features, achieved, goals), expected)
    np.testing.assert_array_equal(jax.jit(jax.vmap(env.reached))(physics, goals), expected)
    assert all(0.05 < expected[(flags == kind).all(axis=1)].mean() < 0.99 for kind in np.unique(flags, axis=0))
    solved = (whose < cubes) & (np.linalg.norm(shift, axis=1) <= 0.03) & as_wanted
    np.testing.assert_array_equal(jax.jit(env.already_solved)(features, goals), solved)


def explored(scene):
    """Returns 256 episodes of the scripted hand with a noise of .1 on its actions."""

    def noisy(observation, rng):
        action = scene.env.controllers["from-above"](observation)
        return action + 0.1 * jax.random.normal(rng, action.shape), jnp.zeros(len(action))

    return jax.jit(lambda rng: rollout(scene.env, noisy, rng, 256))(jax.random.key(1))
