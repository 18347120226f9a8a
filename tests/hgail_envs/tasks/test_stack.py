"""Stacking: its goals against plain NumPy, its strict success against states of C MuJoCo made by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

import hgail_envs
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_jax.play.recording import run_controller
from tests.hgail_envs.tasks.cubes import (
    MANY,
    CubeScene,
    check_goals_elsewhere,
    check_that_features_suffice_to_test_goals,
    explored,
    is_in_place,
)

SCENE = CubeScene("stack")
ENV, MODEL, FINGERS = SCENE.env, SCENE.model, SCENE.fingers
A, B = SCENE.cubes
PLACE = np.array([1.3, 0.7, 0.425])  # where cube B started, centre
GOAL = np.array([*PLACE[:2], 0.475, 1, 0, 1], np.float32)


def made(a=(0.0, 0.0, 0.0), b=(0.0, 0.0, 0.0), rise=0.12, gap=0.1, velocity=(0.0,) * 6, b_velocity=0.0):
    """Returns a state made by hand: cube A and cube B so far from their places in the tower, metres."""
    places = [np.add(GOAL[:3], a) - [0, 0, 2e-4], np.add(PLACE, b)]
    velocities = [velocity, [b_velocity, 0.0, 0.0, 0.0, 0.0, 0.0]]
    data = SCENE.data(np.add(GOAL[:3], [0.0, 0.0, rise]), places, velocities, gap)
    plan = SCENE.begun.info["plan"].replace(goal=jnp.asarray(GOAL), relay=jnp.asarray(False))
    starts = {"object_start": jnp.array([1.2, 0.9, 0.425]), "b_start": jnp.asarray(PLACE, jnp.float32)}
    return SCENE.state(data, plan, **starts)


@pytest.mark.parametrize("aside", [(0.0, 0.0), (0.015, 0.0), (0.0, -0.015), (0.01, 0.01)])
@pytest.mark.parametrize("substeps", [20, 8])
def test_a_tower_stays_for_ten_seconds(aside, substeps):
    data = SCENE.data(np.add(GOAL[:3], [0.0, 0.0, 0.12]), [np.add(GOAL[:3], [*aside, 0.0]), PLACE])
    ends = np.abs(SCENE.after_ten_seconds(data, substeps))
    assert ends[:, :3].max() < 2e-3
    assert ends[:, 3:].max() < 0.01


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"a": (0.015, -0.012, 0.0)},
        {"rise": 0.052},  # and 4 cm after the test, for the hand sinks
        {"gap": 0.082},
        {"velocity": (0.0, 0.04, 0.0, 0.0, 0.0, 0.0)},
        {"a": (0.02, 0.0, 0.0), "b": (0.02, 0.0, 0.0)},  # the goal is within reach of both
        {"a": (0.02, 0.0, 0.0), "b": (0.035, 0.0, 0.0)},
    ],
)
def test_a_tower_that_stands_alone_is_a_success(changes):
    outcome = SCENE.outcome_of(made(**changes))
    assert (outcome.success, outcome.achieved) == (1.0, 1.0)
    np.testing.assert_allclose(outcome.distance_l2, np.linalg.norm(changes.get("a", 0.0)), atol=3e-4)


VIOLATIONS = {
    "A beside B, on the table": {"a": (0.052, 0.0, -0.05)},
    "A beside B, at its height": {"a": (0.06, 0.0, 0.0)},
    "A too far aside": {"a": (0.026, 0.0, 0.0)},
    "A too far aside of B alone": {"b": (0.026, 0.0, 0.0)},
    "A too high": {"a": (0.0, 0.0, 0.011)},
    "A does not touch B": {"a": (0.0, 0.0, 0.005)},
    "the hand near": {"rise": 0.048},
    "the hand at A, open": {"rise": 0.0},
    "the hand holds A": {"rise": 0.0, "gap": 0.046},
    "the hand closed": {"gap": 0.0},
    "the hand hardly open": {"gap": 0.078},
    "A not at rest": {"velocity": (0.0, 0.06, 0.0, 0.0, 0.0, 0.0)},
    "B moved": {"a": (0.05, 0.0, 0.0), "b": (0.05, 0.0, 0.0)},
    "B moved away": {"a": (0.0, 0.0, 0.0), "b": (0.0, 0.1, 0.0)},
}


@pytest.mark.parametrize("changes", VIOLATIONS.values(), ids=VIOLATIONS.keys())
def test_a_single_violation_is_no_success(changes):
    """It is none at the end, whatever the test of the tower would set right: it opens the hand."""
    outcome = SCENE.outcome_of(made(**changes))
    assert (outcome.success, outcome.achieved) == (0.0, 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"b_velocity": 1.5},  # cube B slides away from below
        {"b_velocity": -1.5},
        {"a": (0.024, 0.0, 0.0), "velocity": (0.0, 0.0, 0.0, 0.0, 8.0, 0.0)},  # cube A tips over the edge
    ],
)
def test_a_tower_that_falls_in_the_test_is_achieved_and_no_success(changes):
    state = made(**changes)
    outcome = SCENE.outcome_of(state)
    assert (outcome.success, outcome.achieved) == (0.0, 1.0)
    assert SCENE.outcome(state, state).success == 1.0  # without the test, as in training


def test_success_is_what_c_mujoco_s_contacts_and_positions_say():
    """Of random states, many of which are near a limit."""
    rng, found = np.random.default_rng(0), []
    for _ in range(100):
        a, b = (rng.uniform(-1, 1, 3) * scale for scale in ([0.03, 0.01, 0.012], [0.03, 0.01, 0.0]))
        state = made(a=a, b=b, rise=rng.choice([0.045, 0.06, 0.12]), gap=rng.choice([0.075, 0.085, 0.1]))
        data = SCENE.forward(state.pipeline_state)
        cubes = {MODEL.geom(name).id for name in ("cube_a", "cube_b")}
        touch = any(set(pair) == cubes for pair in data.contact.geom)
        place = np.add(data.body("cube_b").xpos, [0, 0, 0.05])
        at = is_in_place(data.body("cube_a").xpos - [place, GOAL[:3]])
        away = np.linalg.norm(data.site("grip").xpos - data.body("cube_a").xpos) >= 0.05
        is_open = data.qpos[FINGERS].sum() >= 0.08
        found.append((all(at) and touch and away and is_open, bool(SCENE.outcome(state, state).achieved)))
    expected, ours = np.transpose(found)
    np.testing.assert_array_equal(ours, expected)
    assert 10 < expected.sum() < 90


def test_starts_are_those_of_a_loop():
    """Of pick and place for cube A; cube B by rejection, one after another."""
    physics, rng, loop = SCENE.starts[0].pipeline_state, np.random.default_rng(0), []
    while len(loop) < MANY:
        a = rng.uniform(-0.15, 0.15, 2)
        if np.hypot(*a) < 0.1:
            continue
        while True:
            b = rng.uniform(-0.15, 0.15, 2)
            if np.hypot(*b) >= 0.1 and np.hypot(*(a - b)) >= 0.1:
                break
        loop.append([*a, *b, np.hypot(*(a - b))])
    a, b = (physics.qpos[:, first : first + 2] - ENV.initial_gripper_position[:2] for first in (A, B))
    apart = np.linalg.norm(a - b, axis=1)
    ours = np.column_stack([a, b, apart])
    for column, theirs in zip(ours.T, np.transpose(loop), strict=True):
        assert ks_2samp(column, theirs).pvalue > 1e-4
    assert min(apart.min(), np.linalg.norm(a, axis=1).min(), np.linalg.norm(b, axis=1).min()) >= 0.1 - 1e-6
    for first, start in ((A, physics.object_start), (B, physics.b_start)):
        np.testing.assert_array_equal(start, physics.qpos[:, first : first + 3])
        np.testing.assert_allclose(start[:, 2], 0.425, atol=2e-4)
    assert np.abs(physics.qpos[:, FINGERS]).max() < 1e-3


def test_cubes_of_other_sizes_start_on_the_table():
    env = RandomizedEnv(ENV, Randomization(object_size=(1.2, 1.4)))
    physics = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 20)).pipeline_state.true
    height = 0.4 + 0.025 * np.asarray(physics.factors.object_size)
    for first, start in ((A, physics.object_start), (B, physics.b_start)):
        np.testing.assert_array_equal(start, physics.qpos[:, first : first + 3])
        np.testing.assert_allclose(start[:, 2], height, atol=3e-4)


def test_the_evaluation_s_goal_is_cube_a_left_on_cube_b_s_start():
    state = SCENE.starts[0]
    start = state.pipeline_state.qpos[:, B : B + 3]
    expected = np.column_stack([np.add(start, [0, 0, 0.05]), np.tile([1, 0, 1], (MANY, 1))])
    np.testing.assert_allclose(state.info["desired_goal"], expected, atol=1e-6)
    np.testing.assert_array_equal(state.obs[:, 26:], state.info["desired_goal"])
    assert not state.info["plan"].relay.any()
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), state)
    far = one.pipeline_state.replace(qpos=one.pipeline_state.qpos.at[B].add(0.1))
    for step in (0, 50, 100):
        np.testing.assert_array_equal(ENV.current_goal(one.info["plan"], far, step), one.info["desired_goal"])


def test_an_eighth_of_the_training_goals_is_elsewhere_and_half_are_relays():
    state = SCENE.starts[1]
    plan, physics, goal = state.info["plan"], state.pipeline_state, state.info["desired_goal"]
    assert abs(plan.relay.mean() - 0.5) < 0.04
    np.testing.assert_allclose(goal[plan.relay], np.pad(physics.qpos[plan.relay, A : A + 3], ((0, 0), (0, 3))))
    np.testing.assert_array_equal(goal[~plan.relay], plan.goal[~plan.relay])
    check_goals_elsewhere(SCENE, ~plan.relay & (goal[:, 5] == 0.0))


@pytest.mark.parametrize(
    ("changes", "goal"),
    [
        ({"a": (0.1, 0.0, -0.05)}, [1.4, 0.7, 0.425, 0, 0, 0]),  # the gripper at A
        ({"a": (0.0, 0.0, 0.08), "rise": 0.125}, [1.3, 0.7, 0.555, 0, 0, 0]),
        ({"a": (0.0, 0.03, 0.06), "rise": 0.06}, [1.3, 0.7, 0.525, 1, 0, 0]),  # A above B
        ({"a": (0.0, 0.015, 0.06), "rise": 0.06}, [1.3, 0.7, 0.475, 1, 0, 0]),  # A on B
        ({"a": (0.0, 0.015, 0.009), "rise": 0.0}, [1.3, 0.7, 0.475, 1, 0, 1]),  # the hand away
        ({}, [1.3, 0.7, 0.475, 1, 0, 1]),
        ({"a": (0.03, 0.0, 0.06), "b": (0.04, 0.0, 0.0), "rise": 0.06}, [1.34, 0.7, 0.475, 1, 0, 0]),  # B where it is
    ],
)
def test_a_relay_follows_the_state(changes, goal):
    state = made(**changes)
    plan = state.info["plan"].replace(relay=jnp.asarray(True))
    for step in (0, 99):
        np.testing.assert_allclose(ENV.current_goal(plan, state.pipeline_state, step), goal, atol=5e-4)


@pytest.mark.parametrize(
    ("a", "b", "hand", "expected"),
    [
        (0.0, 0.0, {}, "gripper"),
        (0.009, 0.009, {}, "gripper"),
        (0.009, 0.011, {}, "b"),
        (0.011, 0.0, {}, "left"),
        (0.011, 0.011, {}, "left"),
        (0.011, 0.0, {"gap": 0.07}, "carried"),
        (0.011, 0.0, {"rise": 0.03}, "carried"),
        (0.011, 0.0, {"velocity": (0.0, 0.0, -0.06, 0.0, 0.0, 0.0)}, "carried"),  # or falling
    ],
)
def test_what_is_achieved_is_of_cube_a_then_of_cube_b_then_of_the_gripper(a, b, hand, expected):
    physics = made(**hand).pipeline_state
    at = np.array(physics.qpos)
    shifted = np.add(at[A : A + 3], [0, a, 0]), np.add(at[B : B + 3], [b, 0, 0])
    physics = physics.replace(object_start=jnp.asarray(shifted[0]), b_start=jnp.asarray(shifted[1]))
    wanted = {
        "gripper": [*physics.gripper_position, 0, 0, 0],
        "b": [*at[B : B + 3], 0, 1, 0],
        "left": [*at[A : A + 3], 1, 0, 1],
        "carried": [*at[A : A + 3], 1, 0, 0],
    }[expected]
    np.testing.assert_allclose(ENV.achieved_goal(physics), wanted, atol=1e-6)


def test_kinds_of_goals():
    goals = jnp.array(
        [
            [1.3, 0.7, 0.42, 0, 0, 0],
            [1.3, 0.7, 0.60, 0, 0, 0],
            [1.3, 0.7, 0.425, 1, 0, 0],
            [1.3, 0.7, 0.46, 1, 0, 0],
            [1.3, 0.7, 0.44, 1, 0, 1],
            [1.3, 0.7, 0.475, 1, 0, 1],
            [1.3, 0.7, 0.425, 0, 1, 0],
            [1.3, 0.7, 0.60, 0, 1, 0],
        ]
    )
    np.testing.assert_array_equal(ENV.goal_kind(goals), [0, 0, 1, 2, 3, 4, 5, 5])
    assert ENV.goal_kinds == 6


def test_features_suffice_to_test_goals():
    check_that_features_suffice_to_test_goals(SCENE, to_leave=1, count=400)


def test_moving_the_target_moves_cube_b():
    state = made(a=(-0.1, 0.1, -0.05))
    moved = ENV.move_target(state, np.array([1.35, 0.8, 0.475]))
    data = SCENE.forward(moved.pipeline_state)
    np.testing.assert_allclose(data.body("cube_b").xpos, [1.35, 0.8, 0.425], atol=2e-4)
    np.testing.assert_allclose(data.body("cube_b").xmat, np.eye(3).flatten(), atol=1e-6)
    np.testing.assert_array_equal(moved.pipeline_state.qpos[:B], state.pipeline_state.qpos[:B])
    np.testing.assert_allclose(moved.info["desired_goal"], [1.35, 0.8, 0.475, 1, 0, 1], atol=2e-4)
    assert ENV.achieved_goal(moved.pipeline_state)[4] == 0.0  # it has been moved by no hand


def test_the_scripted_hand_stacks():
    env = hgail_envs.make("stack", impl="c")
    assert env.substeps == 20
    trajectory = run_controller(env, "from-above", 8, seed=0)
    assert trajectory.outcome.success.mean() == 1.0
    reached = np.asarray(trajectory.reward) == 0.0
    assert (reached.argmax(axis=0) < 45).all()  # the docstring: 35 to 42 steps
    features = np.asarray(trajectory.features)
    assert np.abs(features[-1, :, 20:23] - features[0, :, 20:23]).max() < 5e-3  # cube B stays


@pytest.mark.slow
def test_fifty_steps_are_too_few_for_a_hand_that_explores():
    """As the docstring has it: with a noise of .1 three fifths are done by then, most by the end."""
    reward = np.asarray(explored(SCENE).reward)
    assert len(reward) == 100
    for steps, least, most in ((50, 0.5, 0.7), (100, 0.8, 0.95)):
        assert least <= (reward[:steps] == 0.0).any(axis=0).mean() <= most
