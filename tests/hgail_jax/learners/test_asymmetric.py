"""TD3 with an actor that sees pictures: which picture belongs to which sample, and what is learnt from it."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.base import GoalEnv
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax import Config, init_state, phase_table, train_step
from hgail_jax.buffer import draw
from hgail_jax.learner import EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.learners.asymmetric import AsymmetricTD3, PictureInput, PictureStep, with_pictures
from hgail_jax.learners.td3 import TD3Hyperparameters
from hgail_jax.learners.td3_step import Batch, critic_network
from hgail_jax.vision.network import look
from hgail_jax.vision.training import LEAST_STD, OBJECT_SCALE

SIZE, LENGTH = 16, 8
_MODEL = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
LEARNER = AsymmetricTD3(rollouts=1, updates=2, batch=32, buffer_episodes=6, channels=(4, 4, 4, 4))
CONFIG = Config(LEARNER, num_envs=4, rounds=2, discriminator_minibatches=0, policy_hidden=(16,), layer_norm=True)
HYPER = TD3Hyperparameters(p_ht=0.8, environment_reward=1.0, bc_weight=0.0, discount=0.9)


class Physics(NamedTuple):
    qpos: jax.Array


class Puck(GoalEnv):
    """Actions move it by up to 0.3 m along each axis; places and goals are within 1 m of the middle.

    Its place is in its picture and in none of the actor's numbers.
    """

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 2, 2, 2, 0.2

    def reset_physics(self, rng):
        place = jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0)
        return Physics(jnp.concatenate([place, jnp.array([0.0, 1.0, 0.0, 0.0, 0.0])]))

    def step_physics(self, physics, action):
        return Physics(physics.qpos.at[:2].set(jnp.clip(physics.qpos[:2] + 0.3 * action, -1.2, 1.2)))

    def features(self, physics):
        return physics.qpos[:2]

    def achieved_goal(self, physics):
        return physics.qpos[:2]

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0)


class Spot:
    """Its picture: a bright spot, or nothing at all if it is `hidden`."""

    cameras, size, look, renderer, target, kind = ("above",), SIZE, "plain", "spot", "given", "colour"
    shape, draws, joints, marker = (1, SIZE, SIZE, 3), 1, 7, False
    model = mujoco.MjModel.from_xml_string(_MODEL)

    def __init__(self, hidden=False):
        self.hidden = hidden

    def __call__(self, qpos, draws):
        x, y = jnp.moveaxis((qpos[..., :2] + 1.3) / 2.6 * SIZE, -1, 0)
        grid = jnp.arange(SIZE) + 0.5
        across, down = (jnp.exp(-jnp.square(grid - at[..., None]) / 2.0) for at in (x, y))
        spot = jnp.where(self.hidden, 0.0, across[..., None, :] * down[..., :, None])
        return (255.0 * spot[..., None, :, :, None] * jnp.ones(3)).astype(jnp.uint8)


def puck(hidden=False):
    """Returns the task with pictures."""
    return CameraEnv(Puck(), Spot(hidden))


@functools.cache
def step_of():
    return jax.jit(functools.partial(train_step, puck(), CONFIG))


@functools.cache
def untrained():
    return jax.jit(functools.partial(init_state, puck(), CONFIG))(HYPER, jax.random.key(0))


def row(*phases):
    return np.array([*phases, *[SKIP] * (2 - len(phases))])


@functools.cache
def trained():
    """A state whose buffer was written round its end."""
    state = untrained()
    for phases in (row(PRETRAIN), row(POLICY), row(POLICY, EVALUATE)):
        state, metrics = step_of()(state, phases)
        assert metrics.diverged in (0.0, np.inf)
    return state


def places(pictures):
    """Returns where the spot of each picture, `[..., pixels]`, is: `[..., 2]`, by its centre of mass."""
    image = np.asarray(pictures, float).reshape(*pictures.shape[:-1], SIZE, SIZE, 3)[..., 0]
    grid = (np.arange(SIZE) + 0.5) / SIZE * 2.6 - 1.3
    mass = image.sum(axis=(-2, -1))
    return (
        np.stack([(image * grid).sum(axis=(-2, -1)), (image * grid[:, None]).sum(axis=(-2, -1))], -1) / mass[..., None]
    )


NEAR = 0.1  # m; near the border half of a spot is outside


def assert_pictures_show(pictures, puck_at):
    apart = np.abs(places(pictures) - np.asarray(puck_at))
    inside = (np.abs(puck_at) < 0.8).all(axis=-1)
    assert inside.sum() > 10 and apart[inside].max() < NEAR


def test_the_buffer_keeps_of_each_step_the_picture_of_the_state_that_acted():
    buffer = trained().buffer
    assert buffer.added == 12 and buffer.noted["pictures"].shape == (6, LENGTH, SIZE * SIZE * 3)
    assert_pictures_show(buffer.noted["pictures"], np.asarray(buffer.features[:, :-1]))
    moved = np.abs(np.diff(np.asarray(buffer.features), axis=1)).max(axis=(1, 2))
    assert (moved > 1.5 * NEAR).all()  # so that a picture of another step would be noticed


@functools.cache
def drawn(p_ht=1.0):
    state = trained()
    samples = jax.jit(draw, static_argnums=(0, 4))(
        puck(), state.hyperparameters, state.buffer, jax.random.key(3), 512, p_ht
    )
    inputs = LEARNER.actor_inputs(puck(), state, samples)
    batch = Batch(*[samples.weight] * 3, inputs[0], *[samples.weight] * 3, inputs[1])
    shown = with_pictures(
        puck(), state.buffer.noted, state.learner.centre, batch, jax.random.key_data(jax.random.key(4))
    )
    return samples, shown


def test_a_sample_and_its_next_state_have_pictures_of_their_own_whatever_their_goal():
    samples, shown = drawn()
    assert (np.asarray(shown.weight == 0) == np.asarray(samples.step == LENGTH - 1)).all()
    pictures, following = (
        np.asarray(each).reshape(512, -1) for each in (shown.actor_input.pictures, shown.next_actor_input[0])
    )
    before = np.asarray(samples.step) < LENGTH - 1
    assert 0 < before.sum() < 512
    assert_pictures_show(pictures, np.asarray(samples.features))
    assert_pictures_show(following[before], np.asarray(samples.next_observation)[before, :2])


def test_the_actor_is_given_the_goal_of_hindsight_and_no_place():
    samples, shown = drawn()
    statistics = trained().statistics
    std = np.maximum(statistics.std, LEAST_STD)
    expected = (np.asarray(samples.goal) - statistics.mean[2:]) / std[2:]
    np.testing.assert_allclose(shown.actor_input.numbers, expected, atol=1e-5)
    np.testing.assert_allclose(shown.next_actor_input[1], expected, atol=1e-5)
    buffer = trained().buffer
    pursued = np.asarray(buffer.desired[samples.episode, samples.step])
    assert (np.abs(samples.goal - pursued).max(axis=-1) > 1e-3).mean() > 0.9


def test_objects_are_where_the_picture_shows_them():
    samples, shown = drawn()
    xy = np.asarray(shown.actor_input.objects)[:, :2] * OBJECT_SCALE + np.asarray(trained().learner.centre)[:2]
    np.testing.assert_allclose(xy, samples.features, atol=1e-5)


def test_positions_are_measured_from_their_mean_in_the_first_roll_out():
    begun, _ = step_of()(untrained(), row(PRETRAIN))
    expected = np.asarray(begun.buffer.features[: CONFIG.num_envs, :-1]).mean(axis=(0, 1))
    np.testing.assert_allclose(begun.learner.centre[:2], expected, atol=1e-5)
    assert np.abs(expected).max() > 0.01


def test_an_update_that_is_undone_leaves_no_picture_beside_another_state():
    """Pictures are not undone, but the next roll-out is written over them."""
    state = trained()
    hyper = state.hyperparameters
    broken, metrics = step_of()(
        state.replace(hyperparameters=hyper.replace(policy_learning_rate=hyper.policy_learning_rate * 1e38)),
        row(POLICY),
    )
    assert metrics.diverged == 1.0 and broken.buffer.added == state.buffer.added
    np.testing.assert_array_equal(broken.buffer.features, state.buffer.features)
    assert np.any(broken.buffer.noted["pictures"] != state.buffer.noted["pictures"])
    after, metrics = step_of()(broken.replace(hyperparameters=hyper), row(POLICY))
    assert metrics.diverged == 0.0
    assert_pictures_show(after.buffer.noted["pictures"], np.asarray(after.buffer.features[:, :-1]))


def test_the_actor_follows_the_critics_through_its_action_and_learns_the_objects_places():
    """The gradient is that of the mean value at the action of the pictures, by a separate formula."""
    samples, shown = drawn()
    state = trained()
    batch = shown._replace(
        observation=state.normalize(samples.observation),
        action=samples.action,
        actor_input=PictureInput(*shown.actor_input),
    )
    step = PictureStep(CONFIG.replace(object_weight=0.7), HYPER.as_arrays())
    actor, critics = state.learner.online.actor, state.learner.online.critics
    value = jnp.zeros((2, 512))

    def loss(actor):
        action, objects = look(actor, batch.actor_input.pictures, batch.actor_input.numbers)
        inputs = jnp.concatenate([batch.observation, action], axis=-1)
        of_each = [
            critic_network(CONFIG).apply(jax.tree.map(lambda leaf, i=i: leaf[i], critics), inputs)[:, 0]
            for i in range(2)
        ]
        gained = sum(of_each) / 2.0
        wrong = jnp.square(objects - batch.actor_input.objects).mean(axis=1)
        return (
            -jnp.mean(batch.weight * gained) / jax.lax.stop_gradient(jnp.abs(gained).mean())
            + 0.01 * jnp.square(jnp.arctanh(action)).mean()
            + 0.7 * (batch.weight * wrong).sum() / batch.weight.sum()
        )

    (_, metrics), ours = jax.jit(
        jax.value_and_grad(lambda actor: step.actor_loss(actor, critics, batch, value), has_aux=True)
    )(actor)
    theirs = jax.jit(jax.grad(loss))(actor)
    scale = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(theirs))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-3 * scale), ours, theirs)
    assert 0.0 < metrics["object_error"] < 2.0


def test_evaluation_and_the_policy_s_file_are_of_the_target_actor():
    state = trained()
    arrays = LEARNER.camera_policy(puck(), state)
    observation = jax.jit(jax.vmap(puck().reset))(jax.random.split(jax.random.key(5), 4)).obs
    act = jax.jit(lambda state: LEARNER.policy(puck(), CONFIG, state, 0.0)(observation, jax.random.key(0)))
    action, _ = act(state)
    numbers = (observation[:, puck().known] - arrays["mean"]) / arrays["std"]
    pictures = np.float32(puck().see(observation)) / 255.0
    np.testing.assert_allclose(action, jax.jit(look)(state.learner.target.actor, pictures, numbers)[0], atol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, arrays["eyes"], state.learner.target.actor)


@pytest.mark.parametrize(
    ("env", "changes", "message"),
    [
        (hgail_envs.make("point"), {}, "needs a task with pictures: --observe camera"),
        (puck(), {"achieved_first": 0.5}, r"achieved_first is 0\.5; with pictures it must be 0"),
        (puck(), {"policy_hidden": ()}, "policy_hidden is empty"),
        (puck(), {"channels": (4, 4)}, r"channels is \(4, 4\); it must be 4 numbers"),
        (puck(), {"object_weight": -1.0}, r"object_weight is -1\.0"),
    ],
)
def test_sizes_and_tasks_that_do_not_fit_are_refused(env, changes, message):
    with pytest.raises(ValueError, match=message):
        CONFIG.replace(**changes).validate(env)


def test_a_target_in_the_pictures_is_refused():
    env = CameraEnv(Puck(), Spot())
    env.pictures.target = "seen"
    with pytest.raises(ValueError, match="hindsight cannot change a target that is in the pictures"):
        CONFIG.validate(env)


@pytest.mark.slow
@pytest.mark.parametrize(("hidden", "method"), [(False, "her"), (False, "hgail"), (True, "her")])
def test_what_only_the_picture_tells_is_learnt_from_it_without_a_teacher(hidden, method):
    learner = AsymmetricTD3(rollouts=2, updates=100, batch=128, buffer_episodes=512, channels=(4, 8, 8, 8))
    config = Config(
        learner,
        num_envs=32,
        rounds=8 if method == "hgail" else 6,
        discriminator_minibatches=16 if method == "hgail" else 0,
        discriminator_batch=128,
        policy_hidden=(32, 32),
        discriminator_hidden=(32, 32),
        layer_norm=True,
    )
    hyper = TD3Hyperparameters(
        p_ht=0.8,
        exploration_noise=0.2,
        epsilon=0.2,
        target_noise=0.1,
        tau=0.02,
        policy_learning_rate=2e-3,
        bc_weight=0.0,
        environment_reward=float(method == "her"),
        discount=0.9,
        discriminator_horizon=1,
        shuffled_goals=0.95,
        goal_jitter=0.5,
        negative_p_ht=0.8,
    )
    env = puck(hidden)
    state = jax.jit(functools.partial(init_state, env, config, hyper))(jax.random.key(0))
    step = jax.jit(functools.partial(train_step, env, config))
    for phases in phase_table(config):
        state, metrics = step(state, phases)
    success, distance = metrics.evaluation.success, metrics.evaluation.distance_l2
    print(f"\n{method}, the puck {'hidden' if hidden else 'shown'}: success {success:.2f}, distance {distance:.2f} m")
    assert (success > 0.8) != hidden
    assert (distance > 0.4) == hidden
