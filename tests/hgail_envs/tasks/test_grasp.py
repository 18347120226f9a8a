"""The grasp scene and task, against scripted controllers and Gymnasium-Robotics' FetchPickAndPlace-v4."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.tasks.grasp import Grasp
from hgail_envs.tasks.reference import ReferenceFetch, make_reference, reference_episode

BATCH = 16
STEPS = 100
ENV = hgail_envs.make("grasp", substeps=8)
STILL, ABOVE, CLOSED, LIFT = range(4)


def act(kind, observation):
    lift = jnp.tile(jnp.array([0.0, 0.0, 1.0, -1.0]), (BATCH, 1))
    choices = (
        jnp.zeros((BATCH, 4)),
        Grasp.controllers["from-above"](observation),
        Grasp.controllers["closed"](observation),
        lift,
    )
    return jnp.stack(choices)[kind]


@jax.jit
def play(kind, state):
    """Runs a batch for `STEPS` under one way to act; returns the states after each, time first."""

    def step(state, _):
        state = jax.vmap(ENV.step)(state, act(kind, state.obs))
        return state, state

    return jax.lax.scan(step, state, None, STEPS)[1]


@pytest.fixture(scope="module")
def start():
    return jax.jit(jax.vmap(ENV.reset))(jax.random.split(jax.random.key(0), BATCH))


@pytest.fixture(scope="module")
def above(start):
    return play(ABOVE, start)


def at(states, time):
    return jax.tree.map(lambda leaf: leaf[time], states)


def cube(states):
    return np.asarray(states.pipeline_state.qpos[..., ENV.qpos_of("cube")])


def holding(states):
    return np.asarray(states.info["features"][..., 7]) > 0.5


def outcome(end, lifted):
    return jax.tree.map(np.asarray, jax.vmap(ENV.outcome)(end, lifted))


@pytest.fixture(scope="module")
def reference():
    return make_reference("FetchPickAndPlace-v4", max_episode_steps=1000)


def test_a_cube_at_rest_stays_at_rest(start):
    """It sinks into the table by what the contact yields, 0.3 mm, and neither slides nor tips."""
    states = play(STILL, start)
    moved = np.abs(cube(states) - cube(start))
    assert moved[..., :2].max() <= 1e-5
    assert moved[..., 2].max() <= 5e-4
    turn = states.pipeline_state.qpos[..., ENV.qpos_of("cube").stop : ENV.qpos_of("cube").stop + 4]
    np.testing.assert_allclose(np.abs(turn[..., 0]), 1.0, atol=1e-5)
    assert np.isfinite(np.asarray(states.obs)).all()
    assert not holding(states).any()


def test_coming_from_above_grasps_every_cube_and_holds_it(above):
    assert holding(at(above, 49)).all()
    assert holding(above)[50:100].all()
    drift = (cube(above) - np.asarray(above.info["achieved_goal"][..., :3]))[[49, 99]]
    moved = np.abs(drift[1] - drift[0]).max(-1)
    assert moved.max() <= 2e-3


def test_success_takes_a_lift(start, above):
    """A held cube rises in the lift test, one that is not held stays, and without the test neither is a success."""
    end = at(above, 49)
    lifted = at(play(LIFT, end), ENV.lift_test_steps - 1)
    assert outcome(end, lifted).success.all()
    assert (cube(lifted)[:, 2] - cube(end)[:, 2] > 0.2).all()
    assert outcome(lifted, lifted).success.all()  # one that is up already need not rise further
    untested = outcome(end, end)
    assert untested.achieved.all()
    assert not untested.success.any()
    assert not outcome(start, at(play(LIFT, start), ENV.lift_test_steps - 1)).success.any()
    np.testing.assert_allclose(
        outcome(end, lifted).distance_l1, np.abs(np.asarray(end.obs[:, :3]) - cube(end)).sum(-1), rtol=1e-4
    )


def test_a_closed_hand_grasps_nothing(start):
    assert not holding(play(CLOSED, start)).any()


def test_starts_are_the_reference_s(reference):
    ours = cube(jax.jit(jax.vmap(ENV.reset))(jax.random.split(jax.random.key(1), 2000)))
    theirs = np.stack([reference.reset(seed=seed)[0]["observation"][3:6] for seed in range(300)])
    offsets = [cubes[:, :2] - ENV.initial_gripper_position[:2] for cubes in (ours, theirs)]
    for offset in offsets:
        assert np.abs(offset).max() <= 0.151
        assert np.linalg.norm(offset, axis=-1).min() >= 0.099
    np.testing.assert_allclose(offsets[0].mean(0), offsets[1].mean(0), atol=0.022)  # 3.5 standard errors
    np.testing.assert_allclose(offsets[0].std(0), offsets[1].std(0), atol=0.012)
    np.testing.assert_allclose(ours[:, 2], theirs[:, 2].mean(), atol=1e-3)
    observation = reference.reset(seed=0)[0]["observation"]
    np.testing.assert_allclose(ENV.initial_gripper_position, observation[:3], atol=5e-4)


def test_moving_the_target_puts_the_cube_down():
    """Out of the hand and thrown about, in MuJoCo's own kinematics; the arm and its motion are left as they are."""
    env, place = hgail_envs.make("grasp"), np.array([1.4, 0.7, 0.425])
    state = jax.jit(env.reset)(jax.random.key(0))
    data = mujoco.MjData(env.model)
    cube = env.model.body("cube").dofadr[0]
    physics = state.pipeline_state
    tumbling, tilted = np.array(physics.qvel), np.array(physics.qpos)
    tumbling[cube : cube + 6], tumbling[4], tilted[-7:] = 3.0, 0.1, [1.3, 0.7, 0.8, 0.0, 1.0, 0.0, 0.0]
    physics = physics.replace(qpos=tilted, qvel=tumbling, sensordata=np.ones(2, np.float32))
    moved = jax.jit(env.move_target)(state.replace(pipeline_state=physics), place)
    data.qpos[:], data.qvel[:] = moved.pipeline_state.qpos, moved.pipeline_state.qvel
    mujoco.mj_forward(env.model, data)
    np.testing.assert_allclose(data.body("cube").xpos, place, atol=1e-6)
    np.testing.assert_allclose(data.body("cube").xmat, np.eye(3).flatten(), atol=1e-6)
    np.testing.assert_array_equal(data.body("cube").cvel, 0.0)
    np.testing.assert_array_equal(data.qvel[:cube], tumbling[:cube])
    np.testing.assert_array_equal(data.qpos[:-7], tilted[:-7])
    np.testing.assert_array_equal(data.qpos[-4:], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(moved.info["desired_goal"], [*place, 1.0], atol=1e-6)
    np.testing.assert_allclose(moved.obs[8:], [*place, 1.0], atol=1e-6)
    assert moved.obs[7] == 0.0  # nothing is held


@jax.jit
def pushed(state):
    """Returns the states after a push of the cube, 8 cm along x, and a step."""
    moved = state.pipeline_state.qpos.at[:, ENV.qpos_of("cube").start].add(0.08)
    return jax.vmap(ENV.step)(
        state.replace(pipeline_state=state.pipeline_state.replace(qpos=moved)), jnp.zeros((BATCH, 4))
    )


def test_a_tracked_cube_is_the_goal_wherever_it_is(start):
    after, tracked = pushed(start), hgail_envs.make("grasp", substeps=8, cube="tracked")
    elsewhere = jnp.array([1.0, 0.7, 0.6, 0.0])
    for index in range(3):
        state = at(after, index)
        goal, plan = state.info["desired_goal"], at(start, index).info["plan"]
        np.testing.assert_array_equal(goal, plan)
        np.testing.assert_array_equal(tracked.current_goal(plan, state.pipeline_state, 1), [*cube(state), 1.0])
        np.testing.assert_array_equal(tracked.current_goal(elsewhere, state.pipeline_state, 1), elsewhere)
        assert cube(state)[0] > goal[0] + 0.07


def test_a_tracked_cube_is_observed_whatever_the_goal_is(start):
    after, tracked = pushed(start), hgail_envs.make("grasp", substeps=8, cube="tracked")
    features = np.asarray(jax.vmap(tracked.features)(after.pipeline_state))
    np.testing.assert_array_equal(features[:, :8], after.info["features"])
    np.testing.assert_allclose(features[:, 8:], cube(after) - features[:, :3], atol=1e-6)
    assert tracked.observation_size == ENV.observation_size + 3


@pytest.mark.slow
def test_a_hand_that_tracks_the_cube_tries_again(start):
    """The scripted hand goes where the goal is: to the place where the cube was, or to the cube."""
    tracked = hgail_envs.make("grasp", substeps=8, cube="tracked")

    def grasped(env, state):
        act, step = env.controllers["from-above"], jax.vmap(env.step)
        still = jnp.zeros((BATCH, 4))
        run = jax.jit(lambda state: jax.lax.fori_loop(0, STEPS, lambda _, now: step(now, act(now.obs)), state))
        return holding(run(jax.jit(step)(state, still)))

    after = pushed(start)
    assert not grasped(ENV, after).any()
    assert grasped(tracked, after).mean() > 0.9


def test_the_reference_shows_where_a_tracked_cube_is():
    """A closed hand pushes the cube away; what it observes follows, and agrees with the environment's own state."""
    reference, seen = ReferenceFetch("grasp", cube="tracked"), []

    def policy(observation):
        seen.append(observation)
        cubes.append(reference.data.body("object0").xpos.copy())
        return np.asarray(Grasp.controllers["closed"](np.delete(observation, slice(8, 11))))

    cubes = []
    reference_episode(reference, policy, Past(Randomization()), seed=1, index=0)
    seen = np.array(seen)
    assert seen.shape[1] == 15 and np.linalg.norm(cubes[-1] - cubes[0]) > 0.02
    np.testing.assert_allclose(seen[:, 11:14], cubes, atol=1e-6)
    np.testing.assert_allclose(seen[:, 8:11], seen[:, 11:14] - seen[:, :3], atol=1e-6)
    with pytest.raises(ValueError, match="cube is 'tracked'; choose from at-start"):
        ReferenceFetch("push", cube="tracked")


def test_a_cube_that_is_seen_otherwise_is_refused():
    with pytest.raises(ValueError, match="'seen'; choose from at-start, tracked"):
        hgail_envs.make("grasp", cube="seen")


@pytest.mark.parametrize("task", ["grasp", "pick-and-place", "stack", "tower"])
def test_a_cube_between_pads_that_have_turned_far_is_not_held(task, monkeypatch):
    """The gap is at the middles of the pads; elsewhere they are closer. The cube's width, 5 cm, is between the two."""
    env = hgail_envs.make(task, impl="c")
    physics = jax.tree.map(jnp.asarray, env._initial_physics)  # a reset draws, in many small programs
    physics = physics.replace(sensordata=jnp.ones_like(physics.sensordata))
    for gap, narrowest, held in ((0.06, 0.05, True), (0.06, 0.06, False), (0.041, 0.03, False), (0.065, 0.045, False)):
        monkeypatch.setattr(env.robot, "gap", lambda qpos, gap=gap: gap)
        monkeypatch.setattr(env.robot, "narrowest_gap", lambda qpos, narrowest=narrowest: narrowest)
        assert bool(env.holding(physics)) == held
