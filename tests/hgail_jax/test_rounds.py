"""Rounds of training by PPO on a small task: which phase learns from what, and what a round measures."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax import PPO, env_steps, make_policy, phase_table, rollout
from hgail_jax.evaluate import mean_outcome
from hgail_jax.learner import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.state import split_key
from hgail_jax.train import train_step
from tests.hgail_jax.learners.track import (
    CONFIG,
    ENV,
    EPISODES,
    HYPER,
    LENGTH,
    assert_close,
    make_state,
    mlp,
)

one_round = jax.jit(functools.partial(train_step, ENV, CONFIG))


def run(state, *phases):
    return one_round(state, np.array([*phases, *[SKIP] * (5 - len(phases))]))


def test_a_round_keeps_the_shapes_of_the_state():
    state = make_state()
    after, _ = run(state, POLICY)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)


def same_key(one, other):
    return np.array_equal(jax.random.key_data(one), jax.random.key_data(other))


def mean_policy(state):
    def policy(observation, rng):
        del rng
        action = mlp(
            state.learner.actor_critic["policy"],
            jnp.clip((observation - state.statistics.mean) / state.statistics.std, -5, 5),
            jnp,
        )
        return action, jnp.zeros(len(observation))

    return policy


def broad(state, **changes):
    """With so wide a policy that its noise alone decides, and breaks some episodes down."""
    hyper = jax.tree.map(jnp.asarray, HYPER.replace(exploration_noise=jnp.array([0.8, 50.0]), **changes))
    return state.replace(hyperparameters=hyper)


def test_an_evaluation_is_the_mean_action_s_roll_out_with_a_key_of_its_own():
    state = broad(make_state())
    after, metrics = run(state, EVALUATE)
    rng = jax.random.split(split_key(state.rng).evaluation)[0]
    episodes = jax.jit(lambda state: rollout(ENV, mean_policy(state), rng, EPISODES))(state)
    assert_close(metrics.evaluation, mean_outcome(episodes))
    assert float(metrics.evaluation.distance_l1) > 0
    assert all(np.isinf(leaf) for leaf in jax.tree.leaves((metrics.training, metrics.update, metrics.diverged)))
    assert metrics.dropped == 1 - np.mean(episodes.valid)
    assert same_key(after.rng, state.rng)
    assert_close(after.replace(rng=None), state.replace(rng=None), rtol=0, atol=0)


UPDATES = CONFIG.learner.phase_updates()


OF_DISCRIMINATOR = {"discriminator_loss", "discriminator_accuracy"}


MEASURED = {
    PRETRAIN: {"bc_loss"} | OF_DISCRIMINATOR,
    POLICY: {"bc_loss", "reward", "policy_loss", "value_loss", "clip_fraction", "kl"},
    DISCRIMINATOR: OF_DISCRIMINATOR,
}


@jax.jit
def noisy(state, rng):
    """Returns a roll-out to learn from."""
    return rollout(ENV, make_policy(ENV, CONFIG, state, noise=1.0), rng, EPISODES, training_goals=True)


@pytest.mark.parametrize("phase", UPDATES, ids=lambda phase: phase.name)
def test_a_phase_learns_from_a_noisy_roll_out_to_the_training_goals(phase):
    state = broad(make_state())
    after, metrics = run(state, phase)
    keys = split_key(state.rng)
    rollout_rng, update_rng = jax.random.split(keys.phase)

    episodes = noisy(state, rollout_rng)
    learnt, update = jax.jit(UPDATES[phase], static_argnums=(0, 1))(ENV, CONFIG, state, episodes, update_rng)
    assert 0 < episodes.valid.sum() < EPISODES
    assert 0 < episodes.overflow.sum() < EPISODES
    assert_close(metrics.training, mean_outcome(episodes))
    assert_close(after.replace(rng=None), learnt.replace(rng=None))
    assert same_key(after.rng, keys.following)
    assert set(update) == MEASURED[phase]
    assert set(metrics.update) == set(PPO.metrics)
    for name, value in metrics.update.items():
        assert_close(value, update.get(name, np.inf))
    assert all(np.isinf(leaf) for leaf in jax.tree.leaves(metrics.evaluation))
    np.testing.assert_allclose(
        (metrics.dropped, metrics.overflow), (1 - episodes.valid.mean(), episodes.overflow.mean())
    )
    assert metrics.diverged == 0.0


def test_a_round_means_over_the_phases_that_measured():
    state, parts = make_state(), []
    row = (POLICY, SKIP, DISCRIMINATOR, POLICY, EVALUATE)
    together, metrics = one_round(state, np.array(row))
    for phase in row:
        state, measured = run(state, phase)
        parts.append(jax.tree.map(float, measured))
    assert_close(together.replace(rng=None), state.replace(rng=None))
    assert same_key(together.rng, state.rng)
    for leaf, *each in zip(*map(jax.tree.leaves, (metrics, *parts)), strict=True):
        finite = [value for value in each if np.isfinite(value)]
        np.testing.assert_allclose(leaf, np.mean(finite) if finite else np.inf, rtol=1e-4)


def test_nothing_is_learnt_where_every_episode_breaks_down():
    state, _ = run(make_state(), POLICY)
    bias = {"Dense_2": {"kernel": jnp.zeros((5, 2)), "bias": jnp.array([5.0, 0.0])}}
    params = state.learner.actor_critic["policy"]["params"] | bias
    actor_critic = state.learner.actor_critic | {"policy": {"params": params}}
    state = state.replace(learner=state.learner.replace(actor_critic=actor_critic))
    after, metrics = run(state, POLICY, DISCRIMINATOR, PRETRAIN, EVALUATE)
    assert_close(after.replace(rng=None), state.replace(rng=None), rtol=0, atol=0)
    assert (metrics.dropped, metrics.diverged) == (1.0, 0.0)
    for episodes in (metrics.training, metrics.evaluation):
        assert episodes.success == 0.0
        assert np.isinf([episodes.distance_l1, episodes.distance_l2]).all()
    key = state.rng
    for _ in range(3):
        key = split_key(key).following
    assert same_key(after.rng, key)


def test_without_training_goals_no_roll_out_goes_for_them(monkeypatch):
    asked, axes = [], []

    def watched(env, policy, rng, num_envs, training_goals, *, axis, **options):
        asked.append(training_goals)
        axes.append(axis)
        return rollout(env, policy, rng, num_envs, training_goals, axis=axis, **options)

    class Watched(PPO):
        def policy(self, env, config, state, noise, axis):
            axes.append(axis)
            return super().policy(env, config, state, noise, axis)

    monkeypatch.setattr("hgail_jax.train.rollout", watched)
    config = CONFIG.replace(learner=Watched(**vars(CONFIG.learner)), training_goals=False)
    step = functools.partial(train_step, ENV, config, axis="devices")
    on_two = jax.vmap(step, in_axes=(None, None), axis_name="devices", axis_size=2)
    jax.eval_shape(on_two, make_state(), phase_table(config)[0])
    assert asked
    assert all(training_goals is False for training_goals in asked)
    assert set(axes) == {"devices"}  # what says along which axis the environments are split reaches both


def test_environments_split_over_devices_give_the_roll_out_of_one():
    state = broad(make_state())

    def roll_out(state, axis):
        return rollout(ENV, make_policy(ENV, CONFIG, state, 1.0, axis), jax.random.key(3), EPISODES, True, axis=axis)

    alone = jax.jit(lambda state: roll_out(state, None))(state)
    split = jax.vmap(lambda state: roll_out(state, "devices"), in_axes=None, axis_name="devices", axis_size=2)
    for device in range(2):
        assert_close(jax.tree.map(lambda leaf, n=device: leaf[n], jax.jit(split)(state)), alone)


def test_the_phases_of_a_run():
    expected = [[PRETRAIN, SKIP, SKIP, SKIP, EVALUATE]] + 2 * [[SKIP, POLICY, POLICY, DISCRIMINATOR, EVALUATE]]
    np.testing.assert_array_equal(phase_table(CONFIG), expected)
    np.testing.assert_array_equal(env_steps(ENV, CONFIG, phase_table(CONFIG)), np.array([1, 3, 3]) * EPISODES * LENGTH)
    assert env_steps(ENV, CONFIG, phase_table(CONFIG)[1]) == 3 * EPISODES * LENGTH
    without = phase_table(CONFIG.replace(pretrain=False, rounds=0, discriminator_phases=0))
    np.testing.assert_array_equal(without, [[SKIP, SKIP, SKIP, EVALUATE]])


def test_the_last_step_of_a_run_is_the_last_of_the_learning_rate_s_schedule():
    state = make_state()
    for row in phase_table(CONFIG):
        state, _ = one_round(state, row)
    counts = {int(leaf) for leaf in jax.tree.leaves(state.learner.optimizer) if leaf.dtype == jnp.int32}
    assert counts == {4 + 2 * 2 * 2 * 3}
