"""What the off-policy learner does with a roll-out, against plain formulas and a plain Adam."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, kstest, norm

from hgail_envs.base import EpisodeMetrics
from hgail_jax import (
    METHODS,
    TD3,
    Config,
    Preset,
    Trajectory,
    init_state,
    make_policy,
    phase_table,
    train_step,
)
from hgail_jax.buffer import add_episodes, draw
from hgail_jax.config import BEST, DEMONSTRATIONS, FROZEN
from hgail_jax.discriminator import fit_discriminator
from hgail_jax.experts import expert_samples, init_expert
from hgail_jax.learner import EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.learners.td3 import fill_buffer
from hgail_jax.samples import Samples, relabelled_samples
from hgail_jax.seeds import compile_train_step, init_sweep, seed_keys
from hgail_jax.settings.defaults import DEFAULTS
from hgail_jax.trainer import training
from tests.hgail_jax.learners import track
from tests.hgail_jax.learners.track import DEMONSTRATION, LENGTH, Plane, normalized
from tests.hgail_jax.line import assert_same as equal
from tests.hgail_jax.trainer.test_checkpoint import saved_in
from tests.hgail_jax.trainer.test_resume import crash, fail_in_round, outcome, start
from tests.support import compile_once, make_runs_tiny

EPISODES, HELD = 8, 12
UNLIKELY = 1e-5  # a p-value; keys are fixed, so that a test does not fail by chance now and then


ENV = Plane()
CONFIG = Config(
    num_envs=EPISODES,
    rounds=2,
    learner=TD3(
        rollouts=2,
        updates=2,
        batch=100,
        buffer_episodes=HELD,
        critics=3,
        final_learning_rate=0.2,
        final_discriminator_learning_rate=0.3,
        gradient_penalty=0.5,
    ),
    discriminator_minibatches=3,
    discriminator_batch=7,
    policy_hidden=(6, 5),
    discriminator_hidden=(7,),
    layer_norm=True,
)
HYPER = TD3.hyperparameters(
    p_ht=0.6,
    exploration_noise=jnp.array([0.3, 0.05]),
    discount=0.4,
    bc_weight=0.7,
    environment_reward=0.4,
    tau=0.3,
    target_noise=0.4,
    discriminator_horizon=2,
    goal_jitter=0.5,
    shuffled_goals=0.7,
    negative_p_ht=0.4,
    negative_weight=1.5,
    policy_learning_rate=1e-2,
    discriminator_learning_rate=1e-2,
)
init = jax.jit(functools.partial(init_state, ENV), static_argnums=0)
assert_close = functools.partial(track.assert_close, rtol=2e-4)
learn = jax.jit(CONFIG.learner.update, static_argnums=(0, 1))
round_of = jax.jit(train_step, static_argnums=(0, 1))
filled = jax.jit(functools.partial(fill_buffer, ENV))
add = jax.jit(add_episodes)
sampled = jax.jit(draw, static_argnums=(0, 4))
keep = jax.jit(expert_samples, static_argnums=(0, 1))
fit = jax.jit(fit_discriminator, static_argnums=(0, 4, 7))


def trajectory(seed=0, valid=None):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(LENGTH + 1, EPISODES, 2))
    leaves = Trajectory(
        features=features,
        achieved=features,
        desired=rng.normal(size=(LENGTH + 1, EPISODES, 2)),
        action=rng.normal(size=(LENGTH, EPISODES, 2)),
        noted=np.zeros((LENGTH, EPISODES)),
        reward=-rng.integers(0, 2, (LENGTH, EPISODES)).astype(float),
        valid=np.arange(EPISODES) % 3 != 1 if valid is None else valid,
        overflow=np.zeros(EPISODES, bool),
        outcome=EpisodeMetrics(distance_l1=rng.uniform(size=EPISODES)),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, None if np.asarray(leaf).dtype == bool else jnp.float32), leaves)


def spread(target):
    """Returns target networks whose critics have values beyond both bounds."""
    layers = {name: jax.tree.map(lambda leaf: 3.0 * leaf, layer) for name, layer in target.critics["params"].items()}
    layers["Dense_2"]["bias"] += 3.0
    return target._replace(critics={"params": layers})


def make_state(config=CONFIG, steps=3, demonstrations=None, **changes):
    """A state amid a run: online and target networks, optimisers and statistics all differ."""
    state = init(config, HYPER, jax.random.key(0), demonstrations=demonstrations)
    rng = np.random.default_rng(0)
    vary = functools.partial(
        jax.tree.map, lambda leaf: np.asarray(leaf) + 0.4 * rng.normal(size=leaf.shape).astype(np.float32)
    )
    learner = state.learner
    moments = [
        adam._replace(count=jnp.int32(4), mu=vary(adam.mu), nu=jax.tree.map(np.square, vary(adam.nu)))
        for adam in learner.optimizer
    ]
    learner = learner.replace(
        online=vary(learner.online),
        target=spread(vary(learner.target)),
        optimizer=type(learner.optimizer)(*moments),
        steps=jnp.int32(steps),
    )
    statistics = state.statistics.replace(mean=jnp.array([0.5, 0.1, -0.3, 0.2]), std=jnp.array([0.7, 1.2, 5.0, 0.9]))
    buffer = add(state.buffer, trajectory(1))
    state = state.replace(learner=learner, statistics=statistics, discriminator=vary(state.discriminator))
    return state.replace(buffer=buffer, hyperparameters=HYPER.replace(**changes).as_arrays())


def mlp(params, inputs, xp=np):
    layers = params["params"]
    for index in range(count := sum(name.startswith("Dense") for name in layers)):
        layer = layers[f"Dense_{index}"]
        inputs = inputs @ layer["kernel"] + layer["bias"]
        if index < count - 1:
            normal = layers[f"LayerNorm_{index}"]
            inputs = (inputs - inputs.mean(-1, keepdims=True)) / xp.sqrt(inputs.var(-1, keepdims=True) + 1e-6)
            inputs = xp.maximum(inputs * normal["scale"] + normal["bias"], 0)
    return inputs


# Filling the buffer


def test_filling_adds_the_episodes_and_counts_the_observations_of_sound_ones():
    given, state = trajectory(), init(CONFIG, HYPER, jax.random.key(0))
    after = filled(state, given)
    equal(after.buffer, add(state.buffer, given))
    seen = np.concatenate([given.features, given.desired], axis=-1)[:-1][:, np.asarray(given.valid)].reshape(-1, 4)
    assert_close(after.statistics.mean, seen.mean(axis=0))
    assert_close(after.statistics.std, seen.std(axis=0))
    equal(after.replace(buffer=None, statistics=None, rng=None), state.replace(buffer=None, statistics=None, rng=None))


# Learning


def values(critics, observation, action, xp=np):
    """Returns the values of each critic, `[critics, B]`."""
    inputs, count = xp.concatenate([observation, action], axis=-1), CONFIG.learner.critics
    each = [jax.tree.map(lambda leaf, i=index: leaf[i], critics) for index in range(count)]
    return xp.stack([mlp(critic, inputs, xp)[:, 0] for critic in each])


def adam(params, optimizer, gradient, rate):
    """Returns the parameters and Adam's new moments."""
    count, gradient = int(optimizer.count) + 1, jax.device_get(gradient)
    mu = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, optimizer.mu, gradient)
    nu = jax.tree.map(lambda old, new: 0.999 * old + 0.001 * new**2, optimizer.nu, gradient)
    moved = jax.tree.map(
        lambda old, m, v: old - rate * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8), params, mu, nu
    )
    return moved, optimizer._replace(count=jnp.int32(count), mu=mu, nu=nu)


@jax.jit
@jax.value_and_grad
def critic_loss(critics, seen, action, weight, target):
    return sum((weight * (value - target) ** 2).mean() for value in values(critics, seen, action, jnp))


@jax.jit
@jax.value_and_grad
def actor_loss(actor, critics, seen, action, weight, better, unmoved):
    before_tanh = mlp(actor, seen, jnp)
    chosen = jnp.tanh(before_tanh)
    gained = values(critics, seen, chosen, jnp).mean(axis=0)
    cloning = (weight * better * ((chosen - action) ** 2).sum(axis=-1)).mean()
    return -(weight * gained).mean() / jnp.abs(unmoved).mean() + 0.7 * cloning + 0.01 * (before_tanh**2).mean()


def gradient_step(hyper, learner, seen, action, following, reward, weight, noise):
    """Returns the learner after one step, its measurements, and what was cut off on the way."""
    sizes = CONFIG.learner
    progress = min(int(learner.steps) / (CONFIG.rounds * sizes.rollouts * sizes.updates), 1)
    rate = float(hyper.policy_learning_rate) * (1 - (1 - sizes.final_learning_rate) * progress)
    limit = 2.5 * float(hyper.target_noise)
    disturbed = np.tanh(mlp(learner.target.actor, following)) + np.clip(hyper.target_noise * noise, -limit, limit)
    bootstrap = values(learner.target.critics, following, np.clip(disturbed, -1, 1))
    wanted = reward + float(hyper.discount) * bootstrap.min(axis=0)
    least = -1 / (1 - float(hyper.discount))
    target = np.clip(wanted, least, 0)
    before = values(learner.online.critics, seen, action)
    value_loss, gradient = critic_loss(learner.online.critics, seen, action, weight, target)
    critics, critics_adam = adam(learner.online.critics, learner.optimizer.critics, gradient, rate)
    unmoved = values(critics, seen, np.tanh(mlp(learner.online.actor, seen))).mean(axis=0)
    better = before.mean(axis=0) > unmoved
    policy_loss, gradient = actor_loss(learner.online.actor, critics, seen, action, weight, better, unmoved)
    actor, actor_adam = adam(learner.online.actor, learner.optimizer.actor, gradient, rate)
    online = type(learner.online)(actor, critics)
    after = learner.replace(
        online=online,
        target=jax.tree.map(lambda old, new: 0.7 * old + 0.3 * new, learner.target, online),
        optimizer=type(learner.optimizer)(actor_adam, critics_adam),
        steps=learner.steps + 1,
    )
    cut = [wanted < least, wanted > 0, np.abs(noise) > 2.5, np.abs(disturbed) > 1, better, bootstrap.argmin(axis=0)]
    return after, {"value_loss": value_loss, "policy_loss": policy_loss, "value": before.mean()}, cut


def under(drawn, goal):
    """Returns transitions as samples under other goals."""
    return Samples(
        jnp.concatenate([drawn.features, jnp.asarray(goal, jnp.float32)], axis=-1), drawn.action, drawn.weight
    )


def learnt_by_hand(config, state, given, rng):
    """Returns the state after an update, its metrics, and what was cut off on the way."""
    discriminator_rng, draw_rng, noise_rng = jax.random.split(rng, 3)
    hyper, sizes = state.hyperparameters, config.learner
    state, metrics = filled(state, given), {}
    if config.discriminator_minibatches:
        expert_rng, policy_rng, fit_rng, jitter_rng, shuffle_rng = jax.random.split(discriminator_rng, 5)
        count, pick = 3 * 7, functools.partial(sampled, ENV, hyper, state.buffer)
        if config.expert_source == "relabelled":
            expert = pick(expert_rng, count, float(hyper.p_ht > 0), 2)
            spread = np.asarray(jax.random.uniform(jitter_rng, (count, 2), minval=-1.0))
            expert = under(expert, expert.goal + 0.5 * 0.5 / np.sqrt(2.0) * spread)
        else:
            kept, expert = keep(ENV, config, hyper, state.expert, given, expert_rng)
            state = state.replace(expert=kept)
        own = pick(policy_rng, count, 0.4)
        others = np.concatenate([own.goal[-(count // 2) :], own.goal[: -(count // 2)]])
        shuffled = np.asarray(jax.random.bernoulli(shuffle_rng, 0.7, (count, 1)))
        own = under(own, np.where(shuffled, others, own.goal))
        progress = float(state.learner.steps) / (CONFIG.rounds * sizes.rollouts * sizes.updates)
        decay = 1 - (1 - sizes.final_discriminator_learning_rate) * min(progress, 1)
        state, metrics = fit(CONFIG, state, expert, own, 3, fit_rng, decay, sizes.gradient_penalty)
    drawn = sampled(ENV, hyper, state.buffer, draw_rng, sizes.updates * sizes.batch, hyper.p_ht)
    state = state.replace(learner=jax.device_get(state.learner), discriminator=jax.device_get(state.discriminator))
    drawn, hyper = jax.device_get(drawn), jax.device_get(hyper)
    seen, following = normalized(state, drawn.observation), normalized(state, drawn.next_observation)
    logits = mlp(state.discriminator, np.concatenate([seen, drawn.action], axis=-1))[:, 0]
    weight = float(hyper.environment_reward) if config.discriminator_minibatches else 1.0
    reward = (1 - weight) * (1 / (1 + np.exp(-logits)) - 1) + weight * np.where(drawn.reached, 0, -1)
    noise = np.asarray(jax.random.normal(noise_rng, drawn.action.shape))
    columns, learner, measured, cuts = (
        (seen, drawn.action, following, reward, drawn.weight, noise),
        state.learner,
        [],
        [],
    )
    for step in range(sizes.updates):
        part = (np.asarray(column)[step * sizes.batch : (step + 1) * sizes.batch] for column in columns)
        learner, numbers, cut = gradient_step(hyper, learner, *part)
        measured.append(numbers)
        cuts.append(cut)
    metrics |= {name: np.mean([float(numbers[name]) for numbers in measured]) for name in measured[0]}
    metrics |= {"reward": reward.mean(), "reached": np.mean(drawn.reached)}
    return state.replace(learner=learner), metrics, [np.concatenate(each) for each in zip(*cuts, strict=True)]


OTHER_SOURCES = {
    "demonstrations": CONFIG.replace(expert_source=DEMONSTRATIONS),
    "best": CONFIG.replace(expert_source=BEST, best_episodes=4),
    "no discriminator": CONFIG.replace(discriminator_minibatches=0),
}


@pytest.mark.parametrize(
    ("source", "changes"),
    [
        ("relabelled", {}),
        ("relabelled", {"p_ht": 0.0, "environment_reward": 0.0}),
        ("relabelled", {"environment_reward": 1.0}),
        pytest.param("demonstrations", {}, marks=pytest.mark.slow),
        pytest.param("best", {}, marks=pytest.mark.slow),
        ("no discriminator", {}),
    ],
)
def test_an_update_is_that_of_td3_with_hindsight(source, changes):
    config = OTHER_SOURCES.get(source, CONFIG)
    begun = CONFIG if config.expert_source == "relabelled" else config  # whose states are the same
    state = make_state(begun, demonstrations=DEMONSTRATION if source == "demonstrations" else None, **changes)
    given, rng = trajectory(), jax.random.key(5)
    after, metrics = learn(ENV, config, state, given, rng)
    expected, numbers, cuts = learnt_by_hand(config, state, given, rng)
    assert set(metrics) == set(numbers) <= set(TD3.metrics)
    assert_close(metrics, numbers)
    assert_close(after.replace(rng=None), expected.replace(rng=None))
    if source == "no discriminator":
        equal(after.discriminator, state.discriminator)
        assert "discriminator_loss" not in metrics
    if not changes:
        *masks, least_critic = cuts
        for mask in masks:  # every bound is met, and not by all
            assert 0 < mask.mean() < 1
        assert len(set(least_critic)) > 1


def test_learning_rates_end_at_their_last_fractions():
    """After the last step they stay: as much is learnt at 8 steps as at 80, and less than at 0."""
    moved, judged = [], []
    for steps in (0, 8, 80):
        state = make_state(steps=steps)
        after, _ = learn(ENV, CONFIG, state, trajectory(), jax.random.key(5))
        moved.append(
            after.learner.online.actor["params"]["Dense_0"]["kernel"]
            - state.learner.online.actor["params"]["Dense_0"]["kernel"]
        )
        judged.append(
            after.discriminator["params"]["Dense_0"]["kernel"] - state.discriminator["params"]["Dense_0"]["kernel"]
        )
    for changes in (moved, judged):
        np.testing.assert_array_equal(changes[1], changes[2])
        assert np.abs(changes[1]).sum() < 0.5 * np.abs(changes[0]).sum()


# Rounds


def test_the_first_roll_out_is_random_and_teaches_nothing():
    state = init(CONFIG, HYPER, jax.random.key(0))
    after, metrics = round_of(ENV, CONFIG, state, np.array([PRETRAIN, SKIP, EVALUATE]))
    equal(after.learner, state.learner)
    equal(after.discriminator, state.discriminator)
    assert after.buffer.added == EPISODES
    actions = np.asarray(after.buffer.action)[np.asarray(after.buffer.valid)]
    assert kstest(actions.ravel(), "uniform", (-1, 2)).pvalue > UNLIKELY
    assert all(np.isinf(value) for value in metrics.update.values())
    assert np.isfinite(metrics.evaluation.success)


@pytest.mark.parametrize("source", [FROZEN, BEST])
def test_the_first_roll_out_is_kept_where_expert_samples_are(source):
    config = CONFIG.replace(expert_source=source, best_episodes=EPISODES)
    state, first = init(CONFIG, HYPER, jax.random.key(0)), trajectory(1)
    state = state.replace(expert=init_expert(ENV, config, None))
    after = jax.jit(config.learner.begin, static_argnums=(0, 1))(ENV, config, state, first, jax.random.key(1))[0]
    sound = np.asarray(first.valid)
    assert after.buffer.added == EPISODES
    if source == BEST:
        returns = np.sort(np.asarray(first.reward).sum(axis=0)[sound])[::-1]
        np.testing.assert_allclose(after.expert.returns[: sound.sum()], returns)
    else:
        relabel = jax.jit(functools.partial(relabelled_samples, ENV))
        equal(after.expert, relabel(state.hyperparameters, first, jax.random.key(1)))


@pytest.mark.parametrize(("steps", "random"), [(0, True), (1, False)])
def test_actions_are_the_actor_s_from_the_first_gradient_step_on(steps, random):
    state = make_state(steps=steps, epsilon=0.0, exploration_noise=jnp.full(2, 1e-6))
    observation = jnp.ones((500, ENV.observation_size))
    explored, mean = (np.asarray(act(state, observation, noise)[0]) for noise in (1.0, 0.0))
    assert (np.abs(explored - mean).max() > 0.1) == random


def test_an_update_that_is_not_finite_is_undone_with_its_episodes():
    phases = np.array([POLICY, SKIP, EVALUATE])
    sound, broken = make_state(), make_state(policy_learning_rate=np.inf)
    for state, diverged in ((sound, 0.0), (broken, 1.0)):
        after, metrics = round_of(ENV, CONFIG, state, phases)
        assert metrics.diverged == diverged
        if diverged:
            equal(after.replace(rng=None), state.replace(rng=None))
        else:
            assert after.learner.steps == state.learner.steps + CONFIG.learner.updates
            assert after.buffer.added == state.buffer.added + EPISODES


def test_a_run_fills_the_buffer_and_then_learns_in_every_roll_out():
    config = CONFIG.replace(rounds=2, rollouts=3)
    expected = [[PRETRAIN, SKIP, SKIP, EVALUATE], [POLICY] * 3 + [EVALUATE], [POLICY] * 3 + [EVALUATE]]
    np.testing.assert_array_equal(phase_table(config), expected)
    np.testing.assert_array_equal(phase_table(config.replace(rounds=0)), expected[:1])


@pytest.mark.parametrize(
    ("steps", "rounds", "done"), [(0, 2, 0.0), (2, 2, 0.25), (8, 2, 1.0), (20, 2, 1.0), (0, 0, 0.0)]
)
def test_progress_is_the_fraction_of_the_gradient_steps(steps, rounds, done):
    state = init(CONFIG, HYPER, jax.random.key(0))
    state = state.replace(learner=state.learner.replace(steps=jnp.int32(steps)))
    assert CONFIG.learner.progress(CONFIG.replace(rounds=rounds), state) == done


def test_networks_start_apart_with_targets_that_are_theirs():
    learner = init(CONFIG, HYPER, jax.random.key(0)).learner
    equal(learner.online, learner.target)
    kernel = learner.online.critics["params"]["Dense_0"]["kernel"]
    assert kernel.shape == (3, 6, 6)  # critics, observation and action, width
    assert not (kernel[0] == kernel[1]).any()
    assert not (kernel[1] == kernel[2]).any()
    assert learner.steps == 0


# The policy


@jax.jit
def act(state, observation, noise):
    return make_policy(ENV, CONFIG, state, noise)(observation, jax.random.key(7))


def achieved_in(state):
    """Returns the goals achieved after the first step in sound episodes of the buffer."""
    achieved = np.asarray(state.buffer.achieved)[np.asarray(state.buffer.valid)][:, 1:].reshape(-1, 2)
    return {tuple(goal) for goal in achieved}


def test_some_episodes_to_learn_from_begin_with_an_achieved_goal():
    """Not before there are any."""
    config = CONFIG.replace(achieved_first=0.7, num_envs=500)
    state, rng = make_state(), jax.random.key(3)
    assert CONFIG.learner.detour(ENV, CONFIG, state, rng) is None
    detours = jax.jit(functools.partial(config.learner.detour, ENV, config))
    detour = detours(state, rng)
    led = np.asarray(detour.until) > 0
    assert binomtest(int(led.sum()), len(led), 0.7).pvalue > UNLIKELY
    assert set(np.asarray(detour.until)[led]) == set(range(1, LENGTH + 1))
    assert {tuple(goal) for goal in np.asarray(detour.goal)} <= achieved_in(state)
    fresh = init(CONFIG, HYPER, jax.random.key(0))
    assert not np.asarray(detours(fresh, rng).until).any()


def test_a_round_begins_episodes_with_achieved_goals_where_it_learns_and_not_where_it_measures():
    state, phases = make_state(), np.array([SKIP, SKIP, EVALUATE])
    always = CONFIG.replace(achieved_first=1.0, rounds=0)  # no gradient steps, which have no part in this
    plain, measured = (round_of(ENV, each, state, phases)[1].evaluation for each in (CONFIG, always))
    assert_close(measured, plain, rtol=1e-5)
    after = round_of(ENV, always, state, np.array([PRETRAIN, SKIP, EVALUATE]))[0]
    place = int(state.buffer.added) % HELD
    pursued = np.asarray(after.buffer.desired)[np.arange(place, place + EPISODES) % HELD]
    assert {tuple(goal) for goal in pursued[:, 0]} <= achieved_in(state) | {(0.0, 0.0)}


OBSERVATION = jnp.asarray(np.random.default_rng(3).normal(size=(4000, 4)), jnp.float32)


def mean_of(state):
    return np.tanh(mlp(state.learner.target.actor, normalized(state, OBSERVATION)))


def test_without_noise_the_target_actor_acts():
    for steps in (0, 3):
        state = make_state(steps=steps)
        action, log_prob = act(state, OBSERVATION, 0.0)
        np.testing.assert_allclose(action, mean_of(state), rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(log_prob, np.zeros(len(OBSERVATION)))


def test_before_the_first_update_all_actions_are_random():
    action = np.asarray(act(make_state(steps=0, epsilon=0.0), OBSERVATION, 1.0)[0])
    for column in action.T:
        assert kstest(column, "uniform", (-1, 2)).pvalue > UNLIKELY
    assert abs(np.corrcoef(action.T)[0, 1]) < 0.06
    assert abs(np.corrcoef(action[:, 0], mean_of(make_state())[:, 0])[0, 1]) < 0.06


@pytest.mark.parametrize(("steps", "decay"), [(2, 0.8), (4, 0.6), (8, 0.2), (50, 0.2)])
def test_deviations_and_random_actions_shrink_over_the_run(steps, decay):
    std = jnp.array([0.03, 0.005])
    state = make_state(steps=steps, exploration_noise=std, final_exploration_noise=0.2, epsilon=0.3)
    action, mean = np.asarray(act(state, OBSERVATION, 1.0)[0]), mean_of(state)
    assert np.abs(action).max() <= 1.0
    deviation = (action - mean) / std / decay
    random = (np.abs(deviation) > 6.0).any(axis=1)  # both numbers of an action are, or neither
    assert binomtest(int(random.sum()), len(random), 0.3 * decay).pvalue > UNLIKELY
    inside = ~random & (np.abs(mean) < 0.8).all(axis=1)
    assert inside.sum() > 500
    for column in deviation[inside].T:
        assert kstest(column, norm.cdf).pvalue > UNLIKELY


def test_actions_are_clipped_to_the_range_of_the_environment():
    action = np.asarray(act(make_state(exploration_noise=jnp.full(2, 5.0), epsilon=0.0), OBSERVATION, 1.0)[0])
    assert np.abs(action).max() == 1.0
    assert (np.abs(action) == 1.0).mean() > 0.5


# Whole runs


class Short(Plane):
    """Reaches any goal in at most seven of its ten steps."""

    episode_length, feature_size, goal_size, action_size, success_threshold = 10, 1, 1, 1, 0.05

    def reset_physics(self, rng):
        return jnp.zeros(1)

    def step_physics(self, physics, action):
        return physics + 0.1 * action

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (1,), minval=-0.5, maxval=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hgail", "her"])
def test_hindsight_solves_a_line_by_the_discriminator_alone_and_by_the_goal_test(method):
    sizes = TD3(rollouts=4, updates=32, batch=128, buffer_episodes=1024)
    config = Config(sizes, num_envs=32, rounds=3, policy_hidden=(32, 32), discriminator_hidden=(32, 32))
    usual = DEFAULTS["point"]["td3"]["cpu"].hyperparameters.replace(policy_learning_rate=3e-3, tau=0.05)
    preset = Preset(config.replace(discriminator_minibatches=16, discriminator_batch=128, layer_norm=True), usual)
    preset = METHODS[method].apply(preset)
    states = init_sweep(Short(), preset.config, [preset.hyperparameters], seed_keys(0, 1))
    table = phase_table(preset.config)
    step = compile_train_step(Short(), preset.config, states, table[0])
    success = []
    for row in table:
        states, metrics = step(states, row)
        success.append(np.asarray(metrics.evaluation.success))
    assert np.max(success[0]) < 0.5
    assert np.min(success[-1]) >= 0.95


def test_the_discriminator_is_trained_where_it_has_a_say_and_only_there():
    her = CONFIG.replace(discriminator_minibatches=0)
    HYPER.replace(environment_reward=0.9).validate(2, CONFIG)
    HYPER.replace(environment_reward=1.0).validate(2, her)
    with pytest.raises(ValueError, match=r"environment_reward is 1, .* that is the method her"):
        init_state(ENV, CONFIG, HYPER.replace(environment_reward=1.0), jax.random.key(0))
    with pytest.raises(ValueError, match=r"environment_reward is 0\.9; without discriminator_minibatches it must be 1"):
        init_sweep(ENV, her, [HYPER.replace(environment_reward=0.9)], seed_keys(0, 1))


@pytest.mark.slow
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(tmp_path, monkeypatch):
    make_runs_tiny(monkeypatch)
    compile_once(monkeypatch)
    monkeypatch.chdir(tmp_path)
    tiny = CONFIG.replace(updates=4, batch=16, policy_hidden=(8,))
    monkeypatch.setitem(DEFAULTS["point"], "td3", {"cpu": Preset(tiny, HYPER.replace(exploration_noise=0.2))})
    monkeypatch.setattr(training, "_MOST_OF_SAVING", 1.0)  # so that each round is saved, fast as these are
    start("--learner", "td3", "--out", "whole")
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crash"):
        fail_in_round(patch, 3, crash)
        start("--learner", "td3", "--out", "run")
    assert saved_in(Path("run"))[-1] == 3  # learnt, not only filled
    start("--learner", "td3", "--resume", "run")
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")
