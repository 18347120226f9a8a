import copy
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import hgail_envs
from hgail_envs import EpisodeMetrics
from hgail_envs.point import Point
from hgail_jax import Config, Hyperparameters, env_steps, init_state, phase_table, rollout, train_step
from hgail_jax.config import BEST, RELABELLED
from hgail_jax.evaluate import evaluate, whole_rollouts
from hgail_jax.learners import find_learner
from hgail_jax.learners.base import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.learners.ppo import pretrain, update_discriminator, update_policy
from hgail_jax.samples import relabelled_samples
from hgail_jax.seeds import evaluate_seeds, init_seeds, seed_keys, trace_evaluation
from hgail_jax.state import split_key
from hgail_jax.train import make_policy
from tests.support import TINY

ENV = hgail_envs.make("point")
PHASES = phase_table(TINY)
tiny_step = jax.jit(functools.partial(train_step, ENV, TINY))
seeds_step = jax.jit(jax.vmap(functools.partial(train_step, ENV, TINY), in_axes=(0, None)))


def train_tiny(seed, step=tiny_step, state=None):
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(seed)) if state is None else state
    metrics = []
    for phases in PHASES:
        state, measured = step(state, phases)
        metrics.append(measured)
    return state, jax.tree.map(lambda *values: jnp.stack(values), *metrics)


def without_key(state):
    return jax.tree.map(np.asarray, state.replace(rng=jax.random.key_data(state.rng)))


def assert_equal(one, other, **tolerance):
    jax.tree.map(functools.partial(np.testing.assert_allclose, **tolerance), without_key(one), without_key(other))


def test_one_seed_is_bit_equal_twice_and_two_seeds_differ():
    first, metrics = train_tiny(0)
    again, metrics_again = train_tiny(0)
    jax.tree.map(np.testing.assert_array_equal, without_key(first), without_key(again))
    jax.tree.map(np.testing.assert_array_equal, metrics, metrics_again)
    other, _ = train_tiny(1)
    assert not np.allclose(first.statistics.mean, other.statistics.mean)


def test_every_episode_has_goals_of_its_own():
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
    policy = make_policy(ENV, TINY, state, noise=1.0)
    goals = np.concatenate([rollout(ENV, policy, jax.random.key(seed), 4).desired[0] for seed in range(3)])
    assert len(np.unique(goals[:, 0])) == 12


class Still(Point):
    """A point that nothing moves, so that distances are those of the goals."""

    def step_physics(self, physics, action):
        return physics


class Drawn(Still):
    """Its distances are what its starts and goals are drawn as: both uniform from 0 to 1."""

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (3,))

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (3,))

    def outcome(self, end, lifted):
        return EpisodeMetrics(distance_l1=end.info["achieved_goal"][0], distance_l2=end.info["desired_goal"][0])


def test_no_two_roll_outs_have_a_start_or_a_goal_in_common():
    """Not those of two phases, of a phase and an evaluation beside it, of two evaluations, nor the final ones.

    With one episode in a roll-out, the means over its episodes are that episode's own.
    """
    env, config = Drawn(), TINY.replace(num_envs=1)
    step = jax.jit(functools.partial(train_step, env, config))
    states, drawn = init_seeds(env, config, Hyperparameters(), seed_keys(0, 1)), []
    evaluate_last = trace_evaluation(env, config, states, 1)()
    state = jax.tree.map(lambda leaf: leaf[0], states)
    for phase in (PRETRAIN, POLICY, DISCRIMINATOR, POLICY):
        _, evaluated = step(state, np.array([EVALUATE]))
        final = evaluate_last(jax.tree.map(lambda leaf: leaf[None], state))
        state, learnt = step(state, np.array([phase]))
        for episode in (evaluated.evaluation, learnt.training, final):
            drawn += [float(np.squeeze(episode.distance_l1)), float(np.squeeze(episode.distance_l2))]
    assert len(set(drawn)) == len(drawn) == 24
    assert 0.0 < min(drawn) < max(drawn) < 1.0


def test_the_roll_outs_of_the_final_evaluation_differ():
    env, config = Drawn(), TINY.replace(num_envs=1)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 1))
    means = [float(evaluate_seeds(env, config, states, episodes).distance_l1[0]) for episodes in (1, 2)]
    assert 2 * means[1] - means[0] != means[0]


class Told(Still):
    """Its distance says what a goal was drawn for."""

    MEASURED, LEARNT_FROM = 0.25, 0.5

    def sample_goal(self, rng, physics):
        return jnp.full(3, self.MEASURED)

    def plan_goals(self, rng, physics, training_goals):
        return jnp.full(3, jnp.where(training_goals, self.LEARNT_FROM, self.MEASURED))

    def outcome(self, end, lifted):
        return EpisodeMetrics(distance_l1=end.info["desired_goal"][0], distance_l2=1.0)


@pytest.mark.parametrize("training_goals", [True, False])
def test_learning_phases_have_training_goals_where_the_config_says_so_and_evaluations_never(training_goals):
    config = TINY.replace(training_goals=training_goals)
    step = jax.jit(functools.partial(train_step, Told(), config))
    states = init_seeds(Told(), config, Hyperparameters(), seed_keys(0, 1))
    if training_goals:
        assert evaluate_seeds(Told(), config, states, 4).distance_l1 == Told.MEASURED
    state = jax.tree.map(lambda leaf: leaf[0], states)
    for phase in (PRETRAIN, POLICY, DISCRIMINATOR):
        state, metrics = step(state, np.array([phase, EVALUATE]))
        assert metrics.training.distance_l1 == (Told.LEARNT_FROM if training_goals else Told.MEASURED)
        assert metrics.evaluation.distance_l1 == Told.MEASURED


class Progressing(Point):
    """A point whose goals are as far away along x as the training has come."""

    progress = 1.0

    def curriculum(self, progress):
        env = copy.copy(self)
        env.progress = progress
        return env

    def sample_goal(self, rng, physics):
        return jnp.zeros(3).at[0].set(self.progress)

    def outcome(self, end, lifted):
        return EpisodeMetrics(distance_l2=end.info["desired_goal"][0])


@pytest.mark.parametrize("pretrained", [True, False])
def test_a_task_that_becomes_harder_is_learnt_so_and_measured_as_it_is(pretrained):
    env, config = Progressing(), TINY.replace(rounds=4, policy_phases=1, pretrain=pretrained)
    state = init_state(env, config, Hyperparameters(), jax.random.key(0))
    run = functools.partial(jax.lax.scan, functools.partial(train_step, env, config))
    metrics = jax.jit(run)(state, phase_table(config))[1]
    np.testing.assert_array_equal(metrics.evaluation.distance_l2, np.ones(5))
    # In each round one phase before the policy's update, and `discriminator_phases` after it.
    begun = np.arange(4) / 4
    after = config.learner.discriminator_phases
    expected = begun + after / (1 + after) / 4
    first = [0.0] if pretrained else [np.nan]
    np.testing.assert_allclose(metrics.training.distance_l2, [*first, *expected], atol=1e-5)


def test_a_run_that_never_updates_the_policy_has_no_easy_rounds():
    config = TINY.replace(policy_phases=0)
    state = init_state(ENV, config, Hyperparameters(), jax.random.key(0))
    assert find_learner(config).progress(config, state) == 1.0


def test_an_evaluation_changes_nothing_in_the_training():
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
    with_one, without = (
        tiny_step(state, np.array([PRETRAIN, POLICY, phase, DISCRIMINATOR, SKIP]))[0] for phase in (EVALUATE, SKIP)
    )
    assert_equal(with_one, without, rtol=0, atol=0)


def test_seeds_side_by_side_equal_seeds_alone():
    keys = seed_keys(0, 2)
    together, metrics = train_tiny(None, seeds_step, init_seeds(ENV, TINY, Hyperparameters(), keys))
    for seed in range(2):
        alone, metrics_alone = train_tiny(seed)
        assert_equal(jax.tree.map(lambda leaf, seed=seed: leaf[seed], together), alone, rtol=2e-3, atol=2e-4)
        np.testing.assert_allclose(
            metrics.evaluation.distance_l1[:, seed], metrics_alone.evaluation.distance_l1, rtol=1e-3
        )


def test_a_scan_over_the_phases_is_the_loop_over_them():
    looped, metrics = train_tiny(0)
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
    scanned, scanned_metrics = jax.jit(
        lambda state: jax.lax.scan(functools.partial(train_step, ENV, TINY), state, PHASES)
    )(state)
    assert_equal(looped, scanned, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(metrics.update["reward"], scanned_metrics.update["reward"], rtol=1e-3)


def test_hyperparameters_can_be_swept_in_one_program():
    init = functools.partial(init_state, ENV, TINY, rng=jax.random.key(0))
    swept = jax.vmap(lambda p_ht: init(Hyperparameters(p_ht=p_ht)))(jnp.array([0.0, 1.0]))
    swept, _ = train_tiny(None, seeds_step, swept)
    for index, p_ht in enumerate((0.0, 1.0)):
        alone, _ = train_tiny(None, tiny_step, init(Hyperparameters(p_ht=p_ht)))
        assert_equal(jax.tree.map(lambda leaf, i=index: leaf[i], swept), alone, rtol=2e-3, atol=2e-4)


def test_no_key_is_used_twice():
    with jax.debug_key_reuse(True):
        state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
        jax.jit(functools.partial(train_step, ENV, TINY))(state, PHASES[0])
        with pytest.raises(jax.errors.KeyReuseError):  # the checker does see one
            jax.jit(lambda key: jax.random.normal(key) + jax.random.normal(key))(jax.random.key(0))


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
def test_a_phase_changes_what_it_teaches_and_nothing_else(phase, learns):
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
    after, _ = tiny_step(state, np.array([phase] + [SKIP] * (PHASES.shape[1] - 1)))
    for name in ("learner", "discriminator", "statistics"):
        assert changed(state, after, name) == (name in learns)
    assert np.array_equal(jax.random.key_data(state.rng), jax.random.key_data(after.rng)) == (phase in (SKIP, EVALUATE))


def test_phases_and_their_steps():
    np.testing.assert_array_equal(
        phase_table(TINY.replace(rounds=1)),
        [[PRETRAIN, SKIP, SKIP, SKIP, EVALUATE], [SKIP, POLICY, POLICY, DISCRIMINATOR, EVALUATE]],
    )
    assert phase_table(TINY.replace(pretrain=False))[0, 0] == SKIP
    np.testing.assert_array_equal(env_steps(ENV, TINY, PHASES), np.array([1, 3, 3]) * 4 * 50)


class Refined(Point):
    """`Point` whose accurate physics moves half as far."""

    gain = 1.0

    def reference_physics(self):
        env = copy.copy(self)
        env.gain = 0.5
        return env

    def step_physics(self, physics, action):
        return super().step_physics(physics, self.gain * action)


def test_seeds_are_evaluated_as_one_roll_out_after_another_in_the_accurate_physics():
    env = Refined()
    states = init_seeds(env, TINY, Hyperparameters(), seed_keys(0, 2))
    assert [whole_rollouts(episodes, TINY.num_envs) for episodes in (1, 4, 5)] == [1, 1, 2]
    for episodes, rollouts in ((1, 1), (5, 2)):
        measured = evaluate_seeds(env, TINY, states, episodes)
        for seed in range(2):
            state = jax.tree.map(lambda leaf, seed=seed: leaf[seed], states)
            policy = make_policy(env, TINY, state, noise=0.0)
            rngs = jax.random.split(split_key(state.rng).final_evaluation, rollouts)
            alone = [evaluate(env.reference_physics(), policy, rng, 4) for rng in rngs]
            expected = np.mean([outcome.distance_l1 for outcome in alone])
            np.testing.assert_allclose(measured.distance_l1[seed], expected, rtol=1e-4)


class Fragile(Drawn):
    """It breaks down in the episodes whose goal is beyond the middle."""

    def outcome(self, end, lifted):
        broken = end.info["desired_goal"][0] > 0.5
        return super().outcome(end, lifted).replace(success=1.0, distance_l2=jnp.where(broken, jnp.nan, 1.0))


def test_roll_outs_that_broke_down_are_failures_in_the_final_evaluation_and_have_no_distance():
    env, config = Fragile(), TINY.replace(num_envs=1)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 2))
    measured = evaluate_seeds(env, config, states, 16)
    np.testing.assert_array_equal(measured.distance_l2, 1.0)
    for seed, key in enumerate(states.rng):
        policy = make_policy(env, config, jax.tree.map(lambda leaf, i=seed: leaf[i], states), noise=0.0)
        rngs = jax.random.split(split_key(key).final_evaluation, 16)
        alone = list(map(jax.jit(lambda rng, policy=policy: rollout(env, policy, rng, 1)), rngs))
        valid = [bool(episode.valid[0]) for episode in alone]
        assert 0 < sum(valid) < 16
        np.testing.assert_allclose(measured.success[seed], np.mean(valid))
        starts = [float(episode.outcome.distance_l1[0]) for episode in alone if episode.valid[0]]
        np.testing.assert_allclose(measured.distance_l1[seed], np.mean(starts), rtol=1e-5)


def test_relabelled_samples_keep_state_and_action():
    state = init_state(ENV, TINY, Hyperparameters(), jax.random.key(0))
    trajectory = rollout(ENV, make_policy(ENV, TINY, state, noise=1.0), jax.random.key(1), 4)
    samples = relabelled_samples(ENV, state.hyperparameters, trajectory, jax.random.key(2))
    np.testing.assert_array_equal(samples.observation[:, :3], trajectory.features[:-1].reshape(-1, 3))
    np.testing.assert_array_equal(samples.action, trajectory.action.reshape(-1, 3))
    goals = np.asarray(samples.observation[:, 3:]).reshape(50, 4, 3)
    for step, episode in ((0, 0), (20, 1), (49, 3)):
        later = np.asarray(trajectory.achieved[step + 1 :, episode])
        assert (np.abs(later - goals[step, episode]).max(axis=-1) == 0).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0; it must be at least 1"),
        ({"rounds": -1}, "rounds is -1; it must be at least 0"),
        ({"final_learning_rate": 1.5}, "from 0 to 1"),
    ],
)
def test_bad_sizes_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Config().replace(**changes)


@pytest.mark.parametrize("changes", [{"p_ht": 1.1}, {"p_ht": float("nan")}, {"action_std": 0.0}, {"discount": -0.1}])
def test_bad_hyperparameters_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        Hyperparameters(**changes).validate()


class Faulty(Point):
    """The point, whose simulation breaks down for good once it is beyond the border."""

    fault = float("nan")
    border = 0.1

    def step_physics(self, physics, action):
        return super().step_physics(physics, action) + jnp.where(physics[1] > self.border, self.fault, 0.0)


def test_a_broken_episode_is_blank_and_leaves_the_others_as_they_are():
    config = TINY.replace(num_envs=16)
    exploded = type("Exploded", (Faulty,), {"fault": 1e9})()
    state = init_state(ENV, config, Hyperparameters(action_std=1.0), jax.random.key(0))
    policy = make_policy(ENV, config, state, noise=1.0)
    whole, broken, large = (
        jax.jit(lambda rng, env=env: rollout(env, policy, rng, 16))(jax.random.key(3))
        for env in (ENV, Faulty(), exploded)
    )
    valid = np.asarray(broken.valid)
    assert 1 <= (~valid).sum() <= 15
    np.testing.assert_array_equal(valid, np.asarray(whole.features)[:-1, :, 1].max(0) <= Faulty.border)
    for name in ("features", "achieved", "desired", "action", "log_prob", "reward"):
        ours, theirs, others = (np.asarray(getattr(t, name)) for t in (broken, whole, large))
        np.testing.assert_allclose(ours[:, valid], theirs[:, valid], rtol=0, atol=1e-6)  # of programs of their own
        assert (ours[:, ~valid] == 0).all()
        np.testing.assert_allclose(ours, others, rtol=0, atol=1e-6)


@pytest.mark.parametrize("update", [pretrain, update_policy, update_discriminator])
@pytest.mark.parametrize("source", [RELABELLED, BEST])
def test_what_is_in_an_episode_that_is_not_valid_does_not_matter(update, source):
    """Not even where it is not blank: whatever is put there, all that is learnt is the same to the bit."""
    config = TINY.replace(num_envs=8, bc_batch=16, expert_source=source, best_episodes=12)
    state = init_state(ENV, config, Hyperparameters(action_std=1.0), jax.random.key(0))
    policy = make_policy(ENV, config, state, noise=1.0)
    whole, another = (rollout(ENV, policy, jax.random.key(seed), 8) for seed in (3, 4))
    valid = jnp.array([True, False, True, True, False, True, False, True])
    steps = ("features", "achieved", "desired", "action", "log_prob", "reward")

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

    fillings = [{name: scale * getattr(another, name) for name in steps} for scale in (0.0, 1.0, 50.0)]
    results = [learnt(with_broken(filling)) for filling in fillings]
    for other in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, results[0], other)
    with_all = learnt(with_broken(fillings[1]).replace(valid=jnp.ones(8, bool)))
    assert not all(map(np.array_equal, jax.tree.leaves(results[1]), jax.tree.leaves(with_all)))


def test_broken_episodes_are_counted_and_a_round_of_nothing_else_teaches_nothing():
    config = TINY.replace(num_envs=16)
    step = jax.jit(functools.partial(train_step, type("Hopeless", (Faulty,), {"border": -jnp.inf})(), config))
    state = init_state(ENV, config, Hyperparameters(), jax.random.key(0))
    after, metrics = step(state, PHASES[1])
    assert metrics.dropped == 1.0
    assert metrics.evaluation.success == 0.0
    for episodes in (metrics.evaluation, metrics.training):
        assert np.isnan([episodes.distance_l1, episodes.distance_l2]).all()
    assert metrics.diverged == 0.0
    jax.tree.map(np.testing.assert_array_equal, without_key(after.replace(rng=state.rng)), without_key(state))


def test_a_deviation_for_each_number_of_the_action():
    stds = np.float32([0.1, 1.0, 3.0])
    state = init_state(ENV, TINY, Hyperparameters(action_std=stds), jax.random.key(0))
    policy = make_policy(ENV, TINY, state, noise=1.0)
    action, log_prob = policy(jnp.zeros((20000, 6)), jax.random.key(1))
    np.testing.assert_allclose(np.std(action, axis=0), stds, rtol=0.03)
    mean = make_policy(ENV, TINY, state, noise=0.0)(jnp.zeros((1, 6)), jax.random.key(1))[0]
    np.testing.assert_allclose(log_prob, norm.logpdf(action, mean, stds).sum(-1), rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="one number or 3"):
        init_state(ENV, TINY, Hyperparameters(action_std=(0.1, 0.2)), jax.random.key(0))
