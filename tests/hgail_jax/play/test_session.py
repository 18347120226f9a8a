"""A session, held to what MuJoCo's own kinematics say of the scene that it poses."""

import jax
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.scenes import assets_directory
from hgail_jax.io.policy import load_policy
from hgail_jax.play.session import Phase, Session
from hgail_jax.policy import MeanPolicy


@pytest.fixture(scope="module")
def reach(shipped_policy):
    return Session(hgail_envs.make("reach", impl="c"), load_policy(shipped_policy))


@pytest.fixture(scope="module")
def grasp(grasp_policy):
    return Session(hgail_envs.make("grasp", impl="c"), load_policy(grasp_policy))


def idle(env):
    """A policy that does nothing."""
    size = env.observation_size
    layer = np.zeros((size, env.action_size), np.float32), np.zeros(env.action_size, np.float32)
    return MeanPolicy("reach", env.goal_size, np.zeros(size, np.float32), np.ones(size, np.float32), (layer,))


def finish(session):
    """Continues to the end of the episode; returns how many actions it took."""
    episodes, steps = session.status.episodes, 0
    while session.status.episodes == episodes:
        session.step()
        steps += 1
    session.pose()
    return steps


def start(session):
    return np.asarray(session._state.obs)


def test_episodes_follow_one_another_until_the_target_is_moved(reach):
    reach.restart(3)
    targets = []
    for episode in (1, 2):
        targets.append(reach.target)
        assert finish(reach) == reach.env.episode_length
        assert np.linalg.norm(reach.data.site("grip").xpos - reach.target) < reach.env.success_threshold
        status = reach.status
        assert (status.phase, status.success, status.episodes, status.successes) == (
            Phase.RESTING,
            True,
            episode,
            episode,
        )
        np.testing.assert_allclose(
            status.distance, np.linalg.norm(reach.data.site("grip").xpos - reach.target), atol=1e-4
        )
        rest = reach.data.qpos.copy()
        for _ in range(24):
            reach.step()
        reach.pose()
        np.testing.assert_array_equal(reach.data.qpos, rest)
        reach.step()
        assert reach.status.phase is Phase.ACTING
    assert np.abs(targets[0] - targets[1]).max() > 0.01


def test_a_start_is_its_seed_s(reach):
    starts = []
    for seed in (5, 5, 6):
        reach.restart(seed)
        assert reach.status.episodes == reach.status.successes == 0
        starts.append([start(reach)])
        reach.restart()
        starts[-1].append(start(reach))
    np.testing.assert_array_equal(starts[0], starts[1])
    assert np.abs(starts[0][0] - starts[0][1]).max() > 1e-3
    assert np.abs(starts[0][0] - starts[2][0]).max() > 1e-3


def test_the_policy_follows_the_target_and_stays(reach):
    reach.restart(0)
    middle = reach.env.initial_gripper_position
    for corner in (middle - 0.12, middle + 0.12):
        for _ in range(7):
            reach.step()
        reach.move_target(corner)
        assert not reach.status.reached
        assert finish(reach) == reach.env.episode_length  # which starts anew
        for _ in range(60):
            assert reach.status.phase is Phase.STAYING
            assert reach.status.success
            reach.step()
        reach.pose()
        assert np.linalg.norm(reach.data.site("grip").xpos - corner) < reach.env.success_threshold
        np.testing.assert_allclose(reach.model.site("target").pos, corner, atol=1e-6)
    reach.restart()
    assert np.abs(reach.target - corner).max() > 1e-3
    assert reach.status.phase is Phase.ACTING


def test_the_target_stays_where_goals_are(reach):
    middle = reach.env.initial_gripper_position
    np.testing.assert_allclose(reach.bounds, [middle - 0.15, middle + 0.15], atol=2e-3)
    reach.move_target(middle + np.array([0.05, -9.0, 9.0]))
    np.testing.assert_allclose(reach.target, middle + np.array([0.05, -0.15, 0.15]), atol=2e-3)


def test_after_a_failure_the_next_episode_has_the_target_where_it_was_put(reach):
    session = Session(reach.env, idle(reach.env))
    session.move_target(session.bounds[1])
    session.step()
    before = start(session)
    finish(session)
    assert (session.status.phase, session.status.success, session.status.successes) == (Phase.RESTING, False, 0)
    for _ in range(25):
        session.step()
    assert session.status.phase is Phase.ACTING
    np.testing.assert_allclose(session.target, session.bounds[1], atol=1e-6)
    np.testing.assert_allclose(start(session)[:3], reach.env.initial_gripper_position, atol=1e-3)
    np.testing.assert_allclose(before[6:], start(session)[6:])


def test_a_cube_that_is_dragged_is_grasped_and_lifted(grasp):
    grasp.restart(1)
    assert grasp.bounds[0][2] == grasp.bounds[1][2] == pytest.approx(0.425)  # on the table
    place = np.array([1.22, 0.87, 0.6])
    for _ in range(3):
        grasp.step()
    grasp.move_target(place)
    grasp.pose()
    place[2] = 0.425
    np.testing.assert_allclose(grasp.data.body("cube").xpos, place, atol=1e-5)
    np.testing.assert_allclose(grasp.target, place, atol=1e-5)
    for _ in range(2):  # the second from the start
        assert finish(grasp) == grasp.env.episode_length + grasp.env.lift_test_steps
        assert grasp.data.body("cube").xpos[2] > place[2] + 0.05
        assert grasp.status.success
        assert grasp.status.phase is Phase.RESTING
        for _ in range(25):
            grasp.step()
        grasp.pose()
        np.testing.assert_allclose(grasp.data.body("cube").xpos, place, atol=1e-5)
    assert grasp.status.successes == 2


def test_a_cube_that_is_dragged_out_of_a_lifted_hand_is_grasped_from_the_start(grasp):
    grasp.restart(2)
    finish(grasp)
    place = np.array([1.45, 0.65, 0.425])
    grasp.move_target(place)
    np.testing.assert_allclose(start(grasp)[:3], grasp.env.initial_gripper_position, atol=1e-3)
    finish(grasp)
    assert grasp.status.success


def test_a_pose_lies_between_two_states(grasp):
    grasp.restart(0)
    for _ in range(8):
        grasp.step()
    poses = []
    for fraction in (0.0, 0.5, 1.0):
        grasp.pose(fraction)
        poses.append(grasp.data.qpos.copy())
    cube = grasp.model.joint("cube").qposadr[0]
    assert np.abs(poses[0][:cube] - poses[2][:cube]).max() > 1e-3
    np.testing.assert_allclose(poses[1][:cube], (poses[0][:cube] + poses[2][:cube]) / 2, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(poses[1][cube + 3 : cube + 7]), 1.0)
    np.testing.assert_allclose(poses[2], np.asarray(grasp._state.pipeline_state.qpos), atol=1e-6)


def test_a_simulation_that_breaks_down_starts_anew(reach):
    reach.restart(0)
    physics = reach._state.pipeline_state
    reach._state = reach._state.replace(pipeline_state=physics.replace(qvel=physics.qvel.at[5].set(1e12)))
    reach.step()
    assert np.isfinite(start(reach)).all()
    assert reach.status.episodes == 0
    finish(reach)
    assert reach.status.success


SHIPPED = {path.stem for path in (assets_directory() / "policies").glob("*.npz")}
OTHERS = sorted(SHIPPED & set(hgail_envs.TASKS) - {"reach", "grasp", "tower"})


@pytest.mark.parametrize(
    "task", [pytest.param(task, marks=() if task == "push" else pytest.mark.slow) for task in OTHERS]
)
def test_a_policy_that_is_shipped_follows_a_target_that_is_moved(task):
    """Of three targets it comes to two at least, by where MuJoCo has the body that the goal is about."""
    session = Session(hgail_envs.make(task, impl="c"), load_policy(assets_directory() / "policies" / f"{task}.npz"))
    generator, reached = np.random.default_rng(0), 0
    for _ in range(3):
        session.restart()
        place = generator.uniform(*session.bounds)
        session.move_target(place)
        finish(session)
        np.testing.assert_allclose(session.target, place, atol=1e-6)
        free = session.model.joint(np.flatnonzero(session.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0]).bodyid[0]
        near = np.linalg.norm(session.data.xpos[free] - place) < session.env.success_threshold
        assert near == session.status.success
        reached += near
    assert reached >= 2


@pytest.mark.slow
def test_the_tower_is_built_where_its_lowest_cube_is_put():
    """Of three towers two stand at least, by where MuJoCo has the cubes."""
    session = Session(hgail_envs.make("tower", impl="c"), load_policy(assets_directory() / "policies" / "tower.npz"))
    bodies = session.model.joint(np.flatnonzero(session.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0]).bodyid[0]
    cubes = slice(bodies, bodies + 3)
    generator, built = np.random.default_rng(0), 0
    for _ in range(3):
        session.restart()
        place = generator.uniform(*session.bounds)
        session.move_target(place)
        np.testing.assert_allclose(session.target[:2], place[:2], atol=1e-6)
        finish(session)
        positions = session.data.xpos[cubes]
        heights = np.sort(positions[:, 2]) - positions[:, 2].min()
        stands = np.allclose(heights, [0, 0.05, 0.1], atol=0.015) and np.ptp(positions[:, :2], axis=0).max() < 0.05
        assert stands == session.status.success
        built += stands and np.linalg.norm(positions[:, :2] - place[:2], axis=1).max() < 0.06
    assert built >= 2


def test_a_task_without_a_scene_is_refused():
    env = hgail_envs.make("point")
    with pytest.raises(ValueError, match="no scene"):
        Session(env, idle(env))


def test_moving_the_target_changes_nothing_else(reach):
    env = reach.env
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), np.ones(4))
    moved = env.move_target(state, np.array([1.3, 0.7, 0.5]))
    np.testing.assert_array_equal(moved.obs[:6], state.obs[:6])
    np.testing.assert_allclose(moved.obs[6:], [1.3, 0.7, 0.5])
    assert moved.pipeline_state is state.pipeline_state
