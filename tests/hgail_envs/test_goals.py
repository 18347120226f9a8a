"""Starts, steps, goals and outcomes of the tasks, against plain NumPy."""

import contextlib
import importlib
import inspect
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, uniform

import hgail_envs
from hgail_envs.base import EpisodeMetrics, GoalEnv, TrainingDefaults
from hgail_envs.point import Point
from hgail_envs.tasks.base import ArmEnv
from hgail_envs.tasks.grasp import is_held
from tests.support import starts_of

MANY = 3000
KEYS = jax.random.split(jax.random.key(0), MANY)
NAMES = ("reach", "grasp")
RNG = np.random.default_rng(0)
CUBE = slice(13, 16)  # of the joint positions: after base, torso, arm and fingers


@pytest.fixture(scope="module")
def tasks():
    return {name: hgail_envs.make(name, impl="c", substeps=8) for name in NAMES}


@pytest.fixture(scope="module")
def starts(tasks):
    return {name: starts_of(env, KEYS) for name, env in tasks.items()}


def cubes(state):
    return state.pipeline_state.qpos[..., CUBE]


def is_uniform(values, low, high):
    return kstest(values, uniform(low, high - low).cdf).pvalue > 1e-4


class Walk(GoalEnv):
    """A number that actions move; goals to learn from are negative, and all goals move with time."""

    episode_length, feature_size, goal_size, action_size, success_threshold = 4, 2, 1, 1, 0.5

    def reset_physics(self, rng):
        return jnp.append(jax.random.uniform(rng), 0.0)

    def step_physics(self, physics, action):
        return physics + jnp.append(action, 1.0)

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return physics[:1]

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (1,), minval=2.0, maxval=3.0)

    def plan_goals(self, rng, physics, training_goals):
        return {
            "goal": jnp.where(training_goals, -1.0, 1.0) * self.sample_goal(rng, physics),
            "moves": 10.0 + 10 * training_goals,
        }

    def current_goal(self, plan, physics, step):
        return plan["goal"] + plan["moves"] * step + physics[:1]


@pytest.mark.parametrize("training_goals", [False, True, np.array(True)])
def test_an_episode_pursues_its_plan(training_goals):
    """What is drawn at the reset stays; the goal depends on it, on where the episode is and on the step."""
    env = Walk()
    state = env.reset(jax.random.key(3), training_goals)
    position, plan = float(state.obs[0]), state.info["plan"]
    goal, moves = float(plan["goal"][0]), (20.0 if training_goals else 10.0)
    assert (-3.0 < goal < -2.0) if training_goals else (2.0 < goal < 3.0)
    assert abs(position - goal % 1) > 1e-3  # start and goal are drawn with keys of their own
    np.testing.assert_allclose(state.obs, [position, 0, goal + position], rtol=1e-5)
    for step, action in enumerate((0.5, -3.0, 1.5), start=1):
        state = env.step(state, jnp.array([action]))
        position += np.clip(action, -1, 1)
        wanted = goal + moves * step + position
        np.testing.assert_allclose(state.obs, [position, step, wanted], rtol=1e-5)
        np.testing.assert_allclose(state.info["features"], [position, step], rtol=1e-5)
        np.testing.assert_allclose(state.info["achieved_goal"], [position], rtol=1e-5)
        np.testing.assert_allclose(state.info["desired_goal"], [wanted], rtol=1e-5)
        assert state.reward == -1.0
        assert state.done == 0.0
        assert state.info["step"] == step
        jax.tree.map(np.testing.assert_array_equal, state.info["plan"], plan)


@pytest.mark.parametrize("training_goals", [False, True, np.array(True)])
def test_training_episodes_alone_may_start_elsewhere(training_goals):
    """With randomness of their own: neither the other starts nor the goals change."""

    class Further(Walk):
        def training_start(self, rng, physics, training_goals):
            return physics + jnp.where(training_goals, 5.0 + jax.random.uniform(rng), 0.0) * jnp.array([1.0, 0.0])

    key = jax.random.key(3)
    plain, further = Walk().reset(key, training_goals), Further().reset(key, training_goals)
    jax.tree.map(np.testing.assert_array_equal, plain.info["plan"], further.info["plan"])
    moved = further.obs - plain.obs
    if not training_goals:
        np.testing.assert_array_equal(moved, np.zeros(3))
    else:
        assert 5.0 < moved[0] < 6.0
        drawn = moved[0] - 5.0
        assert all(abs(drawn - number % 1) > 1e-3 for number in (plain.obs[0], plain.info["plan"]["goal"][0]))
        np.testing.assert_allclose(moved, [moved[0], 0.0, moved[0]], rtol=1e-5)


def test_what_a_step_finds_in_a_state_it_keeps():
    env = Walk()
    state = env.reset(jax.random.key(0))
    assert state.metrics == {}
    state = env.step(state.replace(info=state.info | {"more": 1}, metrics={"most": 2}), jnp.zeros(1))
    assert (state.info["more"], state.metrics) == (1, {"most": 2})


def test_the_reward_is_0_at_the_goal_and_minus_1_elsewhere():
    env = Walk()
    at = env.reset(jax.random.key(0)).replace(pipeline_state=jnp.array([0.7, 2.0]))
    for goal, reward in ((-10.0 + 0.3, 0.0), (-10.0 + 1.3, -1.0)):
        plan = {"goal": jnp.array([goal]), "moves": 10.0}
        assert env.step(at.replace(info=at.info | {"plan": plan}), jnp.zeros(1)).reward == reward

    class Elsewhere(Walk):
        def goal_test(self, features, achieved, goal):
            return features[..., 1] > 0.0

    env = Elsewhere()
    start = env.reset(jax.random.key(0))
    states = [start, env.step(start, jnp.zeros(1))]
    assert [state.reward for state in states] == [-1.0, 0.0]
    assert [env.outcome(state, state).success for state in states] == [0.0, 1.0]
    assert [env.reached(state.pipeline_state, start.info["desired_goal"]) for state in states] == [False, True]


def test_defaults_of_a_task():
    env = Walk()
    goals = jnp.zeros((3, 2, 1))
    np.testing.assert_array_equal(env.goal_kind(goals), np.zeros((3, 2)))
    assert env.goal_kind(goals).dtype == jnp.int32
    assert (env.goal_kinds, env.lift_test_steps, env.max_worlds, env.observation_limit) == (1, 0, None, 1e3)
    assert env.observation_size == 3
    assert env.reference_physics() is env
    assert not env.overflow(jnp.zeros(2))
    assert env.overflow(jnp.zeros(2)).dtype == bool
    np.testing.assert_array_equal(env.lift_test_action(jnp.array([0.3])), np.float32([0.3]))
    assert not env.already_solved(jnp.zeros((3, 2, 2)), goals).any()
    assert env.already_solved(jnp.zeros((3, 2, 2)), goals).shape == (3, 2)
    key, goal = jax.random.key(1), jnp.array([7.0])
    for training_goals in (False, True):
        np.testing.assert_array_equal(env.training_start(key, goal, training_goals), goal)
        np.testing.assert_array_equal(GoalEnv.plan_goals(env, key, 0, training_goals), env.sample_goal(key, 0))
    np.testing.assert_array_equal(GoalEnv.current_goal(env, goal, jnp.ones(2), 3), goal)
    assert env.training == {}
    assert set(vars(EpisodeMetrics()).values()) == {0.0}
    usual = {"config": {}, "hyperparameters": {}, "options": {}, "evaluate_every": 1, "method": "hgail"}
    assert vars(TrainingDefaults()) == usual


def test_an_outcome_is_distances_and_whether_they_are_small():
    env = Point()
    for position, target in RNG.uniform(-0.04, 0.04, (40, 2, 3)).astype(np.float32):
        end = env.reset(jax.random.key(0)).replace(
            info={"features": position, "achieved_goal": position, "desired_goal": target}
        )
        outcome = env.outcome(end, None)
        l1, l2 = np.abs(position - target).sum(), np.sqrt(np.square(position - target).sum())
        np.testing.assert_allclose((outcome.distance_l1, outcome.distance_l2), (l1, l2), rtol=1e-5)
        expected = (l2 <= 0.05, l2 <= 0.05, l1 <= 0.05)
        assert (outcome.success, outcome.achieved, outcome.success_l1) == expected
        measured = env.measure(position, target)
        assert measured.success == measured.achieved == 0.0
        np.testing.assert_allclose(measured.distance_l1, l1, rtol=1e-5)


def test_a_distance_equal_to_the_threshold_is_a_success():
    env = Walk()
    assert env.success(jnp.array([1.5]), jnp.array([1.0]))
    assert env.success(jnp.array([0.5]), jnp.array([1.0]))
    assert not env.success(jnp.array([1.6]), jnp.array([1.0]))
    assert env.measure(jnp.array([0.25, 0.0]), jnp.array([0.0, 0.25])).success_l1 == 1.0


def test_the_point_moves_and_has_goals_as_it_says():
    env = Point()
    state = jax.vmap(env.reset)(KEYS)
    assert state.obs.shape == (MANY, env.observation_size) == (MANY, 6)
    assert (env.episode_length, env.action_size, env.success_threshold) == (50, 3, 0.05)
    np.testing.assert_array_equal(state.obs[:, :3], 0.0)
    for axis in range(3):
        assert is_uniform(state.obs[:, 3 + axis], -0.15, 0.15)
    action = np.float32([0.5, -1.0, 2.0])
    np.testing.assert_allclose(
        env.step(jax.tree.map(lambda leaf: leaf[0], state), action).obs[:3], [0.015, -0.03, 0.03]
    )
    observation = np.float32([[0.1, 0.2, 0.3, 0.11, 0.5, -0.5]])
    np.testing.assert_allclose(env.controllers["proportional"](observation), [[0.2, 1.0, -1.0]], rtol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_observations_are_features_and_goal(name, tasks, starts):
    env = tasks[name]
    sizes = {"reach": (6, 3, 1, 0), "grasp": (8, 4, 2, 12)}
    assert (env.feature_size, env.goal_size, env.goal_kinds, env.lift_test_steps) == sizes[name]
    for state in starts[name]:
        physics, info = state.pipeline_state, state.info
        features = [physics.gripper_position, physics.gripper_velocity]
        if name != "reach":
            features.append(np.zeros((MANY, 2)))  # at the start the hand is closed and holds nothing
        np.testing.assert_allclose(info["features"], np.concatenate(features, axis=-1), atol=1e-4)
        np.testing.assert_array_equal(state.obs, np.concatenate([info["features"], info["desired_goal"]], axis=-1))
        achieved = env.achieved_goal(jax.tree.map(lambda leaf: leaf[0], physics))
        np.testing.assert_allclose(info["achieved_goal"][0], achieved)
        np.testing.assert_array_equal(info["achieved_goal"][:, :3], physics.gripper_position)
        assert (info["step"] == 0).all()


def test_reach_s_goals_fill_a_cube_around_the_gripper(tasks, starts):
    for state in starts["reach"]:
        offset = state.info["desired_goal"] - tasks["reach"].initial_gripper_position
        for axis in range(3):
            assert is_uniform(offset[:, axis], -0.15, 0.15)
        assert np.abs(np.corrcoef(offset.T) - np.eye(3)).max() < 0.08
        reached = np.linalg.norm(state.obs[:, :3] - state.obs[:, 6:], axis=-1) <= 0.05
        np.testing.assert_array_equal(state.reward, reached - 1.0)
        assert 0 < reached.sum() < MANY


def test_scripted_controllers_have_names(tasks):
    assert set(tasks["reach"].controllers) == {"proportional"}
    assert set(tasks["grasp"].controllers) == {"from-above", "straight", "closed"}


def test_all_tasks_of_the_arm_take_the_same_options_before_their_own():
    shared = tuple(inspect.signature(ArmEnv).parameters)
    for task in ("reach", "grasp", "push", "pick-and-place", "slide", "stack", "tower"):
        assert hgail_envs.accepted_options(task)[: len(shared)] == shared
    slide = hgail_envs.find_class("slide")("auto", 5, achieved="passed")
    assert (slide.substeps, slide.achieved) == (5, "passed")


def test_the_arm_s_number_of_substeps_is_the_caller_s(tasks):
    assert {env.substeps for env in tasks.values()} == {8}
    assert hgail_envs.make("grasp", impl="c").substeps == 20


def test_actions_pull_the_gripper_and_command_the_hand(tasks, starts):
    action = np.zeros((8, 4), np.float32)
    action[[1, 2, 3, 4, 5], [0, 1, 2, 3, 0]] = (1.0, 1.0, 1.0, 1.0, 9.0)
    action[6] = action[7] = (0.4, -0.6, 0.2, 0.0)
    action[7, 3] = 0.5
    for name in ("reach", "grasp"):
        one = jax.tree.map(lambda leaf: np.repeat(leaf[:1], 8, axis=0), starts[name][0])
        step, state = jax.jit(jax.vmap(tasks[name].step)), one
        for _ in range(3):
            state = step(state, action)
        gap = state.pipeline_state.qpos[:, tasks[name].robot._finger_qpos].sum(axis=-1)
        moved = state.obs[:, :3] - one.obs[:, :3]
        np.testing.assert_array_equal(np.argmax(moved[1:4], axis=-1), [0, 1, 2])
        assert (moved[[1, 2, 3], [0, 1, 2]] > 0.03).all()
        np.testing.assert_allclose(moved[5], moved[1], atol=1e-6)
        np.testing.assert_allclose(moved[4], moved[0], atol=2e-3)
        assert (np.sign(moved[6]) == [1, -1, 1]).all()
        if name == "reach":
            np.testing.assert_array_equal(moved[7], moved[6])
            np.testing.assert_array_equal(gap, 0.0)
        else:
            assert gap[4] > 0.05
            assert gap[7] > 0.01 > gap[6]
            np.testing.assert_allclose(state.obs[:, 6], gap, atol=1e-6)


def test_cubes_start_anywhere_in_the_square_but_near_the_gripper(tasks, starts):
    env = tasks["grasp"]
    state = starts["grasp"][0]
    cube = cubes(state)
    offset = cube[:, :2] - env.initial_gripper_position[:2]
    assert np.linalg.norm(offset, axis=-1).min() >= 0.1 - 1e-6
    assert np.abs(offset).max() <= 0.15 + 1e-6
    np.testing.assert_allclose(cube[:, 2], 0.425)
    drawn = RNG.uniform(-0.15, 0.15, (20 * MANY, 2))
    drawn = drawn[np.linalg.norm(drawn, axis=-1) >= 0.1]
    for axis in range(2):
        assert kstest(offset[:, axis], drawn[:, axis]).pvalue > 1e-4
    assert kstest(np.linalg.norm(offset, axis=-1), np.linalg.norm(drawn, axis=-1)).pvalue > 1e-4
    elsewhere = np.delete(state.pipeline_state.qpos, [13, 14, 15], axis=1)
    np.testing.assert_array_equal(elsewhere, np.repeat(elsewhere[:1], MANY, axis=0))
    np.testing.assert_allclose(state.pipeline_state.qpos[0, 16:20], [1.0, 0.0, 0.0, 0.0], atol=1e-3)


def check_random_positions(env, positions):
    offset = positions - env.initial_gripper_position
    for axis in range(2):
        assert is_uniform(offset[:, axis], -0.15, 0.15)
    height = np.maximum(RNG.uniform(-0.15, 0.15, 20 * MANY) + env.initial_gripper_position[2], 0.42).astype(np.float32)
    assert kstest(positions[:, 2], height).pvalue > 1e-4
    assert positions[:, 2].min() == np.float32(0.42)
    above = positions[positions[:, 2] > positions[:, 2].min()]
    assert np.abs(np.corrcoef(above.T) - np.eye(3)).max() < 0.12


def test_grasp_is_measured_on_the_cube_and_half_learns_elsewhere(tasks, starts):
    env = tasks["grasp"]
    measured, learnt = starts["grasp"]
    np.testing.assert_array_equal(
        measured.info["desired_goal"], np.pad(cubes(measured), ((0, 0), (0, 1)), constant_values=1)
    )
    goal, cube = learnt.info["desired_goal"], cubes(learnt)
    held = goal[:, 3] == 1.0
    np.testing.assert_array_equal(env.goal_kind(goal), held)
    assert abs(held.mean() - 0.5) < 0.04
    np.testing.assert_array_equal(goal[held, :3], cube[held])
    np.testing.assert_array_equal(goal[~held, 3], 0.0)
    check_random_positions(env, goal[~held, :3])
    drawn = np.concatenate([goal[~held, :2], cube[~held, :2]], axis=1)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(4)).max() < 0.12


def test_the_kind_of_a_grasp_s_goal_is_whether_the_cube_is_held(tasks):
    goals = jnp.array([[9.0, 9.0, 9.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.5], [9.0, 9.0, 9.0, 0.8]])
    np.testing.assert_array_equal(tasks["grasp"].goal_kind(goals), [0, 1, 0, 1])
    assert tasks["grasp"].goal_kind(goals).dtype == jnp.int32


def test_a_cube_is_held_where_both_pads_touch_it_and_the_gap_is_its_width(tasks, starts):
    env = tasks["grasp"]
    physics = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), starts["grasp"][0].pipeline_state)
    cases = (((1.0, 1.0), 0.05, 1), ((1.0, 1.0), 0.0425, 1), ((1.0, 1.0), 0.0575, 1), ((1.0, 1.0), 0.0415, 0))
    cases += (((1.0, 1.0), 0.0585, 0), ((1.0, 0.0), 0.05, 0), ((0.0, 1.0), 0.05, 0), ((1.0, 1.0), 0.07, 0))
    for touch, gap, held in cases:
        placed = physics.replace(
            qpos=physics.qpos.at[env.robot._finger_qpos].set(jnp.array([0.4, 0.6]) * gap), sensordata=jnp.array(touch)
        )
        assert env.gap(placed) == pytest.approx(gap, rel=1e-5)
        assert env.holding(placed) == held
        np.testing.assert_allclose(env.features(placed)[6:], [gap, held], rtol=1e-5)
        np.testing.assert_allclose(env.achieved_goal(placed), [*physics.gripper_position, held])
    edge = np.array([0.05 + 0.008, 0.05 - 0.008])
    edge = np.concatenate([np.nextafter(edge, 0), edge, np.nextafter(edge, 1)])
    edge = edge[abs(edge - 0.05) == 0.008]
    assert len(edge) > 0
    assert is_held(True, edge).all()


def test_success_of_grasp_takes_position_and_holding(tasks):
    at, off = np.float32([1.3, 0.7, 0.45]), np.float32([0.03, 0.0, 0.03])
    env = tasks["grasp"]
    for shift in (0.0, 1.0, -1.0, 1.5):
        for held in (0.0, 1.0):
            for wanted in (0.0, 1.0):
                found = env.success(jnp.append(at + shift * off, held), jnp.append(at, wanted))
                assert found == (abs(shift) < 1.2 and held == wanted)
    np.testing.assert_array_equal(
        env.success(jnp.stack([jnp.append(at, 1.0), jnp.append(at + 1, 1.0)]), jnp.append(at, 1.0)), [True, False]
    )


def test_grasp_s_goal_test_is_that_of_the_physics(tasks, starts):
    env, count, rng = tasks["grasp"], 200, np.random.default_rng(0)
    physics = jax.tree.map(lambda leaf: leaf[:count], starts["grasp"][0].pipeline_state)
    held, wanted = rng.integers(2, size=(2, count, 1)).astype(np.float32)
    qpos = physics.qpos.copy()
    qpos[:, env.robot._finger_qpos] = 0.025 * held
    physics = physics.replace(qpos=qpos, sensordata=held * np.ones_like(physics.sensordata))
    shift = rng.normal(scale=0.03, size=(count, 3))
    goals = np.concatenate([physics.gripper_position + shift, wanted], axis=1).astype(np.float32)
    found = env.goal_test(jax.vmap(env.features)(physics), jax.vmap(env.achieved_goal)(physics), goals)
    np.testing.assert_array_equal(found, jax.vmap(env.reached)(physics, goals))
    np.testing.assert_array_equal(found, (np.linalg.norm(shift, axis=1) <= 0.05) & (held == wanted)[:, 0])


def test_a_lift_test_goes_straight_up_and_keeps_the_hand_s_command(tasks):
    np.testing.assert_allclose(tasks["grasp"].lift_test_action(jnp.array([0.3, -0.4, -0.5, 0.7])), [0.0, 0.0, 1.0, 0.7])


def test_a_grasp_succeeds_where_the_cube_is_touched_and_rises(tasks, starts):
    env = tasks["grasp"]
    end = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), starts["grasp"][0])
    physics = end.pipeline_state
    for touch in (0.0, 1.0):
        fingers = physics.qpos.at[env.robot._finger_qpos].set(0.025)
        last = physics.replace(qpos=fingers, sensordata=jnp.full(2, touch))
        for rise in (-0.2, 0.0, 0.045, 0.055, 0.3):
            lifted = last.replace(qpos=fingers.at[15].add(rise).at[13].add(0.1), gripper_position=jnp.zeros(3))
            outcome = env.outcome(end.replace(pipeline_state=last), end.replace(pipeline_state=lifted))
            assert outcome.achieved == touch
            assert outcome.success == (touch and rise > 0.05)
            distance = np.asarray(physics.gripper_position - physics.qpos[CUBE])
            np.testing.assert_allclose(outcome.distance_l1, np.abs(distance).sum(), rtol=1e-4)
            np.testing.assert_allclose(outcome.distance_l2, np.sqrt((distance**2).sum()), rtol=1e-4)
            assert outcome.success_l1 == 0.0
    low, high = (end.replace(pipeline_state=last.replace(qpos=fingers.at[15].set(z))) for z in (0.0, 0.05))
    assert env.outcome(low, high).success == 0.0  # it is to rise by more


@pytest.mark.parametrize("action", [0.5, jnp.zeros(1), jnp.zeros(4), jnp.zeros((1, 3))])
def test_an_action_of_another_shape_is_refused_where_it_would_broadcast(action):
    env = hgail_envs.make("point")
    with pytest.raises(ValueError, match=r"an action has the shape .*; it must be \(3,\)"):
        env.step(env.reset(jax.random.key(0)), action)


BRAX_S_TRAINERS = {
    "es": {"num_timesteps": 800, "population_size": 4},
    "ars": {"num_timesteps": 800, "number_of_directions": 4, "top_directions": 2},
    "apg": {"policy_updates": 2, "horizon_length": 5, "num_envs": 4},
    "sac": {"num_timesteps": 400, "num_envs": 4, "batch_size": 16, "min_replay_size": 50, "max_replay_size": 1000},
    "ppo": {"num_timesteps": 2000, "num_envs": 4, "batch_size": 4, "num_minibatches": 1, "num_updates_per_batch": 1},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BRAX_S_TRAINERS)
def test_brax_s_trainers_train_on_it_as_far_as_they_run_on_this_jax(name):
    """As `GoalEnv` says."""
    train = importlib.import_module(f"brax.training.agents.{name}.train").train
    sizes, measured = {"episode_length": 50, "num_evals": 2, "num_eval_envs": 4}, []

    def progress(steps, metrics):
        measured.append(float(metrics["eval/episode_reward"]))

    needs_older = name in ("apg", "sac", "ppo") and not hasattr(jax, "device_put_replicated")
    with pytest.raises(AttributeError) if needs_older else contextlib.nullcontext():
        train(environment=hgail_envs.make("point"), progress_fn=progress, **sizes, **BRAX_S_TRAINERS[name])
    assert bool(measured) != needs_older
    assert all(-50.0 <= reward <= 0.0 for reward in measured)


@pytest.mark.parametrize("task", hgail_envs.TASKS)
def test_every_goal_of_the_box_around_an_achieved_one_is_reached(task):
    """Goals of all kinds: random positions with all flags, displaced to the corners of the box and at random."""
    env, rng = hgail_envs.make(task), np.random.default_rng(0)
    flags = np.array(list(itertools.product([0.0, 1.0], repeat=env.goal_size - 3)))
    achieved = np.concatenate([rng.uniform(0.3, 1.5, (len(flags), 3)), flags], axis=-1).astype(np.float32)
    half, success = np.asarray(jax.jit(env.goal_tolerance)(achieved)), jax.jit(env.success)
    assert half.shape == achieved.shape and (half[:, 3:] == 0).all() and (half[:, :2] > 0.01).all()
    corners = np.array([*itertools.product([-1.0, 1.0], repeat=3), *rng.uniform(-1.0, 1.0, (50, 3))])
    signs = np.concatenate([corners, np.zeros((len(corners), env.goal_size - 3))], axis=-1)
    inside = achieved + 0.999 * signs[:, None] * half
    outside = achieved + 1.6 * signs[:8, None] * half
    assert success(np.broadcast_to(achieved, inside.shape), inside).all()
    assert not success(np.broadcast_to(achieved, outside.shape), outside).any()
