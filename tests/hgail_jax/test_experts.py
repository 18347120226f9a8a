import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from hgail_jax import METHODS, PRESETS, Config, Hyperparameters, Preset, init_state, rollout, schedule, train_step
from hgail_jax.config import BEST, DEMONSTRATIONS, FROZEN
from hgail_jax.distributed.seeds import init_sweep, seed_keys, split_sweep
from hgail_jax.experts import expert_samples, init_expert, keep_best
from hgail_jax.samples import Samples, policy_samples, relabelled_samples
from hgail_jax.train import DISCRIMINATOR, POLICY, PRETRAIN, SKIP
from tests.support import TINY

ENV = envs.make("point")
HYPER = Hyperparameters()


def random_policy(observation, rng):
    return jax.random.normal(rng, (*observation.shape[:-1], 3)), jnp.zeros(observation.shape[:-1])


roll_out = jax.jit(lambda seed: rollout(ENV, random_policy, jax.random.key(seed), 6))


def with_returns(trajectory, returns, distance=0.0, sound=True):
    """The trajectory, its episodes told apart by their actions, with the returns asked for."""
    length, episodes = trajectory.reward.shape
    return trajectory.replace(
        reward=jnp.broadcast_to(jnp.array(returns) / length, (length, episodes)),
        action=jnp.broadcast_to(jnp.array(returns)[:, None], trajectory.action.shape),
        sound=jnp.broadcast_to(jnp.array(sound), (episodes,)),
        outcome=trajectory.outcome.replace(distance_l1=jnp.broadcast_to(jnp.array(distance), (episodes,))),
    )


def demonstrations(count=40, observation=6, action=3):
    return Samples(jnp.ones((count, observation)), jnp.ones((count, action)), jnp.ones(count))


def test_the_buffer_holds_the_best_of_all_roll_outs():
    """Against sorting everything ever seen."""
    best = init_expert(ENV, dataclasses.replace(TINY, expert_source=BEST, best_episodes=8), None)
    keep, rng, seen = jax.jit(functools.partial(keep_best, ENV, HYPER)), np.random.default_rng(0), []
    for seed in range(5):
        returns = rng.permutation(1000)[:6].astype(np.float32) * -0.5
        seen += returns.tolist()
        best = keep(best, with_returns(roll_out(seed), returns))
        top = sorted(seen, reverse=True)[:8]
        np.testing.assert_allclose(best.returns[: len(top)], top, rtol=1e-5)
        np.testing.assert_allclose(best.samples.action[7, : len(top), 1], top)  # each return goes with its episode
        np.testing.assert_array_equal(best.samples.weight.sum(axis=0), [50.0] * len(top) + [0.0] * (8 - len(top)))


def test_episodes_are_kept_under_the_goals_they_pursued():
    trajectory = roll_out(0)
    best = init_expert(ENV, dataclasses.replace(TINY, expert_source=BEST, best_episodes=6), None)
    kept = keep_best(ENV, HYPER, best, with_returns(trajectory, np.arange(6.0)))
    np.testing.assert_array_equal(kept.samples.observation[:, 0, :3], trajectory.features[:-1, 5])
    np.testing.assert_array_equal(kept.samples.observation[:, 0, 3:], trajectory.desired[:-1, 5])


@pytest.mark.parametrize(("by_distance", "kept"), [(False, [0, 1, 2]), (True, [1, 5, 3])])
def test_ties_fall_to_the_earlier_or_to_the_nearer(by_distance, kept):
    distance = np.array([0.9, 0.1, 0.8, 0.3, 0.7, 0.2], np.float32)
    best = init_expert(ENV, dataclasses.replace(TINY, expert_source=BEST, best_episodes=3), None)
    hyper = HYPER.replace(ties_by_distance=by_distance)
    best = keep_best(ENV, hyper, best, with_returns(roll_out(0), np.full(6, -50.0), distance))
    np.testing.assert_allclose(best.distance, distance[kept])


def test_broken_episodes_never_count():
    best = init_expert(ENV, dataclasses.replace(TINY, expert_source=BEST, best_episodes=8), None)
    sound = np.array([True, False, True, False, True, True])
    best = keep_best(ENV, HYPER, best, with_returns(roll_out(0), np.full(6, -50.0), sound=sound))
    assert float(best.samples.weight.sum()) == 4 * 50
    assert jnp.isfinite(best.returns).all()


def test_frozen_expert_samples_are_those_of_the_first_roll_out():
    config = dataclasses.replace(TINY, num_envs=6, expert_source=FROZEN)
    take = jax.jit(functools.partial(expert_samples, ENV, config, HYPER))
    expert = init_expert(ENV, config, None)
    assert not expert.weight.any()
    first = relabelled_samples(ENV, HYPER, roll_out(0), jax.random.key(7))
    for seed in range(3):
        expert, samples = take(expert, roll_out(seed), jax.random.key(7 + seed))
        jax.tree.map(np.testing.assert_array_equal, samples, first)


def test_relabelled_expert_samples_follow_the_roll_out():
    config, trajectory = dataclasses.replace(TINY, num_envs=6), roll_out(1)
    kept, samples = expert_samples(ENV, config, HYPER, None, trajectory, jax.random.key(2))
    assert kept is None
    assert not np.array_equal(samples.observation, policy_samples(ENV, trajectory).observation)


@pytest.mark.parametrize(
    ("config", "given", "message"),
    [
        ({}, demonstrations(), "expert_source is 'relabelled' and demonstrations are given"),
        ({"expert_source": DEMONSTRATIONS}, None, "expert_source is 'demonstrations' and none are given"),
        ({"expert_source": DEMONSTRATIONS}, demonstrations(observation=9), r"must be \[S, 6\], \[S, 3\] and \[S\]"),
        ({"expert_source": DEMONSTRATIONS}, demonstrations(action=4), r"must be \[S, 6\], \[S, 3\] and \[S\]"),
    ],
)
def test_demonstrations_must_fit(config, given, message):
    with pytest.raises(ValueError, match=message):
        init_state(ENV, dataclasses.replace(TINY, **config), HYPER, jax.random.key(0), given)


def test_an_unknown_source_is_refused():
    with pytest.raises(ValueError, match="expert_source is 'dreams'; it must be one of relabelled, frozen"):
        Config(expert_source="dreams")


METHOD_STEPS = {
    name: (preset, jax.jit(functools.partial(train_step, ENV, preset.config)))
    for name, method in METHODS.items()
    if name in ("gail-demo", "gasil", "gcsl")  # the others are the same step with other numbers in it
    for preset in [method.apply(Preset(dataclasses.replace(TINY, best_episodes=5), HYPER))]
}


def state_of(name):
    preset, _ = METHOD_STEPS[name]
    given = demonstrations() if name == "gail-demo" else None
    return init_state(ENV, preset.config, preset.hyperparameters, jax.random.key(0), given)


@pytest.mark.parametrize("name", METHOD_STEPS)
def test_every_method_trains_on_the_one_step(name):
    preset, step = METHOD_STEPS[name]
    state = state_of(name)
    before = state
    for phases in schedule(preset.config):
        state, metrics = step(state, phases)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.replace(rng=None)))
    assert jnp.isfinite(metrics.evaluation.distance_l1)

    def moved(part):
        pairs = zip(jax.tree.leaves(part(before)), jax.tree.leaves(part(state)), strict=True)
        return any(not np.array_equal(one, other) for one, other in pairs)

    assert moved(lambda state: state.actor_critic["policy"])
    assert moved(lambda state: state.discriminator)


def test_maximum_likelihood_alone_ignores_advantages():
    """With no weight on PPO's loss the policy is the same whatever the reward; with it, it is not."""
    _, step = METHOD_STEPS["gcsl"]
    width = len(schedule(METHOD_STEPS["gcsl"][0].config)[0])

    def policy(ppo_weight, environment_reward):
        state = state_of("gcsl")
        changes = {"ppo_weight": ppo_weight, "environment_reward": environment_reward}
        hyper = jax.tree.map(jnp.asarray, state.hyperparameters.replace(**changes))
        phases = np.array([POLICY] + [SKIP] * (width - 1))
        return jax.tree.leaves(step(state.replace(hyperparameters=hyper), phases)[0].actor_critic["policy"])[1]

    np.testing.assert_array_equal(policy(0.0, 0.0), policy(0.0, 1.0))
    assert not np.array_equal(policy(1.0, 0.0), policy(1.0, 1.0))


@pytest.mark.parametrize("phase", [PRETRAIN, POLICY, DISCRIMINATOR])
def test_every_roll_out_to_learn_from_can_enter_the_buffer(phase):
    preset, step = METHOD_STEPS["gasil"]
    row = np.array([phase] + [SKIP] * (len(schedule(preset.config)[0]) - 1))
    state, _ = step(state_of("gasil"), row)
    assert float(state.expert.samples.weight.sum()) == 4 * 50


def test_demonstrations_stay_as_they_are():
    preset, step = METHOD_STEPS["gail-demo"]
    state = state_of("gail-demo")
    for phases in schedule(preset.config):
        state, _ = step(state, phases)
    jax.tree.map(np.testing.assert_array_equal, state.expert, demonstrations())


def test_methods_in_data():
    def applied(name):
        return METHODS[name].apply(PRESETS["parallel"])

    assert applied("hgail") == PRESETS["parallel"]
    for name in ("gcsl", "gail-demo"):
        assert applied(name).config.likelihood_batch == 512
        assert applied(name).hyperparameters.likelihood_weight == 1.0
    more = Preset(dataclasses.replace(PRESETS["parallel"].config, likelihood_batch=2048), HYPER)
    assert METHODS["gcsl"].apply(more).config.likelihood_batch == 2048
    weighted = Preset(more.config, HYPER.replace(likelihood_weight=0.3))
    assert METHODS["gail-demo"].apply(weighted).config.likelihood_batch == 2048
    assert METHODS["gail-demo"].apply(weighted).hyperparameters.likelihood_weight == 1.0
    assert METHODS["ppo"].apply(more).config.likelihood_batch == 0


class Asked(type(ENV)):
    """Remembers when it was asked for the goals to learn from."""

    asked: ClassVar[list] = []

    def exploring(self, when=True):
        self.asked.append(when)
        return self


@pytest.mark.parametrize("explore", [True, False])
def test_methods_without_hindsight_learn_on_the_goals_they_are_measured_by(explore, monkeypatch):
    monkeypatch.setattr(Asked, "asked", [])
    config = dataclasses.replace(TINY, explore=explore)
    state = init_state(Asked(), config, HYPER, jax.random.key(0))
    jax.eval_shape(functools.partial(train_step, Asked(), config), state, schedule(config)[0])
    assert Asked.asked
    assert all((when is not False) == explore for when in Asked.asked)  # explored, it is a tracer: not in evaluations


def test_a_sweep_starts_every_setting_with_every_seed():
    settings = [HYPER, HYPER.replace(p_ht=0.2, strategy=1), HYPER.replace(action_std=0.7, reward=2)]
    keys = seed_keys(3, 2)
    swept = split_sweep(init_sweep(ENV, TINY, settings, keys), 3)
    start = jax.jit(functools.partial(init_state, ENV, TINY))
    for index, setting in enumerate(settings):
        for seed in range(2):
            found = jax.tree.map(lambda leaf, i=index, j=seed: leaf[i, j], swept)
            expected = start(setting, keys[seed])
            jax.tree.map(np.testing.assert_array_equal, found.replace(rng=None), expected.replace(rng=None))
            assert found.rng == expected.rng


def test_a_sweep_refuses_what_a_run_refuses():
    with pytest.raises(ValueError, match=r"p_ht is 1\.5"):
        init_sweep(ENV, TINY, [HYPER, HYPER.replace(p_ht=1.5)], seed_keys(0, 2))
    with pytest.raises(ValueError, match="number of settings is 0"):
        init_sweep(ENV, TINY, [], seed_keys(0, 2))
