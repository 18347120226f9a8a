"""What a phase learns and measures, against plain NumPy and a plain Adam."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, norm

from hgail_jax import (
    PPO,
    Config,
    init_state,
)
from hgail_jax.config import DEMONSTRATIONS, FROZEN, REWARDS
from hgail_jax.descent import shuffled_minibatches
from hgail_jax.discriminator import (
    _network,
    fit_discriminator,
)
from hgail_jax.learners.ppo import (
    _expert_samples,
    _policy_network,
    _ppo_batch,
    _value_network,
)
from hgail_jax.learners.ppo_loss import generalized_advantages, policy_loss, standardize, weighted_mean
from hgail_jax.networks import MLP, gaussian_log_prob
from hgail_jax.samples import Samples, policy_samples
from hgail_jax.state import split_key
from tests.hgail_jax.learners.track import (
    CONFIG,
    DEMONSTRATION,
    ENV,
    EPISODES,
    HYPER,
    LENGTH,
    SHOWN,
    VALID,
    a_trajectory,
    act,
    adam,
    assert_close,
    init,
    log_density,
    logits,
    make_state,
    mlp,
    normalized,
)

RNG = np.random.default_rng(0)


# Networks and the policy


def test_networks_are_tanh_layers_of_the_sizes_asked_for():
    for network, widths in (
        (_policy_network(CONFIG, 3), [4, 6, 5, 3]),
        (_value_network(CONFIG), [4, 6, 5, 1]),
        (_network(CONFIG), [4, 7, 1]),
    ):
        inputs = RNG.normal(size=(9, 4)).astype(np.float32)
        params = jax.jit(network.init)(jax.random.key(0), inputs[0])
        shapes = [params["params"][f"Dense_{index}"]["kernel"].shape for index in range(len(widths) - 1)]
        assert shapes == list(itertools.pairwise(widths))
        np.testing.assert_allclose(jax.jit(network.apply)(params, inputs), mlp(params, inputs), rtol=1e-4, atol=1e-5)


def test_the_first_policy_hardly_moves_and_the_first_value_does():
    for network, scale in ((MLP((), 200), 1.0), (_policy_network(Config(PPO(), policy_hidden=()), 200), 1e-4)):
        kernel = jax.jit(network.init)(jax.random.key(0), jnp.zeros(100))["params"]["Dense_0"]["kernel"]
        assert np.std(kernel) == pytest.approx(np.sqrt(scale / 100), rel=0.05)
        assert np.abs(kernel).max() < 2.6 * np.sqrt(scale / 100)


def test_the_log_density_is_the_normal_one():
    action, mean = RNG.normal(size=(2, 9, 3, 2)).astype(np.float32)
    for std in (0.3, np.array([0.2, 1.5])):
        expected = norm.logpdf(action, mean, std).sum(axis=-1)
        np.testing.assert_allclose(gaussian_log_prob(action, mean, std), expected, rtol=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_the_policy_acts_about_its_mean_by_its_own_deviations(noise):
    state = make_state()
    observation = RNG.normal(size=(2000, 4)).astype(np.float32)
    action, log_prob = act(CONFIG, state, noise, observation, jax.random.key(0))
    mean = mlp(state.learner.actor_critic["policy"], normalized(state, observation))
    np.testing.assert_allclose(log_prob, log_density(action, mean, np.array([0.3, 0.6])), rtol=1e-3, atol=1e-3)
    away = (np.asarray(action) - mean) / np.array([0.3, 0.6])
    if noise == 0.0:
        np.testing.assert_allclose(away, 0.0, atol=1e-4)
        return
    for axis in range(2):
        assert kstest(away[:, axis] / noise, norm.cdf).pvalue > 1e-4
    assert abs(np.corrcoef(away.T)[0, 1]) < 0.08


def test_observations_are_standardised_and_clipped_at_5():
    state = make_state()
    far = np.asarray(state.statistics.mean) + np.asarray(state.statistics.std) * np.float32([[4.9, -4.9, 6.0, -6.0]])
    np.testing.assert_allclose(state.normalize(far), [[4.9, -4.9, 5.0, -5.0]], rtol=1e-5)


def test_observations_are_standardised_by_their_statistics():
    state = init(CONFIG, HYPER, jax.random.key(0))
    seen = (RNG.normal(size=(2000, 4)) * [1.0, 2.0, 0.5, 1.5] + [0.5, 0.0, -1.0, 2.0]).astype(np.float32)
    state = state.count(Samples(seen, None, np.ones(len(seen), np.float32)))
    expected = (seen - seen.mean(axis=0)) / seen.std(axis=0)
    np.testing.assert_allclose(state.normalize(seen), np.clip(expected, -5, 5), atol=1e-3)
    assert int(state.statistics.count) == 2000


# The training state


def test_networks_start_apart_and_the_state_holds_what_it_is_given():
    state = init(CONFIG, HYPER, jax.random.key(0))
    first = [state.learner.actor_critic[name]["params"]["Dense_0"]["kernel"] for name in ("policy", "value")]
    assert np.abs(first[0] - first[1]).min() > 0
    assert state.discriminator["params"]["Dense_0"]["kernel"].shape == (6, 7)
    wide = CONFIG.replace(discriminator_hidden=(6,), policy_hidden=(6,))
    wide = init(wide, HYPER, jax.random.key(0))
    drawn = [
        tree["params"]["Dense_0"]["kernel"][0] for tree in (*wide.learner.actor_critic.values(), wide.discriminator)
    ]
    assert len(np.unique(np.sign(np.stack(drawn)), axis=0)) == 3
    np.testing.assert_array_equal(state.statistics.mean, np.zeros(4))
    np.testing.assert_array_equal(state.statistics.std, np.ones(4))
    assert state.expert is None
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state.hyperparameters))
    assert state.hyperparameters.policy_learning_rate == pytest.approx(1e-2)
    assert not np.array_equal(jax.random.key_data(state.rng), jax.random.key_data(jax.random.key(0)))
    given = init(CONFIG.replace(expert_source=DEMONSTRATIONS), HYPER, jax.random.key(0), DEMONSTRATION)
    assert_close(given.expert, DEMONSTRATION)
    with pytest.raises(ValueError, match=r"exploration_noise is .* it must be one number or 2"):
        init_state(ENV, CONFIG, HYPER.replace(exploration_noise=(0.1, 0.2, 0.3)), jax.random.key(0))


def test_keys_of_a_state_are_all_different():
    keys = split_key(jax.random.key(7))
    data = {
        tuple(jax.random.key_data(key).tolist()) for key in (*keys, jax.random.key(7), *jax.random.split(keys.phase))
    }
    assert len(data) == len(keys) + 3 == 7


@pytest.mark.parametrize("pretraining", [False, True])
@pytest.mark.parametrize("final", [0.0, 0.25, 1.0])
def test_steps_shrink_over_the_rounds_to_their_final_length(final, pretraining):
    """Adam's steps along a gradient that stays are all as long as the learning rate."""
    config = CONFIG.replace(final_learning_rate=final, pretrain=pretraining)
    optimizer, before, steps = config.learner.optimizer(config), 4 if pretraining else 0, 2 * 2 * 2 * 3
    state = optimizer.init(jnp.zeros(1))
    lengths = []
    for _ in range(before + steps + 3):
        update, state = optimizer.update(jnp.full(1, 0.7), state)
        lengths.append(float(update[0]))
    expected = np.interp(np.arange(len(lengths)), [before, before + steps], [1.0, final])
    np.testing.assert_allclose(lengths, expected, rtol=1e-3, atol=1e-6)


# PPO


def batch_by_hand(state, trajectory):
    hyper, weight = state.hyperparameters, np.broadcast_to(trajectory.valid, (LENGTH, EPISODES)).astype(float)
    seen = np.concatenate([trajectory.features, trajectory.desired], axis=-1)
    values = mlp(state.learner.actor_critic["value"], normalized(state, seen))[..., 0]
    logit = logits(state, seen[:-1], np.asarray(trajectory.action))
    forms = (np.logaddexp(0, logit), np.log(np.clip(logit, 1e-3, 1)), logit, logit)
    mixed = float(hyper.environment_reward)
    reward = (1 - mixed) * forms[int(hyper.reward)] + mixed * np.asarray(trajectory.reward)

    def standard(array):
        return (array - np.average(array, weights=weight)) / np.sqrt(
            np.average((array - np.average(array, weights=weight)) ** 2, weights=weight)
        )

    scaled = (standard(reward) if hyper.standardize_reward else reward) / LENGTH
    gamma, lam = float(hyper.discount), float(hyper.gae_lambda)
    advantage = np.zeros((LENGTH, EPISODES))
    for start in range(LENGTH):
        for step in range(start, LENGTH):
            delta = scaled[step] + gamma * values[step + 1] - values[step]
            advantage[start] += (gamma * lam) ** (step - start) * delta
    batch = {
        "observation": normalized(state, seen[:-1]),
        "action": trajectory.action,
        "log_prob": trajectory.noted,
        "advantage": standard(advantage),
        "return": advantage + values[:-1],
        "weight": weight,
    }
    flat = {name: np.asarray(leaf).reshape(LENGTH * EPISODES, *leaf.shape[2:]) for name, leaf in batch.items()}
    return flat, np.average(reward, weights=weight)


@jax.jit
def ppo_batch(state, trajectory):
    return _ppo_batch(ENV, CONFIG, state, trajectory)


@pytest.mark.parametrize("form", REWARDS.values(), ids=REWARDS)
@pytest.mark.parametrize("mixed", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("standard", [False, True])
def test_what_ppo_learns_from_is_as_by_hand(form, mixed, standard):
    valid = VALID if form == REWARDS["r1"] else np.ones(EPISODES, bool)
    state = make_state(
        reward=form,
        environment_reward=mixed,
        standardize_reward=standard,
        discount=0.9,
        gae_lambda=0.7,
    )
    state = state.replace(hyperparameters=jax.tree.map(jnp.asarray, state.hyperparameters))
    batch, given_reward = ppo_batch(state, a_trajectory(valid))
    expected, reward = batch_by_hand(state, a_trajectory(valid))
    weight = expected["weight"] > 0
    for name in ("observation", "action", "log_prob", "advantage", "return"):
        np.testing.assert_allclose(batch[name][weight], expected[name][weight], rtol=2e-3, atol=2e-4)
    np.testing.assert_array_equal(batch["weight"], expected["weight"])
    assert float(given_reward) == pytest.approx(reward, rel=1e-3, abs=1e-5)


REWARD = RNG.normal(size=(LENGTH, EPISODES)).astype(np.float32)
VALUE = RNG.normal(size=(LENGTH + 1, EPISODES)).astype(np.float32)


@pytest.mark.parametrize(("discount", "gae_lambda"), [(0.98, 0.95), (0.9, 0.0), (1.0, 1.0), (0.0, 0.5)])
def test_advantages_agree_with_a_double_sum(discount, gae_lambda):
    expected = np.zeros_like(REWARD)
    for t in range(LENGTH):
        for k in range(t, LENGTH):
            delta = REWARD[k] + discount * VALUE[k + 1] - VALUE[k]
            expected[t] += (discount * gae_lambda) ** (k - t) * delta
    np.testing.assert_allclose(
        generalized_advantages(REWARD, VALUE, discount, gae_lambda), expected, rtol=1e-4, atol=1e-5
    )


def test_the_time_limit_is_a_truncation():
    """With λ = 1 the return is the rewards plus the value of the state in which the episode was cut off."""
    returns = np.asarray(generalized_advantages(REWARD, VALUE, 0.9, 1.0)) + VALUE[:-1]
    expected = VALUE[-1]
    for reward in REWARD[::-1]:
        expected = reward + 0.9 * expected
    np.testing.assert_allclose(returns[0], expected, rtol=1e-4)
    of_a_terminal = np.asarray(generalized_advantages(REWARD, np.concatenate([VALUE[:-1], 0 * VALUE[:1]]), 0.9, 1.0))
    assert not np.allclose(returns[0], of_a_terminal[0] + VALUE[0])


def test_weighted_means_and_standardised_values_ignore_what_has_no_weight():
    values, weight = np.float32([1.0, 2.0, 5.0, 900.0]), np.float32([1.0, 1.0, 1.0, 0.0])
    assert weighted_mean(values, weight) == pytest.approx(8 / 3)
    assert weighted_mean(values, 0 * weight) == 0.0
    assert weighted_mean(values, np.float32([1, 0, 3, 0])) == pytest.approx(4.0)
    np.testing.assert_allclose(
        standardize(values, weight)[:3], (values[:3] - 8 / 3) / np.std(values[:3]), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_array_equal(standardize(np.full(3, 2.0), np.ones(3)), np.zeros(3))
    tiny = np.float32([0.0, 2e-6])
    np.testing.assert_allclose(standardize(tiny, np.ones(2)), [-1.0, 1.0], rtol=0.011)
    assert standardize(tiny, np.ones(2))[1] < 0.995


def test_the_policy_s_loss_by_hand():
    new, old, advantage = RNG.normal(size=(3, 50)).astype(np.float32)
    weight = RNG.integers(0, 2, 50).astype(np.float32)
    for clip in (0.1, 0.7):
        ratio = np.exp(new - old)
        clipped = np.where(ratio > 1 + clip, 1 + clip, np.where(ratio < 1 - clip, 1 - clip, ratio))
        loss, found = policy_loss(new, old, advantage, weight, clip)
        gain = np.minimum(ratio * advantage, clipped * advantage)
        assert loss == pytest.approx(-np.average(gain, weights=weight), rel=1e-4)
        outside = (ratio < 1 - clip) | (ratio > 1 + clip)
        assert found["clip_fraction"] == pytest.approx(np.average(outside, weights=weight), rel=1e-5)
        assert found["kl"] == pytest.approx(np.average(ratio - 1 - np.log(ratio), weights=weight), rel=1e-3)


def test_a_ratio_at_the_bound_is_not_outside():
    assert policy_loss(np.zeros(3), np.zeros(3), np.ones(3), np.ones(3), 0.0)[1]["clip_fraction"] == 0.0


def test_minibatches_pass_through_all_samples_in_a_new_order_each_time():
    found = np.asarray(shuffled_minibatches(jax.random.key(0), 12, 5, 3))
    assert found.shape == (15, 4)
    passes = found.reshape(5, 12)
    np.testing.assert_array_equal(np.sort(passes), np.broadcast_to(np.arange(12), (5, 12)))
    assert len(np.unique(passes, axis=0)) == 5
    assert not (passes == np.arange(12)).all(axis=1).any()
    rest = np.asarray(shuffled_minibatches(jax.random.key(0), 14, 40, 3))
    assert rest.shape == (120, 4)
    assert all(len(np.unique(order)) == 12 for order in rest.reshape(40, 12))
    np.testing.assert_array_equal(np.unique(rest), np.arange(14))
    assert not np.array_equal(shuffled_minibatches(jax.random.key(1), 12, 5, 3), found)


# Updates


def whole_batch(bc_batch):
    """One minibatch is all samples, whatever their order, and all that can be drawn of the demonstrations is alike."""
    return CONFIG.replace(
        epochs=3,
        minibatches=1,
        policy_phases=1,
        pretrain=False,
        final_learning_rate=0.4,
        bc_batch=bc_batch,
        expert_source=DEMONSTRATIONS,
    )


WITH_CLONING, WITHOUT = whole_batch(4), whole_batch(0)
update = jax.jit(lambda config, *rest: config.learner.update_policy(ENV, config, *rest), static_argnums=0)


@pytest.mark.parametrize("config", [WITH_CLONING, WITHOUT], ids=["with cloning", "without"])
@pytest.mark.parametrize(("of_ppo", "of_cloning"), [(1.0, 0.0), (0.0, 1.0), (0.7, 0.2)])
def test_a_policy_update_is_adam_on_the_sum_of_the_losses(config, of_ppo, of_cloning):
    std, given = np.array([0.3, 0.6]), a_trajectory(VALID)
    state = make_state(config, demonstrations=DEMONSTRATION, ppo_weight=of_ppo, bc_weight=of_cloning)
    seen = normalized(state, np.concatenate([given.features, given.desired], axis=-1)[:-1])
    given = given.replace(
        noted=jnp.asarray(log_density(given.action, mlp(state.learner.actor_critic["policy"], seen), std) + 0.05)
    )
    batch, reward = batch_by_hand(state, given)
    weight = batch["weight"] / batch["weight"].sum()
    parts = {}

    def loss(params):
        log_prob = log_density(batch["action"], mlp(params["policy"], batch["observation"], jnp), std)
        ratio = jnp.exp(log_prob - batch["log_prob"])
        gain = jnp.minimum(ratio * batch["advantage"], jnp.clip(ratio, 0.8, 1.2) * batch["advantage"])
        predicted = mlp(params["value"], batch["observation"], jnp)[:, 0]
        mean = mlp(params["policy"], normalized(state, SHOWN.observation[0]), jnp)
        cloning = -log_density(SHOWN.action[0], mean, std)
        of = {
            "policy_loss": -(weight * gain).sum(),
            "value_loss": 0.5 * (weight * (predicted - batch["return"]) ** 2).sum(),
            "bc_loss": cloning if config.learner.bc_batch else jnp.zeros(()),
            "clip_fraction": (weight * (jnp.abs(ratio - 1) > 0.2)).sum(),
            "kl": (weight * (ratio - 1 - jnp.log(ratio))).sum(),
        }
        jax.debug.callback(lambda of: [parts.setdefault(name, []).append(value) for name, value in of.items()], of)
        return of_ppo * of["policy_loss"] + of["value_loss"] + of_cloning * of["bc_loss"]

    expected, _ = adam(state.learner.actor_critic, loss, 1e-2, 3, lambda step: 1 - 0.6 * step / 6)
    after, metrics = update(config, state, given, jax.random.key(0))
    assert_close(after.learner.actor_critic, expected)
    if not config.learner.bc_batch:
        del parts["bc_loss"]
    assert set(metrics) == {"reward", *parts}
    assert float(metrics["reward"]) == pytest.approx(reward, rel=1e-3)
    for name, values in parts.items():
        np.testing.assert_allclose(metrics[name], np.mean(values), rtol=2e-3, atol=1e-4)
    assert_close((after.discriminator, after.expert), (state.discriminator, state.expert), rtol=0, atol=0)
    observation = np.concatenate([given.features, given.desired], axis=-1)[:-1, VALID].reshape(-1, 4)
    np.testing.assert_allclose(after.statistics.mean, observation.mean(axis=0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("pretraining", [False, True])
@pytest.mark.parametrize("final", [0.25, 1.0])
def test_deviations_shrink_over_the_rounds_and_stay_within_a_phase(final, pretraining):
    """A roll-out acts by the deviations that its update then takes its log-probabilities by."""
    config = WITH_CLONING.replace(epochs=1, pretrain=pretraining)
    state, given = make_state(config, demonstrations=DEMONSTRATION, final_exploration_noise=final), a_trajectory(VALID)
    before, rounds = 4 if pretraining else 0, 2  # gradient steps
    for steps in range(before + rounds + 2):
        std = np.array([0.3, 0.6]) * np.interp(steps, [before, before + rounds], [1.0, final])
        adam_state, schedule = state.learner.optimizer
        optimizer = (adam_state, schedule._replace(count=jnp.int32(steps)))
        late = state.replace(learner=state.learner.replace(optimizer=optimizer))
        seen = given.observation(ENV)[:-1]
        mean = mlp(state.learner.actor_critic["policy"], normalized(state, seen))
        action, log_prob = act(config, late, 1.0, seen[0], jax.random.key(steps))
        np.testing.assert_allclose(log_prob, log_density(action, mean[0], std), rtol=1e-3, atol=1e-3)
        acted = given.replace(noted=jnp.asarray(log_density(given.action, mean, std)))
        metrics = update(config, late, acted, jax.random.key(0))[1]
        assert abs(metrics["kl"]) < 1e-5
        shown = mlp(state.learner.actor_critic["policy"], normalized(state, SHOWN.observation[0]))
        cloning = log_density(SHOWN.action[0], shown, std)
        np.testing.assert_allclose(metrics["bc_loss"], -cloning, rtol=1e-3)


def still_trajectory():
    """Of the valid episodes all steps are alike; of the others none is."""
    given = a_trajectory(VALID)

    def still(leaf):
        return jnp.where(jnp.asarray(VALID)[None, :, None], leaf[0, 0], leaf)

    return given.replace(features=still(given.features), desired=still(given.desired), action=still(given.action))


def discriminator_by_hand(state, given, steps):
    given = jax.device_get(given)
    seen = np.concatenate([given.features, given.desired], axis=-1)[0, 0]
    accuracy = []

    def loss(params):
        expert = logits(state, SHOWN.observation[0], SHOWN.action[0], params, jnp)
        policy = logits(state, seen, given.action[0, 0], params, jnp)
        jax.debug.callback(lambda one, other: accuracy.append(0.5 * (one > 0) + 0.5 * (other <= 0)), expert, policy)
        return jnp.logaddexp(0.0, -expert) + jnp.logaddexp(0.0, policy)

    params, value = adam(state.discriminator, loss, 1e-2, steps)
    return params, value, np.mean(accuracy)


@jax.jit
def discriminate(state, given, rng):
    return WITHOUT.learner.update_discriminator(ENV, WITHOUT, state, given, rng)


def test_a_discriminator_update_is_adam_on_the_cross_entropy_and_leaves_the_policy_alone():
    state, given = make_state(WITHOUT, demonstrations=DEMONSTRATION), still_trajectory()
    after, metrics = discriminate(state, given, jax.random.key(0))
    expected, loss, accuracy = discriminator_by_hand(state, given, 3)
    assert_close(after.discriminator, expected)
    assert_close(metrics, {"discriminator_loss": loss, "discriminator_accuracy": accuracy})
    for name in ("learner", "statistics", "expert"):
        assert_close(getattr(after, name), getattr(state, name), rtol=0, atol=0)


@pytest.mark.parametrize("phase", ["fit_to_first", "update_discriminator"])
def test_the_discriminator_s_goals_are_jittered_and_shuffled_as_asked(phase, monkeypatch):
    """Of its samples alone: the policy is cloned from the exact goals."""
    given, found = a_trajectory(), []

    def fit(config, state, expert, policy, *rest):
        return state, {"goals": (expert.observation[:, 2:], policy.observation[:, 2:])}

    monkeypatch.setattr("hgail_jax.learners.ppo.fit_discriminator", fit)
    learn = jax.jit(functools.partial(getattr(CONFIG.learner, phase), ENV, CONFIG))
    for changes in ({}, {"goal_jitter": 0.5, "shuffled_goals": 1.0}):
        after, measured = learn(make_state(**changes), given, jax.random.key(0))
        found.append((*measured["goals"], after.learner.actor_critic["policy"]))
    (exact, pursued, cloned), (jittered, shuffled, also_cloned) = jax.device_get(found)
    half = 0.5 * np.asarray(ENV.goal_tolerance(exact))
    assert (np.abs(jittered - exact) <= half + 1e-5).all() and np.abs(jittered - exact).max() > 0.5 * half.max()
    desired = np.asarray(given.desired[:-1])
    np.testing.assert_array_equal(pursued, desired.reshape(-1, 2))
    np.testing.assert_array_equal(shuffled, np.roll(desired, EPISODES // 2, axis=1).reshape(-1, 2))
    assert_close(also_cloned, cloned, rtol=0, atol=0)


PRETRAINED = WITHOUT.replace(pretrain=True)


def test_pretraining_is_adam_on_the_cloning_and_on_the_cross_entropy():
    state, given = make_state(PRETRAINED, demonstrations=DEMONSTRATION), still_trajectory()
    # Small weights, for no saturated unit: Adam makes a whole step of a gradient that is rounding alone.
    state = state.replace(discriminator=jax.tree.map(lambda weights: 0.2 * weights, state.discriminator))
    after, metrics = jax.jit(functools.partial(PRETRAINED.learner.fit_to_first, ENV, PRETRAINED))(
        state, given, jax.random.key(0)
    )
    # A sample's weight says how often to draw it; the statistics count it once if it has any.
    np.testing.assert_allclose(after.statistics.mean, SHOWN.observation[0], rtol=1e-5)
    assert int(after.statistics.count.lo) == 2
    observed = state.replace(statistics=after.statistics)

    def loss(params):
        mean = mlp(params["policy"], normalized(observed, SHOWN.observation[0]), jnp)
        return -log_density(SHOWN.action[0], mean, np.array([0.3, 0.6]))

    expected, cloning = adam(state.learner.actor_critic, loss, 1e-2, 4)
    assert_close(after.learner.actor_critic["policy"], expected["policy"])
    assert_close(after.learner.actor_critic["value"], state.learner.actor_critic["value"], atol=0)
    params, value, accuracy = discriminator_by_hand(observed, given, 2)
    assert_close(after.discriminator, params)
    assert_close(metrics, {"bc_loss": cloning, "discriminator_loss": value, "discriminator_accuracy": accuracy})


def test_statistics_count_each_sample_once_and_none_of_a_broken_episode():
    given = a_trajectory(VALID)
    state = init(CONFIG, HYPER.replace(p_ht=0.0), jax.random.key(0))
    seen = np.concatenate([given.features, given.desired], axis=-1)[:-1]
    weights = RNG.integers(0, 4, (LENGTH, EPISODES)).astype(np.float32)
    config = CONFIG.replace(expert_source=DEMONSTRATIONS)
    expert = policy_samples(ENV, given).replace(weight=jnp.asarray(weights).reshape(-1))
    learn = jax.jit(functools.partial(config.learner.fit_to_first, ENV, config))
    after, _ = learn(state.replace(expert=expert), given, jax.random.key(0))
    for weight, statistics in ((weights, after.statistics),):
        counted = seen[weight > 0]
        np.testing.assert_allclose(statistics.mean, counted.mean(axis=0), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(statistics.std, counted.std(axis=0), rtol=1e-3)
        assert int(statistics.count.lo) == len(counted)


def test_expert_samples_that_are_kept_stay_in_the_state():
    config = CONFIG.replace(expert_source=FROZEN)
    state = make_state(config)
    keep = jax.jit(functools.partial(_expert_samples, ENV, config))
    after, samples = keep(state, a_trajectory(VALID), jax.random.key(0))
    assert_close(after.expert, samples, rtol=0, atol=0)
    assert float(samples.weight.sum()) > 0
    again, samples = keep(after, a_trajectory(), jax.random.key(1))
    assert_close((again.expert, samples), (after.expert, after.expert), rtol=0, atol=0)


def test_the_discriminator_learns_the_log_ratio_of_two_gaussians_in_what_the_environment_sees():
    """Expert actions are N(0.5, 0.3²), the policy's N(-0.5, 0.3²), clipped: inside the logit is x / 0.09."""
    config = CONFIG.replace(discriminator_hidden=(32,), discriminator_batch=256)
    state = init(config, HYPER, jax.random.key(0))

    def samples(mean):
        drawn = RNG.normal(mean, 0.3, (4000, 2)) * [1, 0]
        return Samples(jnp.zeros((4000, 4)), jnp.asarray(drawn, jnp.float32), jnp.ones(4000))

    fit = jax.jit(lambda state, rng: fit_discriminator(config, state, samples(0.5), samples(-0.5), 600, rng))
    after, metrics = fit(state, jax.random.key(1))
    inputs = np.zeros((7, 6))
    inputs[:, 4] = np.linspace(-0.45, 0.45, 7)
    np.testing.assert_allclose(mlp(after.discriminator, inputs)[:, 0], inputs[:, 4] / 0.09, atol=1.2)
    assert metrics["discriminator_loss"] < 0.6
    assert metrics["discriminator_accuracy"] > 0.9


@pytest.mark.parametrize(("own", "weight", "batch"), [(64, 0.5, 64), (0, 0.5, 512), (64, 0.0, 0), (0, 0.0, 0)])
def test_a_bc_weight_needs_samples_and_without_one_none_are_drawn(own, weight, batch):
    assert PPO(bc_batch=own).with_bc(weight).bc_batch == batch
