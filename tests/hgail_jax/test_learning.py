"""Every method learns a task whose answer is known: go straight to the goal."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs.base import GoalEnv
from hgail_jax import METHODS, PRESETS, init_state, phase_table, rollout, train_step
from hgail_jax.train import make_policy


class Short(GoalEnv):
    """A point in the plane that reaches any goal in at most seven of its ten steps."""

    episode_length, feature_size, goal_size, action_size, success_threshold = 10, 2, 2, 2, 0.1

    def reset_physics(self, rng):
        return jnp.zeros(2)

    def step_physics(self, physics, action):
        return physics + 0.15 * action

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return physics

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (2,), minval=-0.3, maxval=0.3)


class Fixed(Short):
    """Its goal is always the same, and no state is near enough to be rewarded."""

    success_threshold = 0.0

    def sample_goal(self, rng, physics):
        return jnp.array([0.3, -0.3])


SIZES = {
    "num_envs": 64,
    "pretrain_policy_minibatches": 200,
    "pretrain_policy_batch": 128,
    "pretrain_discriminator_minibatches": 50,
    "discriminator_minibatches": 20,
    "discriminator_batch": 128,
    "best_episodes": 64,
    "policy_hidden": (32,),
    "discriminator_hidden": (32,),
}


def learn(method, env, rounds, bc_batch=0, **changes):
    """Trains by a method; returns its mean action's episodes and the metrics of its rounds."""
    preset = METHODS[method].apply(PRESETS["parallel"])
    config = preset.config.replace(rounds=rounds, bc_batch=bc_batch, **SIZES)
    hyper = preset.hyperparameters.replace(policy_learning_rate=3e-3, **changes)

    run = compiled_run(type(env), config)
    return jax.tree.map(np.asarray, run(jax.random.key(0), jax.tree.map(jnp.asarray, hyper)))


@functools.cache
def compiled_run(task, config):
    env = task()

    @jax.jit
    def run(rng, hyper):
        state = init_state(env, config, hyper, rng)
        state, metrics = jax.lax.scan(functools.partial(train_step, env, config), state, phase_table(config))
        policy = make_policy(env, config, state, noise=0.0)
        return rollout(env, policy, jax.random.key(100), 256), metrics

    return run


@pytest.mark.parametrize(
    ("method", "rounds", "bc_batch"),
    [*(pytest.param(*row, marks=pytest.mark.slow) for row in [("ppo", 20, 0), ("gcsl", 5, 64)]), ("hgail", 8, 64)],
    ids=["ppo", "gcsl", "hgail"],
)
def test_a_method_learns_to_go_straight_to_any_goal(method, rounds, bc_batch):
    episodes, metrics = learn(method, Short(), rounds, bc_batch)
    assert episodes.outcome.success.mean() > 0.9
    assert (np.sum(episodes.action[0] * episodes.desired[0], axis=-1) > 0).mean() > 0.98
    assert metrics.evaluation.success[-1] > 0.9
    assert metrics.dropped.max() == 0.0
    if method == "ppo":
        assert metrics.evaluation.success[0] < 0.3
        assert (np.diff(metrics.evaluation.success[[1, 3, -1]]) >= 0).all()
    else:  # pre-training or cloning beside PPO has raised the probability of the actions that led to a goal
        assert metrics.update["bc_loss"][0] < 0.5


def test_hindsight_is_what_teaches():
    """HGAIL without hindsight, and with all else that it has, does not improve."""
    episodes, metrics = learn("hgail-no", Short(), 8, 64)
    assert METHODS["hgail-no"].apply(PRESETS["parallel"]).config == METHODS["hgail"].apply(PRESETS["parallel"]).config
    assert episodes.outcome.success.mean() < 0.2
    assert metrics.evaluation.success.max() < 0.4


@pytest.mark.slow
def test_of_equally_bad_episodes_gasil_imitates_those_that_end_nearest():
    """It is rewarded for nothing, so that its best episodes are as good as any but for their distance."""
    episodes, metrics = learn("gasil", Fixed(), 20, ties_by_distance=True)
    np.testing.assert_array_equal(metrics.evaluation.success, 0.0)
    assert metrics.evaluation.distance_l2[0] > 0.35
    assert episodes.outcome.distance_l2.max() < 0.25
