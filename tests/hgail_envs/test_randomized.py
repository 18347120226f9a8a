"""Randomised tasks: which quantity differs by how much, on a point that moves by known steps."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hgail_envs
from hgail_envs.base import GoalEnv
from hgail_envs.past import Past
from hgail_envs.point import Point
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import RandomizedEnv, randomize
from hgail_jax.hindsight import relabel

STEP = 0.03  # metres by which a whole action moves the point
MANY = 2000
KEYS = jax.random.split(jax.random.key(0), MANY)
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 3)).astype(np.float32)


def follow(env, actions=ACTIONS, key=0, reset=None):
    """Returns the states of an episode under some actions, the start first. To compile its programs takes longer."""
    states = [(reset or env.reset)(jax.random.key(key))]
    for action in actions:
        states.append(env.step(states[-1], action))
    return states


def truth(states):
    return np.array([state.pipeline_state.true for state in states])


def starts(**sizes):
    return jax.vmap(RandomizedEnv(Point(), Randomization(**sizes)).reset)(KEYS)


def test_training_episodes_start_where_the_task_s_own_do():
    """And the history is of that start."""

    class Further(Point):
        def training_start(self, rng, physics, training_goals):
            return physics + jnp.where(training_goals, 1.0 + jax.random.uniform(rng, (3,)), 0.0)

    reset = jax.jit(RandomizedEnv(Further(), Randomization(history=2, robot_offset=0.01)).reset, static_argnums=1)
    for training_goals in (False, True):
        state = reset(jax.random.key(0), training_goals)
        true, seen = np.asarray(state.pipeline_state.true), np.asarray(state.obs)
        assert (true > 1.0).all() if training_goals else (true == 0.0).all()
        np.testing.assert_allclose(seen[12:15], true + state.pipeline_state.errors().robot, atol=1e-6)
        for earlier in (seen[0:6], seen[6:12]):
            np.testing.assert_allclose(earlier, [0, 0, 0, *seen[12:15]], atol=1e-6)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_an_action_comes_as_many_steps_late_as_the_delay(delay):
    states = follow(RandomizedEnv(Point(), Randomization(delay=(delay, delay))))
    late = np.concatenate([np.zeros((delay, 3)), ACTIONS])[: len(ACTIONS)]
    expected = np.concatenate([np.zeros((1, 3)), np.cumsum(STEP * late, axis=0)])
    np.testing.assert_allclose(truth(states), expected, atol=1e-6)


def test_each_delay_is_as_frequent_and_differs_between_episodes():
    delays = np.asarray(starts(delay=(1, 3)).pipeline_state.drawn.delay)
    counts = np.bincount(delays)
    assert counts[0] == 0
    assert stats.chisquare(counts[1:]).pvalue > 1e-4


def test_what_an_episode_draws_is_independent():
    drawn = starts(delay=(0, 3), step_size=(0.6, 1.4), z_bias=(0.0, 0.1), goal_offset=0.01, robot_offset=0.01)
    drawn = drawn.pipeline_state.drawn
    columns = np.column_stack([drawn.delay, drawn.step_size, drawn.z_bias, np.reshape(drawn.offset, (MANY, -1))])
    correlations = np.corrcoef(columns[:, columns.std(axis=0) > 0].T)
    assert correlations.shape == (9, 9)  # three numbers, and the offsets of two sources
    assert np.abs(correlations - np.eye(9)).max() < 5.0 / np.sqrt(MANY)


def test_displacements_are_scaled_and_sink():
    env = RandomizedEnv(Point(), Randomization(step_size=(0.6, 1.4), z_bias=(0.02, 0.05)))
    drawn = jax.vmap(env.reset)(KEYS).pipeline_state.drawn
    for values, (low, high) in ((drawn.step_size, (0.6, 1.4)), (drawn.z_bias, (0.02, 0.05))):
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-4
    states = follow(env)
    factor, z_bias = (
        float(value) for value in (states[0].pipeline_state.drawn.step_size, states[0].pipeline_state.drawn.z_bias)
    )
    assert abs(factor - 1.0) > 0.01
    moves = STEP * (factor * ACTIONS - np.array([0.0, 0.0, z_bias]))
    np.testing.assert_allclose(np.diff(truth(states), axis=0), moves, atol=1e-6)


@pytest.mark.parametrize(("source", "part"), [("robot", "features"), ("goal", "achieved_goal")])
def test_noises_and_offsets_have_their_deviations(source, part):
    noise, offset = 0.01, 0.03
    states = [starts(**{f"{source}_noise": noise, f"{source}_offset": offset})]
    env = RandomizedEnv(Point(), Randomization(**{f"{source}_noise": noise, f"{source}_offset": offset}))
    states.append(jax.vmap(env.step)(states[0], jnp.zeros((MANY, 3))))
    errors = np.array([state.info[part] for state in states])  # the point stays at 0
    for values, deviation in ((errors[0], np.hypot(noise, offset)), (errors[1] - errors[0], np.sqrt(2) * noise)):
        assert stats.kstest(values.ravel(), stats.norm(0.0, deviation).cdf).pvalue > 1e-4
    for first, second in ((0, 1), (1, 2), (0, 2)):
        assert abs(np.corrcoef(errors[0, :, first], errors[0, :, second])[0, 1]) < 0.1  # axes have their own


@pytest.mark.parametrize(("source", "part"), [("robot", "features"), ("goal", "achieved_goal")])
def test_an_offset_stays_for_an_episode_and_is_another_in_the_next(source, part):
    env = RandomizedEnv(Point(), Randomization(**{f"{source}_offset": 0.02}))
    errors = [
        np.array([state.info[part] for state in states]) - truth(states)
        for states in (follow(env, key=k) for k in (1, 2))
    ]
    for error in errors:
        np.testing.assert_allclose(error, np.broadcast_to(error[:1], error.shape), atol=1e-6)
        assert np.abs(error).max() > 1e-3
    assert np.abs(errors[0] - errors[1]).max() > 1e-3


def test_the_desired_goal_has_the_error_of_the_achieved_one():
    env = RandomizedEnv(Point(), Randomization(goal_noise=0.01, goal_offset=0.02))
    for state in follow(env):
        error = state.info["achieved_goal"] - state.pipeline_state.true
        np.testing.assert_allclose(state.info["desired_goal"] - state.info["plan"], error, atol=1e-6)


def test_relabelled_goals_are_positions_as_observed():
    """Each is what was observed of a later step, error and all, and not where the point truly was."""
    env = RandomizedEnv(Point(), Randomization(goal_noise=0.02, goal_offset=0.05))
    states = follow(env, np.tile(ACTIONS, (4, 1)))
    achieved, desired, features = (
        np.array([state.info[name] for state in states]) for name in ("achieved_goal", "desired_goal", "features")
    )
    relabelled = jax.jit(relabel)(jax.random.key(1), achieved, desired[:-1], p_ht=1.0)
    np.testing.assert_array_equal(relabelled.goal, achieved[relabelled.source])
    errors = achieved - features  # the robot's own position is exact here
    assert 0.5 * 0.05 < np.sqrt(np.mean(errors**2)) < 2 * 0.06
    np.testing.assert_allclose(relabelled.goal, features[relabelled.source] + errors[relabelled.source], atol=1e-6)


@pytest.mark.parametrize(("apart", "reward"), [(0.02, 0.0), (0.03, -1.0)])  # along each axis
def test_the_reward_is_of_the_true_positions_on_either_side_of_the_threshold(apart, reward):
    env = RandomizedEnv(Point(), Randomization(goal_offset=5.0, robot_offset=5.0))
    start = env.reset(jax.random.key(0))
    at = start.replace(pipeline_state=start.pipeline_state.replace(true=start.info["plan"] + apart))
    assert np.linalg.norm(start.info["desired_goal"] - start.info["plan"]) > 0.5
    assert env.step(at, jnp.zeros(3)).reward == reward
    assert env.reached(at.pipeline_state, start.info["desired_goal"]) == (reward == 0.0)


def test_success_and_reward_are_of_the_true_positions():
    env = RandomizedEnv(Point(), Randomization(goal_offset=5.0, robot_offset=5.0))
    states = follow(env)
    goal = states[-1].info["plan"]
    at = states[-1].replace(pipeline_state=states[-1].pipeline_state.replace(true=goal + 0.03))
    seen = env.step(at, jnp.zeros(3))
    assert np.linalg.norm(seen.info["desired_goal"] - goal) > 0.5
    assert seen.reward == (0.0 if np.linalg.norm(seen.pipeline_state.true - goal) <= 0.05 else -1.0)
    outcome = env.outcome(at, at)
    np.testing.assert_allclose(outcome.distance_l1, 0.09, atol=1e-6)
    assert outcome.success == float(np.sqrt(3) * 0.03 <= 0.05)
    far = states[-1].replace(pipeline_state=states[-1].pipeline_state.replace(true=goal + 0.03001))
    assert env.outcome(far, far).success == 0.0


def test_the_history_is_what_was_done_and_observed():
    env = RandomizedEnv(Point(), Randomization(delay=(2, 2), robot_noise=0.01, goal_offset=0.01, history=3))
    assert env.observation_size == 3 * (3 + 3) + 3 + 3
    states = follow(env)
    seen = [np.asarray(state.info["features"])[-3:] for state in states]
    rows = [np.concatenate([np.zeros(3), seen[0]])] * 3
    for step, state in enumerate(states):
        if step:
            rows = [np.concatenate([ACTIONS[step - 1], seen[step - 1]]), *rows[:2]]
        expected = np.concatenate([*rows, seen[step]])
        np.testing.assert_allclose(state.info["features"], expected, atol=1e-6)
        np.testing.assert_allclose(state.obs, np.append(expected, state.info["desired_goal"]), atol=1e-6)


@pytest.mark.parametrize(("delay", "known"), [(0, 2), (1, 2), (2, 2), (3, 2), (1, 3)])
def test_a_policy_that_knows_its_delay_observes_what_is_on_its_way(delay, known):
    env = RandomizedEnv(Point(), Randomization(delay=(delay, delay), known_delay=known, history=1))
    assert env.observation_size == 4 * known + 6 + 6
    sent = [np.zeros(3)] * 3
    states = follow(env)
    for step, state in enumerate(states):
        if step:
            sent = [ACTIONS[step - 1], *sent[:2]]
        rows = [np.append(1.0, sent[back]) if back < delay else np.zeros(4) for back in range(known)]
        np.testing.assert_allclose(state.obs[: 4 * known], np.concatenate(rows), atol=1e-6)
        if 0 < delay <= known and step + 1 < len(states):  # the oldest of them is what moves the point next
            moved = states[step + 1].pipeline_state.true - state.pipeline_state.true
            np.testing.assert_allclose(moved, STEP * rows[delay - 1][1:], atol=1e-6)


def test_a_task_without_delay_shows_as_many_numbers():
    nominal = RandomizedEnv(Point(), Randomization(delay=(1, 3), known_delay=3)).nominal()
    assert nominal.randomization == Randomization(known_delay=3)
    assert not np.asarray(follow(nominal)[-1].obs)[: 4 * 3].any()


def test_a_controller_acts_on_the_present_observation():
    env = RandomizedEnv(Point(), Randomization(history=2, known_delay=1))
    state = env.reset(jax.random.key(0))
    (name, controller), plain = next(iter(env.controllers.items())), Point()
    np.testing.assert_array_equal(controller(state.obs), plain.controllers[name](state.obs[-6:]))


def test_nothing_that_is_not_asked_for_changes_a_bit():
    point = Point()
    assert randomize(point, "none") is point
    plain, wrapped = follow(point), follow(RandomizedEnv(point, Randomization()))
    np.testing.assert_array_equal(truth(wrapped), [state.pipeline_state for state in plain])
    np.testing.assert_array_equal(
        [state.info["desired_goal"] for state in wrapped], [wrapped[0].info["plan"]] * len(wrapped)
    )


def test_noises_leave_the_rest_of_an_episode_as_it_is():
    """Each size is drawn with a key of its own, so that episodes can be compared."""
    few, more = (
        RandomizedEnv(Point(), Randomization(delay=(0, 3), goal_offset=0.01, robot_noise=noise)) for noise in (0.0, 0.1)
    )
    first, second = follow(few, key=5), follow(more, key=5)
    np.testing.assert_array_equal(truth(first), truth(second))
    np.testing.assert_array_equal(first[-1].info["desired_goal"], second[-1].info["desired_goal"])


def test_seeds_side_by_side_are_what_each_is_alone():
    env = RandomizedEnv(Point(), Randomization(delay=(0, 3), goal_noise=0.01, robot_offset=0.01, history=2))

    def run(rng):
        return jax.lax.scan(lambda state, action: 2 * (env.step(state, action),), env.reset(rng, True), ACTIONS)[1].info

    rngs = jax.random.split(jax.random.key(0), 2)
    together, of_one = jax.jit(jax.vmap(run))(rngs), jax.jit(run)
    for index, rng in enumerate(rngs):
        each = jax.tree.map(lambda leaf, i=index: leaf[i], together)
        jax.tree.map(lambda *leaves: np.testing.assert_allclose(*leaves, atol=1e-6), each, of_one(rng))
    assert np.abs(np.asarray(together["features"][0] - together["features"][1])).max() > 1e-3


def test_a_randomised_task_fits_the_interface():
    hgail_envs.check_task(RandomizedEnv(Point(), Randomization(delay=(0, 3), goal_offset=0.01, history=3)))


def test_a_target_is_dragged_to_its_true_place():
    env = RandomizedEnv(Point(), Randomization(goal_offset=0.05))
    state = follow(env)[-1]
    moved = env.move_target(state, jnp.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(moved.info["plan"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        moved.info["desired_goal"], moved.info["plan"] + state.pipeline_state.goal_error, atol=1e-6
    )


def test_what_a_task_lacks_is_refused():
    class Bare(Point):
        add_sensor_noise = GoalEnv.add_sensor_noise

    RandomizedEnv(Bare(), Randomization(goal_offset=0.01, delay=(0, 1)))
    with pytest.raises(ValueError, match="Bare cannot be randomised so: it has no add_sensor_noise"):
        RandomizedEnv(Bare(), Randomization(robot_noise=0.01))
    with pytest.raises(ValueError, match="Point cannot be randomised so: it has no vary_model"):
        randomize(Point(), "mild")
    with pytest.raises(ValueError, match="Point cannot be randomised so: it has no vary_start"):
        RandomizedEnv(Point(), Randomization(posture=0.01))
    with pytest.raises(ValueError, match="unknown randomize 'wild'; choose from none, other-arms, mild, full"):
        randomize(Point(), "wild")


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("delay", (2, 1), "a least and a most from 0 to 50"),
        ("delay", (0, 1.5), "a least and a most"),
        ("delay", (-1, 1), "from 0"),
        ("delay", (0, 51), "to 50"),
        ("history", -1, "an integer from 0 to 50"),
        ("history", 1.0, "an integer"),
        ("step_size", (0.0, 1.0), "a least and a most from 0.01 to 100"),
        ("friction", 0.5, "a least and a most from 0.01 to 100"),
        ("z_bias", (0.0, np.inf), "a least and a most"),
        ("goal_noise", -0.1, "a number from 0"),
        ("robot_offset", True, "a number from 0"),
        ("hand_opening", 1.5, "a number from 0 to 1"),
        ("posture", 0.2, "a number from 0 to 0.15"),
        ("z_bias", (-2.0, 0.0), "a least and a most from -1 to 1"),
        ("ramp", 1.5, "a number from 0 to 1"),
    ],
)
def test_sizes_out_of_range_are_refused(name, value, allowed):
    with pytest.raises(ValueError, match=f"{name} is .*; it must be .*{allowed}"):
        Randomization(**{name: value})


@pytest.mark.parametrize("level", LEVELS)
def test_a_randomisation_comes_back_from_json(level):
    content = json.loads(json.dumps(dataclasses.asdict(LEVELS[level])))
    assert Randomization.from_json(content) == LEVELS[level]
    content |= {"growth": content.pop("ramp"), "sag": content.pop("z_bias")}  # as older files have it
    assert Randomization.from_json(content) == LEVELS[level]
    with pytest.raises(ValueError, match="a randomisation has no field 'wind'"):
        Randomization.from_json({"wind": 1.0})


def test_a_randomisation_of_an_earlier_release_has_a_nominal_hand():
    """As the published robust policies have it."""
    content = json.loads(json.dumps(dataclasses.asdict(LEVELS["full-history"])))
    for name in ("hand_width", "pad_size"):
        del content[name]
    older = Randomization.from_json(content)
    assert older.hand_width == older.pad_size == (1.0, 1.0)
    assert older != LEVELS["full-history"]


def test_a_level_that_varies_nothing_adds_the_last_step_to_the_observation():
    """The last action, and what was seen before it; all else is as without it."""
    plain, env = hgail_envs.make("point"), randomize(hgail_envs.make("point"), "none-history")
    action, key = jnp.array([0.4, -0.3, 0.2]), jax.random.key(0)
    before, state = plain.reset(key), env.reset(key)
    sizes = (plain.action_size, plain.feature_size)
    np.testing.assert_allclose(state.obs[sum(sizes) :], before.obs)
    after, state = plain.step(before, action), env.step(state, action)
    np.testing.assert_allclose(state.obs, jnp.concatenate([action, before.obs[: sizes[1]], after.obs]), atol=1e-6)


def test_what_the_levels_have_of_full():
    full, arms = LEVELS["full"], vars(LEVELS["other-arms"])
    assert LEVELS["full-known-delay"] == dataclasses.replace(full, known_delay=full.delay[1])
    differing = {name for name, size in arms.items() if size != getattr(Randomization(), name)}
    errors = {f"{what}_{kind}" for what in ("robot", "object", "goal") for kind in ("noise", "offset")}
    hands = {"friction", "finger_speed", "hand_width", "pad_size"}
    assert differing == errors | hands | {"step_size", "hand_opening", "ramp"}
    assert {name for name in differing if arms[name] != getattr(full, name)} == {"step_size", "goal_offset"}
    assert arms["step_size"] == (0.4, full.step_size[1])
    assert arms["goal_offset"] == 3 * full.goal_offset


def test_nominal_is_no_randomisation_with_the_same_history():
    full = LEVELS["full-history"]
    assert full.nominal() == Randomization(history=full.history)
    assert full.history > 0


RAMPS = Randomization(
    delay=(1, 3), step_size=(0.6, 1.4), z_bias=(-0.1, 0.2), goal_offset=0.03, robot_noise=0.02, ramp=0.5
)


@jax.jit
def ramp_reset(keys, progress):
    """Returns the starts of as many episodes once this share of a training is done."""
    return jax.vmap(RandomizedEnv(Point(), RAMPS).curriculum(progress).reset)(keys)


@pytest.mark.parametrize(
    ("progress", "present"),
    [
        (0.0, Randomization()),
        (0.25, Randomization(step_size=(0.8, 1.2), z_bias=(-0.05, 0.1), goal_offset=0.015, robot_noise=0.01)),
        (0.5, RAMPS),
        (1.0, RAMPS),
    ],
)
def test_sizes_ramp_from_nominal(progress, present):
    ramped = jax.tree.map(lambda leaf: leaf[0], ramp_reset(KEYS, progress))
    there = jax.jit(RandomizedEnv(Point(), present).reset)(KEYS[0])
    for name in ("step_size", "z_bias", "offset"):
        pair = [getattr(state.pipeline_state.drawn, name) for state in (ramped, there)]
        np.testing.assert_allclose(*pair, atol=1e-6)
    np.testing.assert_allclose(ramped.info["features"], there.info["features"], atol=1e-6)


@pytest.mark.parametrize(("progress", "delays"), [(0.0, {0}), (0.25, {0, 1, 2}), (0.5, {1, 2, 3}), (1.0, {1, 2, 3})])
def test_a_delay_ramps_by_whole_steps(progress, delays):
    drawn = ramp_reset(KEYS, progress).pipeline_state.drawn.delay
    assert drawn.dtype == jnp.int32
    assert set(np.asarray(drawn).tolist()) == delays


def test_a_known_delay_is_whole_from_the_start_while_the_rest_ramps():
    env = RandomizedEnv(Point(), dataclasses.replace(RAMPS, known_delay=3)).curriculum(0.25)
    drawn = jax.vmap(env.reset)(KEYS).pipeline_state.drawn
    assert set(np.asarray(drawn.delay).tolist()) == {1, 2, 3}
    assert np.abs(np.asarray(drawn.step_size) - 1.0).max() <= 0.2  # half of what is drawn once the ramp is over
    assert np.abs(np.asarray(drawn.step_size) - 1.0).max() > 0.1


@pytest.mark.parametrize("progress", [0.0, 0.3])
def test_without_a_ramp_the_sizes_are_whole_from_the_start(progress):
    env = RandomizedEnv(Point(), dataclasses.replace(RAMPS, ramp=0.0))
    reset = jax.jit(lambda env_reset: env_reset(jax.random.key(3)), static_argnums=0)
    jax.tree.map(np.testing.assert_array_equal, reset(env.curriculum(progress).reset), reset(env.reset))


def test_its_task_may_become_harder_itself(monkeypatch):
    monkeypatch.setattr(Point, "curriculum", lambda self, progress: f"the point after {progress}")
    assert RandomizedEnv(Point(), RAMPS).curriculum(0.25).task == "the point after 0.25"


def test_its_task_is_prepared(monkeypatch):
    prepared = []
    monkeypatch.setattr(Point, "prepare", lambda self: prepared.append(self))
    task = Point()
    RandomizedEnv(task, Randomization(delay=(0, 1))).prepare()
    assert prepared == [task]


# The past of a policy on a robot


@pytest.mark.parametrize(("known", "history"), [(0, 0), (0, 3), (2, 0), (2, 1), (4, 2)])
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_past_on_a_robot_is_what_the_policy_read_in_training(known, history, delay):
    delay = min(delay, known or delay)
    sizes = Randomization(delay=(delay, delay), robot_noise=0.01, history=history, known_delay=known)
    env, past = RandomizedEnv(Point(), sizes), Past(sizes, delay, action_size=3)
    state = env.reset(jax.random.key(0))
    for action in ACTIONS[:7]:
        features = np.asarray(state.info["features"])
        seen = features[-3:]
        np.testing.assert_array_equal(np.append(past.before(seen), seen), features)
        past.add(action, seen)
        state = env.step(state, action)


@pytest.mark.parametrize("delay", [-1, 3])
def test_a_delay_that_the_policy_does_not_know_is_refused(delay):
    with pytest.raises(ValueError, match=f"delay is {delay}; the policy knows delays from 0 to 2"):
        Past(Randomization(known_delay=2), delay)
    Past(Randomization(history=1), 3)
