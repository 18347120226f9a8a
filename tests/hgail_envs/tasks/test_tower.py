"""A tower of three: goals and stages against plain NumPy, strict success against states of C MuJoCo made by hand."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare, ks_2samp

import hgail_envs
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_jax.play.recording import run_controller
from tests.hgail_envs.tasks.cubes import (
    MANY,
    SIDES,
    UPRIGHT,
    CubeScene,
    check_goals_elsewhere,
    check_that_features_suffice_to_test_goals,
    explored,
    is_in_place,
    is_left,
)

SCENE = CubeScene("tower")
ENV, MODEL, NAMES, CUBES, FINGERS = SCENE.env, SCENE.model, SCENE.names, SCENE.cubes, SCENE.fingers
TOP, MIDDLE, BASE = range(3)
ORDERS = list(itertools.permutations(range(3)))
TOWER = np.array([[1.3, 0.7, 0.525], [1.3, 0.7, 0.475], [1.3, 0.7, 0.425]])  # centres of top, middle and base
STARTS = np.array([[1.2, 0.9, 0.425], [1.45, 0.85, 0.425], TOWER[BASE]])
NOWHERE, STILL = np.zeros((3, 3)), np.zeros((3, 6))


def made(cubes=NOWHERE, rise=0.12, gap=0.1, velocities=STILL, order=(2, 0, 1), placed=True):
    """Returns a state made by hand: cubes so far from their places in the tower, by role, metres.

    The gripper is `rise` above the top cube's place, metres, or at `rise`, `[3]`.
    """
    hand = np.add(TOWER[TOP], [0.0, 0.0, rise]) if np.ndim(rise) == 0 else rise
    sunk = np.array([[0, 0, 3e-4], [0, 0, 2e-4], [0, 0, 1e-4]])  # so that they touch
    roles = np.argsort(order)
    data = SCENE.data(hand, (TOWER + cubes - sunk)[roles], np.asarray(velocities)[roles], gap)
    starts = jnp.asarray(STARTS, jnp.float32)
    return SCENE.state(data, order=jnp.array(order), starts=starts, placed=jnp.asarray(placed))


def shifted(role, by):
    """Returns displacements of the cubes of which one is not 0."""
    return np.eye(3)[role][:, None] * np.asarray(by)


def moving(role, index, speed):
    """Returns velocities of the cubes of which one number is not 0."""
    return speed * np.eye(3)[role][:, None] * np.eye(6)[index]


def scripted(count, training_goals, noise):
    """Returns the states of episodes of a hand that errs, with leaves `[T + 1, count, ...]`."""

    def act(state, rng):
        goal = jax.vmap(ENV.placement)(state.pipeline_state)
        action = ENV.controllers["from-above"](ENV.goal_observation(state.info["features"], goal))
        following = jax.vmap(ENV.step)(state, action + noise * jax.random.normal(rng, action.shape))
        return following, following

    @jax.jit
    def run(rng):
        start_rng, rng = jax.random.split(rng)
        start = jax.vmap(ENV.reset, in_axes=(0, None))(jax.random.split(start_rng, count), training_goals)
        states = jax.lax.scan(act, start, jax.random.split(rng, ENV.episode_length))[1]
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)

    return jax.tree.map(np.asarray, run(jax.random.key(2)))


@pytest.fixture(scope="module")
def episodes():
    return scripted(24, training_goals=True, noise=0.15)


@pytest.mark.parametrize(
    ("aside", "most"), [((0, 0), 1e-3), ((0.008, 0), 7e-3), ((0.012, 0), 7e-3)], ids=["straight", "leaning", "more"]
)
@pytest.mark.parametrize("substeps", [20, 8])
def test_a_tower_stays_for_ten_seconds(aside, most, substeps):
    """Each cube lies so far aside of the one below. A tower that leans creeps by half a millimetre a second."""
    places = TOWER.copy()
    places[MIDDLE, :2] += aside
    places[TOP, :2] += np.multiply(2, aside)
    ends = np.abs(SCENE.after_ten_seconds(SCENE.data(np.add(TOWER[TOP], [0.0, 0.0, 0.12]), places), substeps))
    assert ends[:, :3].max() < most
    assert ends[:, 3:].max() < 0.015


@pytest.mark.parametrize(
    "changes",
    [
        *({"order": order} for order in ORDERS),
        {"cubes": shifted(TOP, (0.015, -0.012, 0.0))},
        {"cubes": shifted(MIDDLE, (0.012, 0.008, 0.0))},
        {"cubes": np.array([(0.02, 0.0, 0.0), (0.01, 0.0, 0.0), (0.0, 0.0, 0.0)])},
        {"cubes": np.array([(0.048, 0.0, 0.0)] * 3)},
        {"rise": 0.052},  # and 4 cm after the test, for the hand sinks
        {"gap": 0.082},
        {"velocities": moving(TOP, 1, 0.04)},
        {"placed": False},  # which stands as well
    ],
)
def test_a_tower_that_stands_alone_is_a_success(changes):
    outcome = SCENE.outcome_of(made(**changes))
    assert (outcome.success, outcome.achieved) == (1.0, 1.0)
    cubes = changes.get("cubes", NOWHERE)
    np.testing.assert_allclose(outcome.distance_l2, np.linalg.norm(cubes[TOP] - cubes[BASE]), atol=5e-4)


VIOLATIONS = {
    "the top beside the tower, on the table": {"cubes": shifted(TOP, (0.052, 0.0, -0.1))},
    "the top on the base, the middle away": {
        "cubes": np.array([(0.0, 0.0, -0.05), (0.1, 0.0, -0.05), (0.0, 0.0, 0.0)])
    },
    "the top on the middle, on the table": {"cubes": np.array([(0.1, 0.0, -0.05), (0.1, 0.0, -0.05), (0, 0, 0)])},
    "top and middle in each other's place": {"cubes": np.array([(0, 0, -0.05), (0, 0, 0.05), (0, 0, 0)])},
    "the top too far aside": {"cubes": shifted(TOP, (0.026, 0.0, 0.0))},
    "top and middle too far aside": {"cubes": np.array([(0.026, 0.0, 0.0), (0.026, 0.0, 0.0), (0.0, 0.0, 0.0)])},
    "the middle too far aside of both": {"cubes": shifted(MIDDLE, (0.0, 0.026, 0.0))},
    "the top too high": {"cubes": shifted(TOP, (0.0, 0.0, 0.011))},
    "the top does not touch the middle": {"cubes": shifted(TOP, (0.0, 0.0, 0.005))},
    "the middle does not touch the base": {"cubes": np.array([(0, 0, 0.005), (0, 0, 0.005), (0, 0, 0)])},
    "the hand near": {"rise": 0.048},
    "the hand at the top, open": {"rise": 0.0},
    "the hand holds the top": {"rise": 0.0, "gap": 0.046},
    "the hand closed": {"gap": 0.0},
    "the hand hardly open": {"gap": 0.078},
    "the top not at rest": {"velocities": moving(TOP, 1, 0.06)},
    "the base moved": {"cubes": np.array([(0.052, 0.0, 0.0)] * 3)},
}


@pytest.mark.parametrize("changes", VIOLATIONS.values(), ids=VIOLATIONS.keys())
@pytest.mark.parametrize("order", [(2, 0, 1), (0, 1, 2)])
def test_a_single_violation_is_no_success(changes, order):
    """It is none at the end, whatever the test of the tower would set right: it opens the hand."""
    outcome = SCENE.outcome_of(made(order=order, **changes))
    assert (outcome.success, outcome.achieved) == (0.0, 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"velocities": moving(BASE, 0, 2.0)},  # the base slides away from below
        {"velocities": moving(MIDDLE, 1, -2.0)},
        {"cubes": shifted(TOP, (0.024, 0.0, 0.0)), "velocities": moving(TOP, 4, 8.0)},  # the top tips over the edge
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
    for _ in range(120):
        cubes = rng.uniform(-1, 1, (3, 3)) * [[0.022, 0.01, 0.0], [0.022, 0.01, 0.0], [0.05, 0.04, 0.0]]
        cubes[TOP] += cubes[MIDDLE] + cubes[BASE] + [0, 0, rng.choice([0.0, 0.0, 0.002])]
        cubes[MIDDLE] += cubes[BASE]
        order = ORDERS[rng.integers(6)]
        state = made(cubes, rise=rng.choice([0.06, 0.12]), gap=rng.choice([0.075, 0.085, 0.1]), order=order)
        data = SCENE.forward(state.pipeline_state)
        top, middle, base = (NAMES[cube] for cube in order)
        pairs = [{MODEL.geom(name).id for name in pair} for pair in ((top, middle), (middle, base))]
        holds = [any(set(pair) == cubes for pair in data.contact.geom) for cubes in pairs]
        for upper, lower in ((top, middle), (middle, base)):
            holds.append(is_in_place(data.body(upper).xpos - data.body(lower).xpos - [0, 0, 0.05]))
        holds += [
            np.linalg.norm(data.site("grip").xpos - data.body(top).xpos) >= 0.05,
            data.qpos[FINGERS].sum() >= 0.08,
            np.linalg.norm(data.body(base).xpos - STARTS[BASE]) <= 0.05,
        ]
        found.append((all(holds), bool(SCENE.outcome(state, state).achieved)))
    expected, ours = np.transpose(found)
    np.testing.assert_array_equal(ours, expected)
    assert 20 < expected.sum() < 100


def test_starts_are_those_of_a_loop_in_any_order():
    """By rejection, one cube after another, in whichever order the observation has them."""
    physics, rng, loop = SCENE.starts[0].pipeline_state, np.random.default_rng(0), []
    while len(loop) < MANY:
        places = []
        while len(places) < 3:
            place = rng.uniform(-0.15, 0.15, 2)
            if all(np.hypot(*np.subtract(place, other)) >= 0.1 for other in [(0, 0), *places]):
                places.append(place)
        loop.append(places)
    loop = np.array(loop)
    ours = SCENE.by_role(physics)[..., :2] - ENV.initial_gripper_position[:2]

    def apart(places):
        return np.linalg.norm(places - np.roll(places, 1, axis=1), axis=-1)

    for role in range(3):
        for axis in range(2):
            assert ks_2samp(ours[:, role, axis], loop[:, role, axis]).pvalue > 1e-4
        assert ks_2samp(apart(ours)[:, role], apart(loop)[:, role]).pvalue > 1e-4
    assert min(apart(ours).min(), np.linalg.norm(ours, axis=-1).min()) >= 0.1 - 1e-6
    counts = [(physics.order == order).all(axis=1).sum() for order in ORDERS]
    assert sum(counts) == MANY
    assert chisquare(counts).pvalue > 1e-4
    np.testing.assert_array_equal(physics.starts, SCENE.by_role(physics))
    np.testing.assert_allclose(physics.starts[..., 2], 0.425)
    assert np.abs(physics.qpos[:, FINGERS]).max() < 1e-3
    assert not physics.placed.any()
    for first in CUBES:
        np.testing.assert_array_equal(physics.qpos[:, first + 3 : first + 7], np.tile(UPRIGHT, (MANY, 1)))


def test_half_the_training_episodes_start_with_the_middle_on_the_base():
    (plain, begun), plan = (state.pipeline_state for state in SCENE.starts), SCENE.starts[1].info["plan"]
    assert abs(begun.placed.mean() - 0.5) < 0.04
    cubes, before = SCENE.by_role(begun), SCENE.by_role(plain)
    on_base = before[:, BASE] + np.float32([0, 0, 0.05])
    np.testing.assert_allclose(cubes[:, MIDDLE], np.where(begun.placed[:, None], on_base, before[:, MIDDLE]), atol=1e-6)
    np.testing.assert_array_equal(cubes[:, [TOP, BASE]], before[:, [TOP, BASE]])
    np.testing.assert_array_equal(begun.starts, cubes)
    assert abs(plan.relay[begun.placed].mean() - plan.relay[~begun.placed].mean()) < 0.1  # whatever the goals
    np.testing.assert_array_equal(
        SCENE.starts[1].info["achieved_goal"], SCENE.starts[0].info["achieved_goal"]
    )  # it is no hand's


def test_a_start_of_other_sizes_has_the_middle_on_the_base_too():
    env = RandomizedEnv(ENV, Randomization(object_size=(0.8, 0.9), history=1, robot_offset=0.01))
    state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(0), 20), True)
    physics = state.pipeline_state.true
    cubes, width = SCENE.by_role(physics), 0.05 * np.asarray(physics.factors.object_size)
    rise = (cubes[:, MIDDLE] - cubes[:, BASE])[np.asarray(physics.placed)]
    assert 4 < len(rise) < 16
    np.testing.assert_allclose(rise[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(rise[:, 2], width[np.asarray(physics.placed)], atol=1e-6)
    np.testing.assert_allclose(cubes[:, BASE, 2], 0.4 + width / 2, atol=3e-4)
    np.testing.assert_array_equal(physics.starts, cubes)
    seen = state.info["features"]
    np.testing.assert_allclose(seen[:, 4:39], seen[:, 39:74], atol=1e-6)  # the history is the start's


def test_the_observation_has_the_cubes_by_role(episodes):
    """Against joint positions by hand, of each of the six orders."""
    physics, seen = episodes.pipeline_state, episodes.info["features"]
    assert {tuple(order) for order in physics.order[0]} == set(ORDERS)
    assert (physics.order == physics.order[0]).all()
    for episode, order in enumerate(physics.order[0]):
        gripper = physics.gripper_position[:, episode]
        expected = [gripper, physics.gripper_velocity[:, episode]]
        for cube in order:
            position = physics.qpos[:, episode, CUBES[cube] : CUBES[cube] + 3]
            velocity = physics.qvel[:, episode, SCENE.velocities[cube] : SCENE.velocities[cube] + 3]
            expected += [position - gripper, position, 0.04 * velocity]
        gap = physics.qpos[:, episode][:, FINGERS].sum(axis=1)
        touched = [
            physics.sensordata[:, episode, [MODEL.sensor(f"{side}_touch_{name[-1]}").adr[0] for side in SIDES]].all(1)
            for name in NAMES
        ]
        held = np.any(touched, axis=0) & (np.abs(gap - 0.05) <= 0.008)
        expected += [gap[:, None], held[:, None]]
        np.testing.assert_allclose(seen[:, episode], np.concatenate(expected, axis=1), atol=1e-6)
    assert 0.1 < seen[..., 34].mean() < 0.9


@pytest.mark.parametrize(
    ("whose", "order"),
    [((0, 0, 0), (0, 1, 2)), ((1, 0, 0), (0, 1, 2)), ((0, 1, 0), (1, 2, 0)), ((0, 0, 1), (2, 0, 1))],
    ids=["gripper", "top", "middle", "base"],
)
def test_the_policy_sees_the_cube_of_the_goal_first(episodes, whose, order):
    """Then the one that it is to lie on, and then the third."""
    features, goals = episodes.info["features"], episodes.info["desired_goal"].copy()
    np.testing.assert_array_equal(episodes.obs, ENV.goal_observation(features, goals))
    goals[..., 3:6] = whose
    cubes = [features[..., 6 + 9 * role : 15 + 9 * role] for role in order]
    expected = np.concatenate([features[..., :6], *cubes, features[..., 33:], goals], axis=-1)
    np.testing.assert_array_equal(ENV.goal_observation(features, goals), expected)


@pytest.mark.parametrize(
    ("touched", "gap", "held"),
    [
        *(([f"{side}_touch_{cube}" for side in SIDES], 0.05, True) for cube in "abc"),
        (["right_touch_a", "left_touch_a"], 0.059, False),
        (["right_touch_a", "left_touch_a"], 0.041, False),
        (["right_touch_a", "left_touch_b"], 0.05, False),  # a cube on either side of the hand
        (["left_touch_c"], 0.05, False),
        (["cubes_touch_ab", "cubes_touch_ac", "cubes_touch_bc"], 0.05, False),
    ],
)
def test_a_cube_is_held_where_both_pads_touch_it(touched, gap, held):
    sensors = np.zeros(MODEL.nsensordata, np.float32)
    sensors[[MODEL.sensor(name).adr[0] for name in touched]] = 1.0
    physics = made(gap=gap).pipeline_state.replace(sensordata=jnp.asarray(sensors))
    assert ENV.features(physics)[34] == held


def stages(physics):
    """Returns by a loop over the steps whether the middle was left on the base and still is there, `[T + 1, count]`."""
    cubes, gap = SCENE.by_role(physics), physics.qpos[..., FINGERS].sum(axis=-1)
    left = is_left(cubes, SCENE.by_role(physics, "qvel"), physics.gripper_position[..., None, :], gap[..., None])
    in_place = is_in_place(cubes[..., MIDDLE, :] - cubes[..., BASE, :] - [0, 0, 0.05])
    placed = [physics.placed[0]]
    for step in range(1, len(cubes)):
        placed.append(in_place[step] & (placed[-1] | left[step, :, MIDDLE]))
    return np.array(placed)


def test_the_goal_names_one_placement_after_the_other(episodes):
    """Along episodes: the middle on the base until it was left there, then the top on the middle."""
    physics, plan = episodes.pipeline_state, episodes.info["plan"]
    placed, cubes = stages(physics), SCENE.by_role(physics)
    np.testing.assert_array_equal(physics.placed, placed)
    begun = placed[0]
    assert 0 < begun.sum() < len(begun)
    assert placed[-1][~begun].mean() > 0.5  # the second placement is come to
    role = np.where(placed, TOP, MIDDLE)
    below = np.take_along_axis(cubes, role[..., None, None] + 1, axis=-2)[..., 0, :]
    expected = np.concatenate([np.add(below, [0, 0, 0.05]), np.eye(3)[role], np.ones((*role.shape, 1))], axis=-1)
    ours = jax.vmap(jax.vmap(lambda physics: ENV.sample_goal(jax.random.key(0), physics)))(physics)
    np.testing.assert_allclose(ours, expected, atol=1e-6)
    evaluated = ~plan.relay[0] & ~plan.elsewhere[0]
    assert evaluated.any()
    np.testing.assert_allclose(episodes.info["desired_goal"][:, evaluated], expected[:, evaluated], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "placed"),
    [
        ({}, True),
        ({"placed": False}, True),  # it is left there
        ({"placed": False, "gap": 0.0}, False),
        ({"gap": 0.0}, True),  # it was left there, and the hand may close
        ({"placed": False, "rise": -0.01}, False),  # 4 cm above it
        ({"cubes": shifted(MIDDLE, (0.03, 0.0, 0.0))}, False),
        ({"cubes": shifted(MIDDLE, (0.0, 0.1, -0.05))}, False),
        ({"cubes": shifted(BASE, (0.0, 0.03, 0.0))}, False),
        ({"placed": False, "velocities": moving(MIDDLE, 2, 0.06)}, False),
        ({"velocities": moving(MIDDLE, 2, 0.06)}, True),
    ],
)
def test_the_second_placement_begins_where_the_middle_is_left_and_ends_where_it_comes_out(changes, placed):
    changes = {"cubes": shifted(TOP, (0.1, 0.1, -0.1)), **changes}
    physics = made(**changes).pipeline_state
    assert ENV._with_stage(physics).placed == placed


def test_a_state_that_is_made_from_joints_knows_whether_the_middle_is_left():
    for hand, placed in ({"gap": 0.1}, True), ({"gap": 0.07}, False), ({"rise": -0.01}, False):
        physics = made(order=(0, 1, 2), **hand).pipeline_state
        assert SCENE.put(physics.qpos, physics.qvel).placed == placed


def test_evaluations_have_neither_training_goals_nor_starts():
    plan = SCENE.starts[0].info["plan"]
    assert not plan.relay.any()
    assert not plan.elsewhere.any()
    goal, cubes = SCENE.starts[0].info["desired_goal"], SCENE.by_role(SCENE.starts[0].pipeline_state)
    np.testing.assert_allclose(goal[:, :3], cubes[:, BASE] + [0, 0, 0.05], atol=1e-6)
    np.testing.assert_array_equal(goal[:, 3:], np.tile([0, 1, 0, 1], (MANY, 1)))


def test_an_eighth_of_the_training_goals_is_elsewhere_and_half_are_relays():
    state = SCENE.starts[1]
    plan, physics, goal = state.info["plan"], state.pipeline_state, state.info["desired_goal"]
    assert abs(plan.relay.mean() - 0.5) < 0.04
    assert not (plan.relay & plan.elsewhere).any()
    cubes = SCENE.by_role(physics)
    present = np.where(physics.placed[:, None], cubes[:, TOP], cubes[:, MIDDLE])
    np.testing.assert_allclose(goal[plan.relay], np.pad(present[plan.relay], ((0, 0), (0, 4))))
    check_goals_elsewhere(SCENE, plan.elsewhere)


def test_goals_elsewhere_stay(episodes):
    plan = episodes.info["plan"]
    goal = episodes.info["desired_goal"][:, plan.elsewhere[0]]
    assert goal.shape[1] > 0
    np.testing.assert_array_equal(goal, np.broadcast_to(goal[0], goal.shape))


ON_BASE = shifted(MIDDLE, (0.03, 0, 0.04)) + shifted(BASE, (0.04, 0, 0))
AWAY = shifted(TOP, (0.1, 0.1, -0.1))  # the top cube still lies on the table


@pytest.mark.parametrize(
    ("changes", "goal"),
    [
        # first placement
        ({"cubes": AWAY + shifted(MIDDLE, (0.1, 0.0, -0.05))}, [1.4, 0.7, 0.425, 0, 0, 0, 0]),  # the gripper at it
        ({"cubes": AWAY + shifted(MIDDLE, (0.03, 0, 0.04)), "rise": -0.01}, [1.3, 0.7, 0.525, 0, 1, 0, 0]),  # above
        ({"cubes": AWAY + shifted(MIDDLE, (0.015, 0, 0.04)), "rise": -0.01}, [1.3, 0.7, 0.475, 0, 1, 0, 0]),  # on it
        ({"cubes": AWAY + shifted(MIDDLE, (0.015, 0, 0.009)), "rise": -0.03}, [1.3, 0.7, 0.475, 0, 1, 0, 1]),  # left
        ({"cubes": AWAY + ON_BASE, "rise": -0.01}, [1.34, 0.7, 0.475, 0, 1, 0, 0]),  # as base is
        # second placement
        ({"cubes": AWAY, "placed": True}, [1.4, 0.8, 0.425, 0, 0, 0, 0]),
        ({"cubes": shifted(TOP, (0, 0.03, 0.06)), "rise": 0.06, "placed": True}, [1.3, 0.7, 0.575, 1, 0, 0, 0]),
        ({"cubes": shifted(TOP, (0, 0.015, 0.06)), "rise": 0.06, "placed": True}, [1.3, 0.7, 0.525, 1, 0, 0, 0]),
        ({"rise": 0.0, "placed": True}, [1.3, 0.7, 0.525, 1, 0, 0, 1]),
        ({"placed": True}, [1.3, 0.7, 0.525, 1, 0, 0, 1]),
        ({"cubes": shifted(MIDDLE, (0.02, 0, 0)), "placed": True}, [1.32, 0.7, 0.525, 1, 0, 0, 1]),
    ],
)
def test_a_relay_follows_the_state(changes, goal):
    state = made(**({"placed": False} | changes))
    plan = state.info["plan"].replace(relay=jnp.asarray(True))
    for step in (0, 199):
        np.testing.assert_allclose(ENV.current_goal(plan, state.pipeline_state, step), goal, atol=6e-4)


def read_achieved(cubes, starts, left, gripper, placed):
    """Returns the achieved goal of a state by its docstring, one after another, of arrays by role."""
    present = TOP if placed else MIDDLE
    moved = [np.linalg.norm(cubes[role] - starts[role]) > 0.01 for role in range(3)]
    for role in (present, *(other for other in range(3) if other != present)):
        if moved[role] and (role == present or np.linalg.norm(cubes[role] - gripper) <= 0.15):
            return [*cubes[role], *np.eye(3)[role], left[role]]
    return [*gripper, 0, 0, 0, 0]


def test_achieved_goals_are_those_of_a_loop(episodes):
    physics = episodes.pipeline_state
    cubes, gap = SCENE.by_role(physics), physics.qpos[..., FINGERS].sum(axis=-1)
    left = is_left(cubes, SCENE.by_role(physics, "qvel"), physics.gripper_position[..., None, :], gap[..., None])
    seen = set()
    for index in np.ndindex(physics.placed.shape):
        expected = read_achieved(
            cubes[index], physics.starts[index], left[index], physics.gripper_position[index], physics.placed[index]
        )
        np.testing.assert_allclose(episodes.info["achieved_goal"][index], expected, atol=1e-6)
        seen.add((bool(physics.placed[index]), *map(int, expected[3:])))
    assert seen >= {
        (False, 0, 0, 0, 0),  # the gripper
        (False, 0, 1, 0, 0),  # the middle carried
        (True, 0, 1, 0, 1),  # the middle left on the base, hand near
        (True, 0, 0, 0, 0),  # the gripper again
        (True, 1, 0, 0, 0),
        (True, 1, 0, 0, 1),
    }


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("moved", list(itertools.product([0.009, 0.011], repeat=3)))
@pytest.mark.parametrize("hand", [(1.3, 0.7, 0.62), (1.3, 0.79, 0.48), (1.37, 0.76, 0.56)])
def test_what_is_achieved_is_of_the_placement_s_cube_then_of_those_at_the_hand(placed, moved, hand):
    physics = made(rise=hand, placed=placed).pipeline_state
    cubes = SCENE.by_role(physics)
    starts = cubes + np.array(moved)[:, None] * np.float32([0, 1, 0])
    physics = physics.replace(starts=jnp.asarray(starts))
    gripper = np.asarray(physics.gripper_position)
    left = is_left(cubes, np.zeros((3, 3)), gripper, np.float32(0.1))
    np.testing.assert_allclose(SCENE.achieved(physics), read_achieved(cubes, starts, left, gripper, placed), atol=1e-6)


def test_kinds_of_goals():
    goals = {
        (0.42, 0, 0, 0, 0): 0,
        (0.60, 0, 0, 0, 0): 0,
        (0.425, 1, 0, 0, 0): 1,
        (0.425, 0, 1, 0, 0): 1,
        (0.425, 0, 0, 1, 0): 1,
        (0.475, 0, 0, 1, 0): 1,
        (0.44, 1, 0, 0, 1): 2,
        (0.44, 0, 1, 0, 1): 2,
        (0.475, 0, 0, 1, 1): 2,
        (0.46, 0, 1, 0, 0): 3,
        (0.475, 0, 1, 0, 1): 4,
        (0.46, 1, 0, 0, 0): 5,
        (0.525, 1, 0, 0, 1): 6,
    }
    kinds = ENV.goal_kind(jnp.array([[1.3, 0.7, *goal] for goal in goals]))
    np.testing.assert_array_equal(kinds, list(goals.values()))
    assert kinds.dtype == jnp.int32
    assert ENV.goal_kinds == 7


def test_features_suffice_to_test_goals():
    check_that_features_suffice_to_test_goals(SCENE, to_leave=3, count=600)


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("order", [(2, 0, 1), (0, 1, 2)])
def test_moving_the_target_moves_the_base_and_what_was_left_on_it(placed, order):
    cubes = np.array([(-0.1, 0.1, -0.1), (0, 0, 0) if placed else (0.1, 0.1, -0.05), (0, 0, 0)])
    state = made(cubes, order=order, placed=placed)
    moved = ENV.move_target(state, np.array([1.35, 0.8, 0.475]))
    data = SCENE.forward(moved.pipeline_state)
    base, middle = (NAMES[order[role]] for role in (BASE, MIDDLE))
    np.testing.assert_allclose(data.body(base).xpos, [1.35, 0.8, 0.425], atol=2e-4)
    np.testing.assert_allclose(data.body(base).xmat, np.eye(3).flatten(), atol=1e-6)
    at = [1.35, 0.8, 0.475] if placed else TOWER[MIDDLE] + cubes[MIDDLE]
    np.testing.assert_allclose(data.body(middle).xpos, at, atol=3e-4)
    top = CUBES[order[TOP]]
    np.testing.assert_array_equal(moved.pipeline_state.qpos[top : top + 7], state.pipeline_state.qpos[top : top + 7])
    whose = [1, 0, 0] if placed else [0, 1, 0]
    goal = [1.35, 0.8, 0.525 if placed else 0.475, *whose, 1]
    np.testing.assert_allclose(moved.info["desired_goal"], goal, atol=3e-4)
    assert moved.pipeline_state.placed == placed
    np.testing.assert_allclose(moved.pipeline_state.starts[BASE], [1.35, 0.8, 0.425])


@pytest.mark.slow
def test_the_scripted_hand_builds_towers():
    env = hgail_envs.make("tower", impl="c")
    assert env.substeps == 20
    trajectory = run_controller(env, "from-above", 3, seed=1)
    assert trajectory.outcome.success.mean() == 1.0


@pytest.mark.slow
def test_the_scripted_hand_builds_nearly_all_towers_in_90_steps():
    """The docstring: 75 to 89 steps, the first placement 37 to 44."""
    trajectory = run_controller(hgail_envs.make("tower", impl="c"), "from-above", 64, seed=0)
    assert trajectory.outcome.success.mean() >= 0.95
    of_top = np.asarray(trajectory.desired)[..., 3] == 1.0
    done = (np.asarray(trajectory.reward) == 0.0) & of_top[:-1]
    assert (of_top.argmax(axis=0) < 47).all()
    assert (done.argmax(axis=0) < 95).all()
    features = np.asarray(trajectory.features)
    assert np.abs(features[-1, :, 27:30] - features[0, :, 27:30]).max() < 5e-3  # the base stays


@pytest.mark.slow
def test_a_hundred_steps_are_too_few_for_a_hand_that_explores():
    """As the docstring has it: with a noise of .1 on the actions half are done by then, most by the end."""
    trajectory = explored(SCENE)
    done = (np.asarray(trajectory.reward) == 0.0) & (np.asarray(trajectory.desired)[:-1, :, 3] == 1.0)
    assert len(done) == 200
    for steps, least, most in ((100, 0.4, 0.65), (150, 0.75, 0.9), (200, 0.85, 0.98)):
        assert least <= done[:steps].any(axis=0).mean() <= most
