"""A small task with states, samples and a roll-out of it, and networks, densities and Adam in plain NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.base import EpisodeMetrics, GoalEnv
from hgail_jax import (
    PPO,
    Config,
    Hyperparameters,
    Trajectory,
    init_state,
    make_policy,
)
from hgail_jax.experts import init_expert
from hgail_jax.samples import Samples

LENGTH, EPISODES = 5, 8


class Plane(GoalEnv):
    """A point in the plane that breaks down far right."""

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 2, 2, 2, 0.5

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (2,))

    def step_physics(self, physics, action):
        following = physics + action
        return jnp.where(following[0] > 3.0, jnp.nan, following)

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return physics

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (2,), minval=-2.0, maxval=2.0)


class Track(Plane):
    """It also overflows far up; goals are left, to learn from right."""

    def sample_goal(self, rng, physics):
        return jnp.array([-9.0, 0.0])

    def plan_goals(self, rng, physics, training_goals):
        return jnp.where(training_goals, jnp.array([9.0, 0.0]), self.sample_goal(rng, physics))

    def overflow(self, physics):
        return physics[1] > 2.0


ENV = Track()


CONFIG = Config(
    num_envs=EPISODES,
    rounds=2,
    learner=PPO(
        policy_phases=2,
        discriminator_phases=1,
        epochs=2,
        minibatches=3,
        bc_batch=6,
        pretrain_policy_minibatches=4,
        pretrain_policy_batch=5,
        pretrain_discriminator_minibatches=2,
    ),
    discriminator_minibatches=3,
    discriminator_batch=7,
    policy_hidden=(6, 5),
    discriminator_hidden=(7,),
)


HYPER = Hyperparameters(
    exploration_noise=jnp.array([0.3, 0.6]), policy_learning_rate=1e-2, discriminator_learning_rate=1e-2
)


DEMONSTRATION = Samples(
    jnp.array([[0.3, -0.4, 2.0, 0.7]] * 3), jnp.array([[0.5, -1.7]] * 3), jnp.array([0.0, 2.0, 1.0])
)


SHOWN = jax.device_get(DEMONSTRATION)


init = jax.jit(functools.partial(init_state, ENV), static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def act(config, state, noise, observation, rng):
    return make_policy(ENV, config, state, noise)(observation, rng)


def make_state(config=CONFIG, seed=0, demonstrations=None, **changes):
    """A state with statistics of its own, whose networks have all their weights."""
    state = init(CONFIG, HYPER, jax.random.key(seed))  # which differs for no other config of these sizes
    state = state.replace(
        hyperparameters=HYPER.replace(**changes).as_arrays(), expert=init_expert(ENV, config, demonstrations)
    )
    rng = np.random.default_rng(seed)
    statistics = state.statistics.replace(mean=jnp.array([0.5, 0.1, -0.3, 0.2]), std=jnp.array([0.7, 1.2, 5.0, 0.9]))
    vary = functools.partial(
        jax.tree.map, lambda leaf: np.asarray(leaf) + 0.3 * rng.normal(size=leaf.shape).astype(np.float32)
    )
    learner = state.learner.replace(actor_critic=vary(state.learner.actor_critic))
    return state.replace(statistics=statistics, learner=learner, discriminator=vary(state.discriminator))


def mlp(params, inputs, xp=np):
    layers = params["params"]
    for index in range(len(layers)):
        layer = layers[f"Dense_{index}"]
        inputs = inputs @ layer["kernel"] + layer["bias"]
        inputs = xp.tanh(inputs) if index < len(layers) - 1 else inputs
    return inputs


def normalized(state, observation):
    mean, std = np.asarray(state.statistics.mean), np.asarray(state.statistics.std)
    return np.clip((np.asarray(observation) - mean) / std, -5, 5)


def log_density(action, mean, std, xp=np):
    return (-0.5 * ((action - mean) / std) ** 2 - xp.log(std) - 0.5 * np.log(2 * np.pi)).sum(axis=-1)


def logits(state, observation, action, params=None, xp=np):
    inputs = xp.concatenate([normalized(state, observation), xp.clip(action, -1, 1)], axis=-1)
    return mlp(state.discriminator if params is None else params, inputs, xp)[..., 0]


def adam(params, gradient_of, rate, steps, share=lambda step: 1.0):
    """Adam as in the paper (Kingma & Ba 2015); returns the parameters and the mean of the losses."""
    first, second = (jax.tree.map(np.zeros_like, params) for _ in range(2))
    losses, value_and_gradient = [], jax.jit(jax.value_and_grad(gradient_of))
    for step in range(steps):
        loss, gradient = jax.device_get(value_and_gradient(params))
        losses.append(loss)
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
        second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, second, gradient)
        scale, root = rate * share(step) / (1 - 0.9 ** (step + 1)), np.sqrt(1 - 0.999 ** (step + 1))
        params = jax.tree.map(
            lambda p, m, v, a=scale, b=root: p - a * m / (np.sqrt(v) / b + 1e-8), params, first, second
        )
    jax.effects_barrier()  # what the loss notes by a callback is all there
    return params, np.mean(losses)


def assert_close(one, other, rtol=1e-3, atol=2e-5):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=rtol, atol=atol), one, other)


def a_trajectory(valid=None):
    rng = np.random.default_rng(1)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    return Trajectory(
        features=3.0 * normal(LENGTH + 1, EPISODES, 2),
        achieved=normal(LENGTH + 1, EPISODES, 2),
        desired=normal(LENGTH + 1, EPISODES, 2),
        action=normal(LENGTH, EPISODES, 2),
        noted=normal(LENGTH, EPISODES) - 2.0,
        reward=jnp.asarray(rng.integers(-1, 1, (LENGTH, EPISODES)), jnp.float32),
        valid=jnp.ones(EPISODES, bool) if valid is None else jnp.asarray(valid),
        overflow=jnp.zeros(EPISODES, bool),
        outcome=EpisodeMetrics(),
    )


VALID = np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
