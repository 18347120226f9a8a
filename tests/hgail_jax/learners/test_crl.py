"""Contrastive RL against its closed form, a plain NumPy of its update, and a task with a known answer."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from hgail_jax import Config, phase_table
from hgail_jax.buffer import draw_future
from hgail_jax.learners.crl import CRL, contrastive_loss
from hgail_jax.seeds import compile_train_step, init_sweep, seed_keys
from hgail_jax.settings.defaults import DEFAULTS
from hgail_jax.trainer.train_options import TrainOptions, plan
from tests.hgail_jax.learners.test_td3 import (
    ENV,
    EPISODES,
    HELD,
    HYPER,
    Short,
    adam,
    assert_close,
    filled,
    init,
    mlp,
    sampled,
    trajectory,
)
from tests.hgail_jax.learners.track import normalized

CONFIG = Config(
    CRL(rollouts=2, updates=2, batch=20, buffer_episodes=HELD, critics=2, representation=3, final_learning_rate=0.2),
    num_envs=EPISODES,
    rounds=2,
    discriminator_minibatches=0,
    policy_hidden=(6, 5),
    layer_norm=True,
)
SCALARS = HYPER.replace(discount=0.7)
learn = jax.jit(CONFIG.learner.update, static_argnums=(0, 1))
loss_of = jax.jit(contrastive_loss)
drawn_future = jax.jit(draw_future)

# The loss


def test_the_best_logit_is_how_much_likelier_a_goal_is_after_a_pair_than_at_all():
    """Minibatches of two samples are few enough to be counted: their expected loss is exact."""
    joint = np.random.default_rng(0).dirichlet(np.ones(12)).reshape(3, 4)
    samples = list(itertools.product(range(3), range(4)))
    batches = np.array([(*one, *other) for one, other in itertools.product(samples, samples)])
    pairs, goals = batches[:, ::2], batches[:, 1::2]
    probability = joint[pairs, goals].prod(axis=1)

    @jax.jit
    @jax.value_and_grad
    def expected(table):
        logits = table.reshape(3, 4)[pairs[:, :, None], goals[:, None, :]]
        return probability @ jax.vmap(lambda each: contrastive_loss(each, jnp.ones(2)))(logits)

    with jax.enable_x64(True):
        start = np.random.default_rng(1).normal(size=12)
        best = minimize(lambda table: [np.asarray(each, float) for each in expected(table)], start, jac=True).x
    ratio = np.log(joint / np.outer(joint.sum(axis=1), joint.sum(axis=0)))
    best = best.reshape(3, 4)
    np.testing.assert_allclose(best - best.mean(), ratio - ratio.mean(), atol=0.02)


def test_a_broken_episode_is_neither_a_sample_nor_a_negative():
    logits = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    sound = np.array([0, 1, 3])
    weight = np.isin(np.arange(5), sound).astype(np.float32)
    few = loss_of(logits[np.ix_(sound, sound)], np.ones(3, np.float32))
    np.testing.assert_allclose(5 * loss_of(logits, weight), 3 * few, rtol=1e-5)


def test_a_minibatch_of_broken_episodes_alone_changes_nothing():
    loss, gradient = jax.jit(jax.value_and_grad(contrastive_loss))(np.ones((3, 3)), np.zeros(3))
    assert loss == 0.0
    np.testing.assert_array_equal(gradient, 0.0)


# The update


def logits_of(critics, observation, action, xp=np):
    """Returns the logits of each critic, pairs by goals, `[critics, B, B]`."""
    pair, goal = xp.concatenate([observation[:, :2], action], axis=-1), observation[:, 2:]
    each = [jax.tree.map(lambda leaf, i=index: leaf[i], critics) for index in range(2)]
    return xp.stack([mlp(critic.pair, pair, xp) @ mlp(critic.goal, goal, xp).T for critic in each])


@jax.jit
@jax.value_and_grad
def critic_loss(critics, seen, action, sound):
    """Sums over those that are sound alone, whose own logits come from all."""
    logits = logits_of(critics, seen, action, jnp)
    of_pairs, of_goals = jnp.where(sound, logits, -jnp.inf), jnp.where(sound[:, None], logits, -jnp.inf)
    normalizers = jax.nn.logsumexp(of_pairs, axis=2) + jax.nn.logsumexp(of_goals, axis=1)
    return (sound * (normalizers - 2 * jnp.diagonal(logits, axis1=1, axis2=2))).sum() / len(seen)


@jax.jit
@jax.value_and_grad
def actor_loss(actor, critics, seen, weight):
    before_tanh = mlp(actor, seen, jnp)
    gained = jnp.diagonal(logits_of(critics, seen, jnp.tanh(before_tanh), jnp), axis1=1, axis2=2).mean(axis=0)
    return -(weight * gained).mean() + 0.01 * (before_tanh**2).mean()


def make_state(**changes):
    """A state amid a run, whose actor is not near zero."""
    state = init(CONFIG, SCALARS.replace(**changes), jax.random.key(0))
    vary = functools.partial(jax.tree.map, lambda leaf: np.asarray(leaf) + np.float32(0.4) * np.cos(leaf.size + leaf))
    networks, count = vary(state.learner.online), jnp.int32(3)
    moments = [
        each._replace(count=jnp.int32(4), nu=jax.tree.map(np.square, vary(each.nu))) for each in state.learner.optimizer
    ]
    learner = state.learner.replace(online=networks, optimizer=type(state.learner.optimizer)(*moments), steps=count)
    return filled(state.replace(learner=learner), trajectory(1))


def learnt_by_hand(state, given, rng):
    """Returns the learner after an update, and its metrics."""
    draw_rng, future_rng, chosen_rng = jax.random.split(rng, 3)
    hyper, sizes = state.hyperparameters, CONFIG.learner
    state, measured = filled(state, given), []
    drawn = sampled(ENV, hyper, state.buffer, draw_rng, sizes.updates * sizes.batch, 0.0)
    future = np.asarray(drawn_future(state.buffer, drawn, hyper.discount, future_rng))
    chosen = np.asarray(jax.random.bernoulli(chosen_rng, hyper.p_ht, (len(future), 1)))
    goals = [future, np.where(chosen, future, drawn.goal)]
    positive, sought = (normalized(state, np.concatenate([drawn.features, goal], axis=-1)) for goal in goals)
    learner, weight = jax.device_get(state.learner), np.asarray(drawn.weight)
    assert 0 < weight.mean() < 1 and 0 < chosen.mean() < 1
    for part in np.split(np.arange(len(weight)), sizes.updates):
        rate = float(hyper.policy_learning_rate) * (1 - 0.8 * int(learner.steps) / 8)
        online, moments, action = learner.online, learner.optimizer, np.asarray(drawn.action)[part]
        value = np.diagonal(logits_of(online.critics, positive[part], action), axis1=1, axis2=2).mean()
        value_loss, gradient = critic_loss(online.critics, positive[part], action, weight[part] > 0)
        critics, critics_adam = adam(online.critics, moments.critics, gradient, rate)
        policy_loss, gradient = actor_loss(online.actor, critics, sought[part], weight[part])
        actor, actor_adam = adam(online.actor, moments.actor, gradient, rate)
        moved = type(online)(actor, critics)
        learner = learner.replace(
            online=moved,
            target=jax.tree.map(lambda old, new: 0.7 * old + 0.3 * new, learner.target, moved),
            optimizer=type(moments)(actor_adam, critics_adam),
            steps=learner.steps + 1,
        )
        measured.append({"value": value, "value_loss": value_loss, "policy_loss": policy_loss})
    return learner, {name: np.mean([each[name] for each in measured]) for name in measured[0]}


def test_an_update_is_that_of_contrastive_rl():
    state, given, rng = make_state(), trajectory(), jax.random.key(5)
    after, metrics = learn(ENV, CONFIG, state, given, rng)
    learner, expected = learnt_by_hand(state, given, rng)
    assert_close(metrics, expected)
    assert_close(after.learner.online, learner.online)
    assert_close(after.learner.target, learner.target)
    assert after.learner.steps == state.learner.steps + 2


@pytest.mark.slow
def test_it_solves_a_line_without_a_reward():
    sizes = CRL(rollouts=4, updates=32, batch=128, buffer_episodes=1024)
    config = Config(sizes, num_envs=32, rounds=3, policy_hidden=(32, 32), layer_norm=True, discriminator_minibatches=0)
    hyper = DEFAULTS["point"]["td3"]["cpu"].hyperparameters.replace(policy_learning_rate=3e-3, tau=0.05)
    states, table = init_sweep(Short(), config, [hyper], seed_keys(0, 1)), phase_table(config)
    step, success = compile_train_step(Short(), config, states, table[0]), []
    for row in table:
        states, metrics = step(states, row)
        success.append(np.asarray(metrics.evaluation.success))
    assert np.max(success[0]) < 0.5
    assert np.min(success[-1]) >= 0.95


# Settings


def test_it_has_the_sizes_of_td3_on_each_task():
    for task in ("push", "pick-and-place"):
        usual = plan(TrainOptions(task, learner="td3", seeds=1), "gpu")
        run = plan(TrainOptions(task, learner="crl", seeds=1, settings=("training_goals=false",)), "gpu")
        assert (run.method, run.config.rounds, run.config.num_envs) == (
            "crl",
            usual.config.rounds,
            usual.config.num_envs,
        )
        assert (run.config.learner, run.config.training_goals) == (CRL(**vars(usual.config.learner)), False)
    assert plan(TrainOptions("push", method="crl", seeds=1), "cpu").config.learner.name == "crl"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "tower"}, "needs a task whose observation is its features and its goal"),
        ({"method": "her"}, "learner of the method her is 'crl'; choose from td3"),
        ({"bc_weight": 0.5}, "--bc-weight changes nothing for the learner crl"),
        ({"settings": ("discount=1",)}, "discount is 1; the learner crl needs one below 1"),
        ({"settings": ("goal_jitter=0.5",)}, "--settings goal_jitter changes nothing for the learner crl"),
        ({"settings": ("representation=0",)}, "representation is 0; it must be"),
    ],
)
def test_bad_settings_are_refused_in_one_line(changes, message):
    with pytest.raises(ValueError, match=message) as error:
        plan(TrainOptions(**{"task": "point", "learner": "crl", "seeds": 1} | changes), "cpu")
    assert len(str(error.value).splitlines()) == 1
