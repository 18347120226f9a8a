"""What the methods come to on a task that each should solve, or should not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs.point import Point
from hgail_jax import METHODS, PPO, Config, Hyperparameters, Preset, phase_table
from hgail_jax.config import REWARDS, STRATEGIES
from hgail_jax.defaults import FEW_UPDATES
from hgail_jax.play.recording import record
from hgail_jax.seeds import compile_train_step, init_seeds, init_sweep, seed_keys, split_sweep

SEEDS = 2
SMALL = Config(
    num_envs=128,
    learner=PPO(pretrain_policy_minibatches=100, pretrain_policy_batch=256, pretrain_discriminator_minibatches=100),
    discriminator_batch=256,
    best_episodes=100,
    policy_hidden=(32, 32),
    discriminator_hidden=(64, 64),
)
HYPER = Hyperparameters(policy_learning_rate=1e-3, discriminator_learning_rate=5e-4)


class Line(Point):
    """A point on a line: who stands still, or walks at random, is at its goal in one episode of five."""

    episode_length = 20
    feature_size = goal_size = action_size = 1
    controllers = {"straight": lambda seen: jnp.clip(20.0 * (seen[..., 1:] - seen[..., :1]), -1.0, 1.0)}  # noqa: RUF012

    def reset_physics(self, rng):
        return jnp.zeros(1)

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (1,), minval=-0.3, maxval=0.3)


def train(config, states):
    """Returns the success rates after each round, `[rounds + 1, settings * seeds]`, and the states."""
    step = compile_train_step(Line(), config, states, phase_table(config)[0])
    success = []
    for row in phase_table(config):
        states, metrics = step(states, row)
        success.append(np.asarray(metrics.evaluation.success))
    return np.array(success), states


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if "ppo" in method.learners])
def test_options_without_effect_are_those_that_leave_the_policy_as_it_is(method):
    changes = {
        "p_ht": {"p_ht": 0.4},
        "strategy": {"strategy": STRATEGIES["final"]},
        "reward": {"reward": REWARDS["r3"]},
        "standardize_reward": {"standardize_reward": False},
        "bc_weight": {"bc_weight": 2.0},
        "environment_reward": {"environment_reward": 0.5},
    }
    small = SMALL.replace(num_envs=8, rounds=1, bc_batch=32, **FEW_UPDATES)
    preset = METHODS[method].apply(Preset(small, HYPER))
    settings = [preset.hyperparameters.replace(**change) for change in ({}, *changes.values())]
    demonstrations = record(Line(), "line", 4).samples(Line()) if method == "gail-demo" else None
    _, states = train(preset.config, init_sweep(Line(), preset.config, settings, seed_keys(0, 1), demonstrations))
    policies = np.concatenate(
        [np.reshape(leaf, (len(settings), -1)) for leaf in jax.tree.leaves(states.learner.actor_critic["policy"])],
        axis=1,
    )
    unchanged = {name for name, policy in zip(changes, policies[1:], strict=True) if (policy == policies[0]).all()}
    if method == "hgail-no":  # which --p-ht changes, and then --strategy too
        unchanged.remove("strategy")
    without = dataclasses.replace(preset, config=small.replace(pretrain=False))
    if METHODS[method].apply(without).config == preset.config:
        unchanged.add("pretrain")
    assert unchanged == set(METHODS[method].without_effect)


@pytest.mark.slow
def test_hindsight_is_what_teaches_from_scratch():
    """HGAIL and HGAIL without hindsight, from scratch, in one program: they differ in a probability alone."""
    presets = [METHODS[name].apply(Preset(SMALL, HYPER)) for name in ("hgail", "hgail-no")]
    assert presets[0].config == presets[1].config
    config = SMALL.replace(pretrain=False, rounds=8)
    settings = [preset.hyperparameters for preset in presets]
    success, _ = train(config, init_sweep(Line(), config, settings, seed_keys(0, SEEDS)))
    with_it, without = split_sweep(success.T, 2)[:, :, -1]
    assert success[0].max() <= 0.3
    assert with_it.min() >= 0.9
    assert without.max() <= 0.4


@pytest.mark.slow
def test_adversarial_imitation_keeps_what_demonstrations_taught():
    """GAIL from 20 demonstrations: success is 1 after the pre-training, and it stays there."""
    preset = METHODS["gail-demo"].apply(Preset(SMALL, HYPER))
    config = preset.config.replace(bc_batch=0, rounds=3)
    samples = record(Line(), "line", 20).samples(Line())
    success, states = train(config, init_seeds(Line(), config, preset.hyperparameters, seed_keys(0, SEEDS), samples))
    assert success[0].min() >= 0.95
    assert success.mean() >= 0.9
    for seed in range(SEEDS):  # who demonstrates does not change
        jax.tree.map(lambda kept, given, i=seed: np.testing.assert_array_equal(kept[i], given), states.expert, samples)


@pytest.mark.slow
def test_the_best_episodes_so_far_teach():
    """Not every seed finds good ones in so few rounds: 16 of them together do."""
    preset = METHODS["gasil"].apply(Preset(SMALL.replace(num_envs=64), HYPER))
    config = preset.config.replace(rounds=8)
    success, states = train(config, init_seeds(Line(), config, preset.hyperparameters, seed_keys(0, 16)))
    assert success[0].mean() <= 0.25
    assert success[-3:].mean() >= success[0].mean() + 0.1
    # No policy succeeds in more than 20 steps, nor, as it starts, in more than the 14 after the first strides.
    assert (np.asarray(states.expert.returns) >= -10).all()
