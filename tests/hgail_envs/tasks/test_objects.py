"""Push, pick and place and slide: goals, observations and outcomes, against plain NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, uniform

import hgail_envs
from experiments import FEW_UPDATES
from hgail_jax import PPO, Config, init_state, phase_table, train_step
from hgail_jax.play.recording import run_controller
from hgail_jax.settings.defaults import DEFAULTS
from tests.support import starts_of

MANY = 3000
KEYS = jax.random.split(jax.random.key(0), MANY)
TASKS = ("push", "pick-and-place", "slide")
HAND = {"push": 0, "pick-and-place": 2, "slide": 0}


@pytest.fixture(scope="module")
def tasks():
    return {name: hgail_envs.make(name, impl="c", substeps=8) for name in TASKS}


@pytest.fixture(scope="module")
def starts(tasks):
    return {name: starts_of(env, KEYS) for name, env in tasks.items()}


def first(state):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), state.pipeline_state)


def moved(env, physics, shift):
    return physics.replace(qpos=physics.qpos.at[env.qpos_of(env.object_name)].add(jnp.asarray(shift)))


@pytest.mark.parametrize("name", TASKS)
def test_observations_are_as_documented(name, tasks, starts):
    env, state = tasks[name], starts[name][0]
    physics = state.pipeline_state
    thing = physics.qpos[:, env.qpos_of(env.object_name)]
    gripper = physics.gripper_position
    features = [gripper, physics.gripper_velocity, thing - gripper, thing, np.zeros((MANY, 3 + HAND[name]))]
    np.testing.assert_allclose(state.obs[:, :-4], np.concatenate(features, axis=-1), atol=1e-4)
    np.testing.assert_array_equal(state.obs[:, -4:], state.info["desired_goal"])
    assert env.observation_size == 15 + HAND[name] + 4
    one = first(state)
    moving = one.replace(qvel=one.qvel.at[env.qvel_of(env.object_name)].set(jnp.array([1.0, -2.0, 3.0])))
    np.testing.assert_allclose(env.features(moving)[12:15], [0.04, -0.08, 0.12], rtol=1e-5)


def test_pick_and_place_sees_its_hand(tasks, starts):
    env = tasks["pick-and-place"]
    physics = first(starts["pick-and-place"][0])
    for touch, gap, held in (((1, 1), 0.05, 1), ((1, 0), 0.05, 0), ((0, 1), 0.05, 0), ((1, 1), 0.06, 0)):
        placed = physics.replace(
            qpos=physics.qpos.at[env.robot._finger_qpos].set(jnp.array([0.4, 0.6]) * gap),
            sensordata=jnp.array(touch, float),
        )
        np.testing.assert_allclose(env.features(placed)[15:], [gap, held], rtol=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_what_is_achieved_is_the_gripper_s_until_the_object_has_moved(name, tasks, starts):
    env, physics = tasks[name], first(starts[name][0])
    start = physics.qpos[env.qpos_of(env.object_name)]
    for shift, is_moved in (
        ([0, 0, 0], 0),
        ([0.009, 0, 0], 0),
        ([0.011, 0, 0], 1),
        ([0, -0.02, 0], 1),
        ([0, 0, 0.02], 1),
    ):
        achieved = env.achieved_goal(moved(env, physics, shift))
        expected = [*(start + jnp.array(shift)), 1.0] if is_moved else [*physics.gripper_position, 0.0]
        np.testing.assert_allclose(achieved, expected, atol=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_the_object_is_measured_whether_it_has_moved_or_not(name, tasks, starts):
    env, state = tasks[name], jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), starts[name][0])
    thing = state.pipeline_state.qpos[env.qpos_of(env.object_name)]
    for shift in ([0.0, 0.0, 0.0], [0.03, 0.03, 0.0], [0.04, 0.04, 0.0], [0.0, 0.0, 0.2]):
        goal = jnp.append(thing + jnp.array(shift), 1.0)
        distance, l1 = np.linalg.norm(shift), np.abs(shift).sum()
        outcome = env.outcome(state.replace(info=state.info | {"desired_goal": goal}), None)
        reached = float(distance <= 0.05)
        assert (outcome.success, outcome.achieved) == (reached, reached)
        assert outcome.success_l1 == float(l1 <= 0.05)
        np.testing.assert_allclose((outcome.distance_l2, outcome.distance_l1), (distance, l1), atol=1e-6)
        assert env.reached(state.pipeline_state, goal) == reached
        assert not env.success(env.achieved_goal(state.pipeline_state), goal)  # for it has not moved
    gripper = state.pipeline_state.gripper_position
    assert env.reached(state.pipeline_state, jnp.append(gripper + 0.02, 0.0))
    assert not env.reached(state.pipeline_state, jnp.append(gripper + 0.04, 0.0))


def test_a_puck_that_moves_achieves_nothing(tasks, starts):
    """A place that it only passes is none that it was brought to."""
    env, physics = tasks["slide"], first(starts["slide"][0])
    physics = moved(env, physics, [0.3, 0.1, 0.0])
    for velocity, rests in (([0.03, 0.03, 0.0], True), ([0.04, -0.04, 0.0], False), ([0.0, 0.0, -0.06], False)):
        sliding = physics.replace(qvel=physics.qvel.at[env.qvel_of(env.object_name)].set(jnp.array(velocity)))
        expected = np.append(env.object_position(physics), 1.0) if rests else np.append(physics.gripper_position, 0.0)
        np.testing.assert_array_equal(env.achieved_goal(sliding), expected.astype(np.float32))
        assert env.reached(sliding, jnp.append(env.object_position(physics), 1.0))  # which is by position alone


def test_a_puck_may_achieve_the_places_that_it_passes(starts):
    env = hgail_envs.make("slide", impl="c", substeps=8, achieved="passed")
    start = first(starts["slide"][0])
    fast = start.replace(qvel=start.qvel.at[env.qvel_of(env.object_name)].set(jnp.array([1.0, 0.0, 0.0])))
    passing = moved(env, fast, [0.3, 0.1, 0.0])
    np.testing.assert_array_equal(env.achieved_goal(passing), jnp.append(env.object_position(passing), 1.0))
    np.testing.assert_array_equal(env.achieved_goal(fast), jnp.append(fast.gripper_position, 0.0))  # not moved yet
    with pytest.raises(ValueError, match="achieved is 'near'; choose from at-rest, passed"):
        hgail_envs.make("slide", impl="c", achieved="near")


@pytest.mark.parametrize(
    ("name", "observation"), [*((name, "compact") for name in TASKS), ("push", "official"), ("slide", "official")]
)
def test_features_suffice_to_test_goals_as_the_physics_does(name, observation, tasks, starts):
    env, count, rng = tasks[name], 200, np.random.default_rng(0)
    if observation == "official":
        env = hgail_envs.make(name, impl="c", substeps=8, observation=observation)
    physics = jax.tree.map(lambda leaf: leaf[:count], starts[name][0].pipeline_state)
    qpos = physics.qpos.copy()
    qpos[: count // 2, env.qpos_of(env.object_name)] += 0.2  # half of the objects have moved
    physics = physics.replace(qpos=qpos)
    whose, shift = rng.integers(2, size=(count, 1)), rng.normal(scale=0.03, size=(count, 3))
    position = np.where(whose, qpos[:, env.qpos_of(env.object_name)], physics.gripper_position)
    goals = np.concatenate([position + shift, whose], axis=1).astype(np.float32)
    features, achieved = jax.vmap(env.features)(physics), jax.vmap(env.achieved_goal)(physics)
    found = env.goal_test(features, achieved, goals)
    np.testing.assert_array_equal(found, jax.vmap(env.reached)(physics, goals))
    np.testing.assert_array_equal(found, np.linalg.norm(shift, axis=1) <= 0.05)
    assert 0.2 < np.mean(found) < 0.8
    assert (np.asarray(found) & ~np.asarray(env.success(achieved, goals))).any()  # objects that have not moved


def test_kinds_and_success_of_goals(tasks):
    env = tasks["pick-and-place"]
    goals = jnp.array(
        [[1, 1, 0.42, 0], [1, 1, 0.9, 0], [1, 1, 0.425, 1], [1, 1, 0.449, 1], [1, 1, 0.451, 1], [1, 1, 0.02, 1]]
    )
    np.testing.assert_array_equal(env.goal_kind(goals), [0, 0, 1, 1, 2, 2])
    assert env.goal_kinds == 3
    at = jnp.array([1.3, 0.7, 0.45])
    for shift, near in ((0.02, 1), (0.04, 0)):
        for achieved in (0.0, 1.0):
            for wanted in (0.0, 1.0):
                found = env.success(jnp.append(at + shift, achieved), jnp.append(at, wanted))
                assert found == (near and achieved == wanted)


def test_places_of_the_puck_are_of_fifteen_kinds(tasks):
    env = tasks["slide"]
    x, y, _ = env.initial_gripper_position
    ahead, aside = np.array([-0.2, 0.09, 0.11, 0.24, 0.26, 0.39, 0.41, 0.54, 0.56, 0.7]), np.array([-0.11, -0.09, 0.2])
    places = np.stack(np.meshgrid(x + ahead, y + aside, indexing="ij"), axis=-1)
    goals = jnp.concatenate([places, np.full((10, 3, 1), 0.42), np.ones((10, 3, 1))], axis=-1)
    np.testing.assert_array_equal(env.goal_kind(goals), np.repeat(np.arange(1, 16).reshape(5, 3), 2, axis=0))
    np.testing.assert_array_equal(env.goal_kind(goals.at[..., 3].set(0.0)), np.zeros((10, 3)))
    np.testing.assert_array_equal(env.goal_kind(goals.at[..., 2].set(0.02)), np.full((10, 3), 16))
    assert env.goal_kinds == 17


@pytest.mark.parametrize("observation", ["compact", "official"])
def test_a_goal_of_the_object_is_solved_where_it_already_is(observation, starts):
    env = hgail_envs.make("push", impl="c", observation=observation)
    features = jax.vmap(env.features)(starts["push"][0].pipeline_state)
    thing = starts["push"][0].pipeline_state.qpos[:, env.qpos_of(env.object_name)]
    shift = np.random.default_rng(0).normal(scale=0.02, size=(MANY, 3)).astype(np.float32)
    for whose in (0.0, 1.0):
        goal = np.concatenate([thing + shift, np.full((MANY, 1), whose, np.float32)], axis=1)
        solved = env.already_solved(features, goal)
        np.testing.assert_array_equal(solved, (np.linalg.norm(shift, axis=1) <= 0.03) & (whose == 1.0))


@pytest.mark.parametrize("name", TASKS)
def test_measured_goals_stay_and_are_the_object_s(name, tasks, starts):
    env, state = tasks[name], starts[name][0]
    goal = state.info["desired_goal"]
    np.testing.assert_array_equal(goal[:, 3], 1.0)
    middle = env.initial_gripper_position[:2] + np.array([0.4 if name == "slide" else 0.0, 0.0])
    width = 0.3 if name == "slide" else 0.15
    for axis in range(2):
        offset = goal[:, axis] - middle[axis]
        assert kstest(offset, uniform(-width, 2 * width).cdf).pvalue > 1e-4
    height = goal[:, 2] - env.object_height
    if name == "pick-and-place":
        in_the_air = height > 1e-6
        assert abs(in_the_air.mean() - 0.5) < 0.04
        assert kstest(height[in_the_air], uniform(0, 0.45).cdf).pvalue > 1e-4
    np.testing.assert_allclose(height[height < 1e-6], 0.0, atol=1e-6)
    assert np.abs(np.corrcoef(goal[:, :2].T) - np.eye(2)).max() < 0.08
    far = moved(env, first(state), [0.1, 0.1, 0.1])
    plan = jax.tree.map(lambda leaf: leaf[0], state.info["plan"])
    for step in (0, 13, 50):
        np.testing.assert_array_equal(env.current_goal(plan, far, step), goal[0])


@pytest.mark.parametrize("name", ["push", "slide"])
def test_in_half_the_episodes_to_learn_from_the_gripper_roams_near_the_object(name, tasks, starts):
    env, state = tasks[name], starts[name][1]
    plan = state.info["plan"]
    assert abs(plan.roams.mean() - 0.5) < 0.04
    np.testing.assert_array_equal(state.info["desired_goal"][:, 3], ~plan.roams)
    np.testing.assert_array_equal(state.info["desired_goal"][~plan.roams], plan.goal[~plan.roams])
    follow = jax.jit(jax.vmap(env.current_goal, in_axes=(0, 0, None)))
    far = jax.vmap(lambda physics: moved(env, physics, [0.1, 0.2, 0.0]))(state.pipeline_state)
    offsets = []
    for step in range(0, 51):
        goal = np.asarray(follow(plan, far, step))[plan.roams]
        np.testing.assert_array_equal(goal[:, 3], 0.0)
        offset = goal[:, :3] - np.asarray(far.qpos)[plan.roams][:, env.qpos_of(env.object_name)]
        if step % 12 == 0:
            offsets.append(offset)
        np.testing.assert_allclose(offset, offsets[-1], atol=1e-6)
    for axis, (low, high) in enumerate(((-0.12, 0.12), (-0.12, 0.12), (-0.01, 0.05))):
        assert kstest(offsets[0][:, axis], uniform(low, high - low).cdf).pvalue > 1e-4
    drawn = np.concatenate(offsets, axis=1)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(15)).max() < 0.1


def test_half_the_episodes_of_pick_and_place_to_learn_from_are_relays(tasks, starts):
    env, state = tasks["pick-and-place"], starts["pick-and-place"][1]
    plan, goal = state.info["plan"], state.info["desired_goal"]
    cube = state.pipeline_state.qpos[:, env.qpos_of(env.object_name)]
    assert abs(plan.relay.mean() - 0.5) < 0.04
    np.testing.assert_allclose(goal[plan.relay], np.pad(cube[plan.relay], ((0, 0), (0, 1))))
    np.testing.assert_array_equal(goal[~plan.relay], plan.goal[~plan.relay])
    np.testing.assert_array_equal(plan.goal[plan.relay, 3], 1.0)
    elsewhere = ~plan.relay & (goal[:, 3] == 0.0)
    assert abs(elsewhere.mean() - 0.125) < 0.025
    offset = goal[elsewhere, :3] - env.initial_gripper_position
    for axis in range(2):
        assert kstest(offset[:, axis], uniform(-0.15, 0.3).cdf).pvalue > 1e-4
    assert goal[elsewhere, 2].min() == np.float32(0.42)


@pytest.mark.parametrize(("apart", "at_cube"), [(0.039, True), (0.041, False)])
def test_a_relay_advances_where_the_gripper_is_at_the_cube(apart, at_cube, tasks, starts):
    env, state = tasks["pick-and-place"], starts["pick-and-place"][1]
    index = int(np.flatnonzero(state.info["plan"].relay)[0])
    physics, plan = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), (state.pipeline_state, state.info["plan"]))
    cube = physics.gripper_position + jnp.array([0.0, -apart, 0.0])
    placed = physics.replace(qpos=physics.qpos.at[env.qpos_of(env.object_name)].set(cube))
    np.testing.assert_allclose(env.current_goal(plan, placed, 7), plan.goal if at_cube else [*cube, 0.0])


@pytest.mark.parametrize("name", TASKS)
def test_objects_start_around_the_gripper_and_not_too_near(name, tasks, starts):
    env, state = tasks[name], starts[name][0]
    thing = state.pipeline_state.qpos[:, env.qpos_of(env.object_name)]
    width = 0.1 if name == "slide" else 0.15
    offset = thing[:, :2] - env.initial_gripper_position[:2]
    assert np.abs(offset).max() <= width + 1e-6
    assert np.linalg.norm(offset, axis=-1).min() >= 0.1 - 1e-6
    np.testing.assert_array_equal(state.pipeline_state.object_start, thing)


@pytest.mark.parametrize(
    "name", ["push", *(pytest.param(name, marks=pytest.mark.slow) for name in TASKS if name != "push")]
)
def test_the_object_at_rest_stays(name, tasks, starts):
    env, state = tasks[name], jax.tree.map(lambda leaf: leaf[:16], starts[name][0])
    scan = jax.jit(
        lambda state: jax.lax.scan(lambda s, _: (jax.vmap(env.step)(s, jnp.zeros((16, 4))), None), state, None, 50)
    )
    end = np.asarray(scan(state)[0].pipeline_state.qpos)
    start = state.pipeline_state.qpos
    first = env.qpos_of(env.object_name).start
    assert np.abs(end[:, first : first + 3] - start[:, first : first + 3]).max() < 1e-3
    assert np.abs(end[:, first + 4 : first + 6]).max() < 1e-3  # upright


def test_slide_refuses_the_engine_that_cannot_collide_its_puck():
    with pytest.raises(ValueError, match=r"impl 'jax' collides no cylinder with a box, .* use 'c' or 'warp'"):
        hgail_envs.make("slide", impl="jax")


def test_an_unknown_observation_is_refused():
    with pytest.raises(ValueError, match="observation is 'whole'; choose from compact, official"):
        hgail_envs.make("push", observation="whole")


def test_no_controller_reads_the_official_observation():
    """Theirs are other numbers in the same places: they would run, and fail."""
    env = hgail_envs.make("push", impl="c", observation="official")
    with pytest.raises(ValueError, match="no controllers, or none that reads its observation"):
        run_controller(env, "from-behind", 1, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("push", 2.0), ("pick-and-place", 3.0), ("stack", 3.0), ("tower", 3.0)])
def test_mjx_jax_moves_as_c_mujoco(name, most):
    """After an action from equal states, time and again."""
    env, other = (hgail_envs.make(name, impl=impl) for impl in ("c", "jax"))
    step, step_on_jax, place = (jax.jit(jax.vmap(each)) for each in (env.step, other.step, env.place))
    state, rng, errors = jax.vmap(env.reset)(KEYS[:16]), np.random.default_rng(0), []
    controller = next(iter(env.controllers.values()))
    for _ in range(30):
        action = np.clip(controller(state.obs) + rng.uniform(-0.3, 0.3, (16, 4)), -1, 1).astype(np.float32)
        put = state.replace(pipeline_state=place(state.pipeline_state.qpos, state.pipeline_state.qvel))
        state = step(state, action)
        physics, on_jax = state.pipeline_state, step_on_jax(put, action).pipeline_state
        gripper = np.linalg.norm(on_jax.gripper_position - physics.gripper_position, axis=1)
        objects = (on_jax.qpos - physics.qpos)[:, env._scene_model.object_qpos]
        errors.append([gripper, np.linalg.norm(objects, axis=(1, 2))])
    gripper, thing = 1000 * np.moveaxis(errors, 1, 0)
    print(f"{name}: gripper {np.median(gripper):.3f} mm, object 90th percentile {np.percentile(thing, 90):.3f} mm")
    assert np.median(gripper) <= 0.5
    assert np.percentile(thing, 90) <= most


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_a_round_of_training_runs(name, tasks):
    env = tasks[name]
    config = Config(PPO()).replace(num_envs=16, rounds=1, policy_phases=1, discriminator_phases=1, **FEW_UPDATES)
    hyperparameters = DEFAULTS[name]["ppo"]["cpu"].hyperparameters
    state = init_state(env, config, hyperparameters, jax.random.key(0))
    step = jax.jit(functools.partial(train_step, env, config))
    for phases in phase_table(config):
        state, metrics = step(state, phases)
        assert 0.0 <= metrics.evaluation.success <= 1.0
        assert metrics.dropped == metrics.diverged == 0.0
