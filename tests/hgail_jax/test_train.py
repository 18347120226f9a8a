import copy
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs import EpisodeMetrics
from hgail_envs.point import Point
from hgail_jax import Hyperparameters, env_steps, init_state, make_policy, phase_table, rollout, train_step
from hgail_jax.config import BEST, RELABELLED
from hgail_jax.evaluate import mean_outcome, whole_rollouts
from hgail_jax.learner import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.seeds import evaluate_seeds, init_seeds, init_sweep, seed_keys, trace_evaluation
from hgail_jax.state import split_key
from hgail_jax.train import _learn
from hgail_jax.trainer.train_options import TrainOptions, plan
from tests.support import TINY, copied

ENV = hgail_envs.make("point")
PHASES = phase_table(TINY)


@functools.cache
def begun(seeds, settings):
    return init_sweep(ENV, TINY, [Hyperparameters(**dict(changes)) for changes in settings], seed_keys(0, seeds))


def start(*settings, seeds=1):
    """Returns states for `step_of_two`, which takes them; they have these settings, or two of one the usual ones."""
    return copied(begun(seeds, tuple(tuple(changes.items()) for changes in settings or [{}] * (2 // seeds))))


def first(results):
    """Returns what is of the first of two."""
    return jax.tree.map(lambda leaf: leaf[0], results)


def row(phase):
    return np.array([phase] + [SKIP] * (PHASES.shape[1] - 1))


def train(step, state, phases=PHASES):
    metrics = []
    for each in phases:
        state, measured = step(state, each)
        metrics.append(measured)
    return state, jax.tree.map(lambda *values: jnp.stack(values), *metrics)


def without_key(state):
    return jax.device_get(state.replace(rng=jax.random.key_data(state.rng)))


def assert_equal(one, other, **tolerance):
    jax.tree.map(functools.partial(np.testing.assert_allclose, **tolerance), without_key(one), without_key(other))


def test_one_seed_is_bit_equal_twice_and_two_seeds_differ(step_of_two):
    once, metrics = train(step_of_two, start(seeds=2))
    again, metrics_again = train(step_of_two, start(seeds=2))
    jax.tree.map(np.testing.assert_array_equal, without_key(once), without_key(again))
    jax.tree.map(np.testing.assert_array_equal, metrics, metrics_again)
    assert not np.allclose(*once.statistics.mean)
    # What a round does not measure is infinite, so that JAX_DEBUG_NANS finds only what is wrong.
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves((without_key(once), metrics)))


class Telling(Point):
    """A point that nothing moves. An outcome says where the episode began, its goal, what for, how late, how tested."""

    MEASURED, LEARNT_FROM = 0.25, 0.5
    progress = 1.0
    lift_test_steps = 2

    def curriculum(self, progress):
        env = copy.copy(self)
        env.progress = progress
        return env

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (3,))

    def step_physics(self, physics, action):
        return physics

    def sample_goal(self, rng, physics):
        return jnp.stack([jax.random.uniform(rng), self.MEASURED, self.progress])

    def plan_goals(self, rng, physics, training_goals):
        return self.sample_goal(rng, physics).at[1].set(jnp.where(training_goals, self.LEARNT_FROM, self.MEASURED))

    def outcome(self, end, lifted):
        drawn, purpose, progress = end.info["desired_goal"]
        tested = (lifted.info["step"] - end.info["step"]).astype(jnp.float32)
        return EpisodeMetrics(purpose, progress, tested, end.info["achieved_goal"][0], drawn)


# With one episode in a roll-out, the means over its episodes are that episode's own.
ONE = TINY.replace(num_envs=1, rounds=4, policy_phases=1)


def start_telling(config):
    return jax.jit(functools.partial(init_state, Telling(), config))(Hyperparameters(), jax.random.key(0))


@functools.cache
def unchecked_scan_of(config):
    return jax.jit(functools.partial(jax.lax.scan, functools.partial(train_step, Telling(), config)))


def scan_of(config):
    """Returns a function of a state and rows to the state and metrics after a scan over them; no key serves twice."""

    def checked(state, rows):
        with jax.debug_key_reuse(True):
            return unchecked_scan_of(config)(state, rows)

    return checked


@functools.cache
def scanned(config):
    """Returns the state and metrics after all rounds in one scan."""
    return scan_of(config)(start_telling(config), phase_table(config))


def telling_step(state, phases, scan_of=scan_of):
    """Runs one round, by the program of all: rounds of nothing follow it."""
    rows = np.full_like(phase_table(ONE), SKIP)
    rows[0, : len(phases)] = phases
    state, metrics = scan_of(ONE)(state, rows)
    return state, jax.tree.map(lambda leaf: leaf[0], metrics)


def test_a_scan_over_the_phases_is_the_loop_over_them():
    (state, metrics), (after, expected) = scanned(ONE), train(telling_step, start_telling(ONE), phase_table(ONE))
    assert_equal(state, after, rtol=1e-4, atol=1e-5)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4), metrics, expected)
    assert np.isfinite(metrics.update["reward"][1:]).all()


def test_a_key_that_is_used_twice_is_noticed():
    with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
        jax.jit(lambda key: jax.random.normal(key) + jax.random.normal(key))(jax.random.key(0))
    state = start_telling(ONE)
    telling_step(state, [SKIP])
    with pytest.raises(jax.errors.KeyReuseError):
        telling_step(state, [SKIP])


@pytest.mark.parametrize(
    "config",
    [ONE, pytest.param(ONE.replace(training_goals=False, pretrain=False), marks=pytest.mark.slow)],
    ids=["all", "fewer"],
)
def test_learning_has_the_goals_and_the_progress_that_it_should_and_evaluations_are_of_the_task_itself(config):
    metrics = scanned(config)[1]
    np.testing.assert_array_equal(metrics.evaluation.success, np.full(5, Telling.MEASURED))
    np.testing.assert_array_equal(metrics.evaluation.achieved, np.ones(5))
    np.testing.assert_array_equal(metrics.evaluation.success_l1, np.full(5, Telling.lift_test_steps))
    pretrained = 1.0 if config.learner.pretrain else np.inf
    purpose = Telling.LEARNT_FROM if config.training_goals else Telling.MEASURED
    np.testing.assert_array_equal(metrics.training.success, purpose * np.array([pretrained, 1, 1, 1, 1]))
    np.testing.assert_array_equal(metrics.training.success_l1[1:], np.zeros(4))
    # In each round one phase before the policy's update, and `discriminator_phases` after it.
    later = config.learner.discriminator_phases
    expected = np.arange(4) / 4 + later / (1 + later) / 4
    np.testing.assert_allclose(metrics.training.achieved, [pretrained - 1.0, *expected], atol=1e-5)


def test_no_two_roll_outs_have_a_start_or_a_goal_in_common():
    """Not those of two phases, of a phase and an evaluation beside it, of two evaluations, nor the final ones."""
    states, drawn = init_seeds(Telling(), ONE, Hyperparameters(), seed_keys(0, 1)), []
    evaluate_last = trace_evaluation(Telling(), ONE, states, 1)()
    alone = jax.jit(lambda states: jax.tree.map(lambda leaf: leaf[0], states))
    beside = jax.jit(lambda state: jax.tree.map(lambda leaf: leaf[None], state))
    state = alone(states)
    for phase in (PRETRAIN, POLICY, DISCRIMINATOR, POLICY):
        _, evaluated = telling_step(state, [EVALUATE], unchecked_scan_of)
        final = evaluate_last(beside(state))
        assert final.success == Telling.MEASURED
        state, learnt = telling_step(state, [phase], unchecked_scan_of)
        for episode in (evaluated.evaluation, learnt.training, final):
            drawn += [float(np.squeeze(episode.distance_l1)), float(np.squeeze(episode.distance_l2))]
    assert len(set(drawn)) == len(drawn) == 24
    assert 0.0 < min(drawn) < max(drawn) < 1.0


def test_evaluations_are_of_the_mean_action_and_training_has_noise(step_of_two):
    """Either is the roll-out that its key and its noise give alone."""
    wide = functools.partial(start, *[{"exploration_noise": 1.0}] * 2)
    state = first(wide())
    keys = split_key(state.rng)

    @jax.jit
    def alone(rng, noise):
        rollout_rng, _ = jax.random.split(rng)
        episodes = rollout(ENV, make_policy(ENV, TINY, state, noise), rollout_rng, TINY.num_envs, noise > 0)
        return mean_outcome(episodes).distance_l2

    evaluation = step_of_two(wide(), row(EVALUATE))[1].evaluation
    training = step_of_two(wide(), row(POLICY))[1].training
    for measured, key, noise in ((evaluation, keys.evaluation, 0.0), (training, keys.phase, 1.0)):
        np.testing.assert_allclose(measured.distance_l2, alone(key, noise), rtol=1e-5)
    assert abs(alone(keys.evaluation, 1.0) - alone(keys.evaluation, 0.0)) > 0.01


def test_a_run_that_never_updates_the_policy_has_no_easy_rounds():
    config = TINY.replace(policy_phases=0)
    assert config.learner.progress(config, None) == 1.0


def test_an_evaluation_changes_nothing_in_the_training(step_of_two):
    with_one, without = (
        step_of_two(start(), np.array([PRETRAIN, POLICY, phase, DISCRIMINATOR, SKIP]))[0] for phase in (EVALUATE, SKIP)
    )
    assert_equal(with_one, without, rtol=0, atol=0)


def test_seeds_and_settings_side_by_side_have_no_part_in_each_other(step_of_two):
    states, swapped = start(seeds=2), np.array([1, 0])
    states = states.replace(hyperparameters=states.hyperparameters.replace(p_ht=jnp.array([1.0, 0.0])))
    others = jax.jit(lambda states: jax.tree.map(lambda leaf: leaf[swapped], states))(states)
    (together, metrics), (after, measured) = train(step_of_two, states), train(step_of_two, others)
    same = functools.partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-4)
    jax.tree.map(lambda one, other: same(one, other[swapped]), *map(without_key, (together, after)))
    jax.tree.map(lambda one, other: same(one, other[:, swapped]), metrics, measured)


@pytest.mark.slow
def test_seeds_and_settings_side_by_side_are_each_as_alone(step_of_two):
    swept = init_sweep(ENV, TINY, [Hyperparameters(), Hyperparameters(p_ht=0.0)], seed_keys(0, 2))
    chosen = jax.jit(lambda states: jax.tree.map(lambda leaf: leaf[np.array([0, 3])], states))(swept)
    together, metrics = train(step_of_two, chosen)
    together = together.replace(rng=jax.random.key_data(together.rng))
    init, step = (jax.jit(functools.partial(each, ENV, TINY)) for each in (init_state, train_step))
    for seed, p_ht in enumerate((1.0, 0.0)):
        alone, metrics_alone = train(step, init(Hyperparameters(p_ht=p_ht), jax.random.key(seed)))
        of_seed = jax.tree.map(lambda leaf, i=seed: np.asarray(leaf)[i], together)
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-4), of_seed, without_key(alone))
        np.testing.assert_allclose(
            metrics.evaluation.distance_l1[:, seed], metrics_alone.evaluation.distance_l1, rtol=1e-3
        )


def changed(before, after, name):
    leaves = zip(jax.tree.leaves(getattr(before, name)), jax.tree.leaves(getattr(after, name)), strict=True)
    return any(not np.array_equal(one, other) for one, other in leaves)


@pytest.mark.parametrize(
    ("phase", "learns"),
    [
        (SKIP, set()),
        (PRETRAIN, {"learner", "discriminator", "statistics"}),
        (POLICY, {"learner", "statistics"}),
        (DISCRIMINATOR, {"discriminator"}),
        (EVALUATE, set()),
    ],
)
def test_a_phase_changes_what_it_teaches_and_nothing_else(step_of_two, phase, learns):
    before = start()
    after, _ = step_of_two(copied(before), row(phase))
    for name in ("learner", "discriminator", "statistics"):
        assert changed(before, after, name) == (name in learns)
    kept = np.array_equal(jax.random.key_data(before.rng), jax.random.key_data(after.rng))
    assert kept == (phase in (SKIP, EVALUATE))


def test_phases_and_their_steps():
    np.testing.assert_array_equal(
        phase_table(TINY.replace(rounds=1)),
        [[PRETRAIN, SKIP, SKIP, SKIP, EVALUATE], [SKIP, POLICY, POLICY, DISCRIMINATOR, EVALUATE]],
    )
    assert phase_table(TINY.replace(pretrain=False))[0, 0] == SKIP
    np.testing.assert_array_equal(env_steps(ENV, TINY, PHASES), np.array([1, 3, 3]) * 4 * 50)


class Crowded(Point):
    """The point at random starts; beyond a limit in x there is no room for contacts."""

    limit = 9.0

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (3,))

    def overflow(self, physics):
        return physics[0] > self.limit


def still(observation, rng):
    return jnp.zeros((len(observation), 3)), jnp.zeros(len(observation))


def test_an_evaluation_reports_one_environment_of_one_roll_out_of_one_seed_without_room_for_contacts(monkeypatch):
    env, config = Crowded(), TINY.replace(num_envs=2)
    monkeypatch.setattr("hgail_jax.seeds.make_policy", lambda *_, **__: still)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 2))
    rngs = [rng for key in states.rng for rng in jax.random.split(split_key(key).final_evaluation, 2)]
    begin = jax.jit(lambda rng: rollout(env, still, rng, 2).features[0, :, 0])
    *_, second, largest = np.sort(np.ravel([begin(rng) for rng in rngs]))
    env.limit = (second + largest) / 2
    with pytest.raises(OverflowError, match="out of room for contacts in the final evaluation"):
        evaluate_seeds(env, config, states, 4)
    env.limit = largest + 1e-3
    evaluate_seeds(env, config, states, 4)


def test_a_phase_reports_the_fraction_of_environments_without_room_for_contacts_or_broken():
    learner = types.SimpleNamespace(phase_updates=dict, metrics=(), phase_table=lambda config: PHASES)
    nothing = types.SimpleNamespace(learner=learner)

    @jax.jit
    def measure(state, rng):
        episodes = rollout(ENV, still, rng, 4).replace(overflow=jnp.arange(4) == 2, valid=jnp.arange(4) != 1)
        return _learn(ENV, nothing, jnp.array(SKIP), state, episodes, rng)[1]

    measured = measure(first(start()), jax.random.key(0))
    assert (measured.overflow, measured.dropped) == (0.25, 0.25)


class Fragile(Telling):
    """It breaks down in the episodes whose goal is beyond the middle; in its reference physics, others begin 10 on."""

    shift = 0.0

    def reference_physics(self):
        env = copy.copy(self)
        env.shift = 10.0
        return env

    def outcome(self, end, lifted):
        outcome = super().outcome(end, lifted)
        broken = jnp.where(outcome.distance_l2 > 0.5, jnp.nan, 1.0)
        return outcome.replace(success=1.0, distance_l1=outcome.distance_l1 + self.shift, distance_l2=broken)


def test_seeds_are_evaluated_in_whole_roll_outs_one_after_another_in_the_accurate_physics():
    """What broke down there is a failure, and has no distance."""
    assert [whole_rollouts(episodes, 4) for episodes in (1, 4, 5)] == [1, 1, 2]
    env, config = Fragile(), TINY.replace(num_envs=2)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 2))
    measured = evaluate_seeds(env, config, states, 15)
    np.testing.assert_array_equal(measured.distance_l2, 1.0)
    assert (measured.success_l1 > 0.0).all()  # by the lift test
    roll_out = jax.jit(lambda state, rng: rollout(env, make_policy(env, config, state, noise=0.0), rng, 2))
    for seed, key in enumerate(states.rng):
        state = jax.tree.map(lambda leaf, i=seed: leaf[i], states)
        alone = [roll_out(state, rng) for rng in jax.random.split(split_key(key).final_evaluation, 8)]
        valid = np.array([episodes.valid for episodes in alone])
        assert 0 < valid.any(axis=1).sum() < 8  # in some roll-outs none is
        np.testing.assert_allclose(measured.success[seed], valid.mean())
        starts = [episodes.outcome.distance_l1[episodes.valid].mean() for episodes in alone if episodes.valid.any()]
        np.testing.assert_allclose(measured.distance_l1[seed], 10.0 + np.mean(starts), rtol=1e-5)


STEPS = ("features", "achieved", "desired", "action", "noted", "reward")
EIGHT = TINY.replace(num_envs=8, bc_batch=16, best_episodes=12)


@functools.cache
def start_wide(config):
    return jax.jit(functools.partial(init_state, ENV, config))(
        Hyperparameters(exploration_noise=1.0), jax.random.key(0)
    )


@functools.cache
def two_rollouts():
    policy = make_policy(ENV, EIGHT, start_wide(EIGHT), noise=1.0)
    return [jax.jit(lambda key: rollout(ENV, policy, key, 8))(jax.random.key(seed)) for seed in (3, 4)]


UPDATES = TINY.learner.phase_updates()


@pytest.mark.parametrize(
    ("source", "update"),
    [
        *((RELABELLED, update) for update in UPDATES.values()),
        (BEST, UPDATES[POLICY]),
        *(pytest.param(BEST, UPDATES[phase], marks=pytest.mark.slow) for phase in (PRETRAIN, DISCRIMINATOR)),
    ],
)
def test_what_is_in_an_episode_that_is_not_valid_does_not_matter(update, source):
    """Not even where it is not blank: whatever is put there, all that is learnt is the same to the bit."""
    config = EIGHT.replace(expert_source=source)
    state, (whole, another) = start_wide(config), two_rollouts()
    valid = jnp.array([True, False, True, True, False, True, False, True])

    def with_broken(filling):
        """Returns the roll-out with the broken episodes of another in it."""
        mixed = {
            name: jnp.where(valid[:, None] if getattr(whole, name).ndim == 3 else valid, getattr(whole, name), values)
            for name, values in filling.items()
        }
        return whole.replace(valid=valid, **mixed)

    learn = jax.jit(functools.partial(update, ENV, config))

    def learnt(trajectory):
        after, metrics = learn(state, trajectory, jax.random.key(5))
        return jax.tree.map(np.asarray, (after.replace(rng=None, expert=None), metrics))

    fillings = [{name: scale * getattr(another, name) for name in STEPS} for scale in (0.0, 1.0, 50.0)]
    results = [learnt(with_broken(filling)) for filling in fillings]
    for other in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, results[0], other)
    with_all = learnt(with_broken(fillings[1]).replace(valid=jnp.ones(8, bool)))
    assert not all(map(np.array_equal, jax.tree.leaves(results[1]), jax.tree.leaves(with_all)))


@pytest.mark.parametrize(
    "options",
    [
        {"task": "point", "learner": "ppo"},
        {"task": "point", "learner": "td3", "environment_reward": 0.5},
        pytest.param({"task": "point", "learner": "ppo", "method": "gasil"}, marks=pytest.mark.slow),
        pytest.param({"task": "slide", "impl": "c"}, marks=pytest.mark.slow),
        pytest.param({"task": "grasp", "impl": "c", "randomize": "full-history"}, marks=pytest.mark.slow),
    ],
    ids=lambda options: " ".join(map(str, options.values())),
)
def test_programs_are_traced_where_ranks_and_types_must_not_be_promoted(options):
    """As under JAX_NUMPY_RANK_PROMOTION=raise and JAX_NUMPY_DTYPE_PROMOTION=strict."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        run = plan(TrainOptions(seeds=2, num_envs=4, rounds=1, **options), "cpu")
        states = jax.eval_shape(run.init)
        one = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[0], run.init()))
        jax.eval_shape(functools.partial(train_step, run.env, run.config), one, run.phases()[0])
        trace_evaluation(run.env, run.config, states, 4)
