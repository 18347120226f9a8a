import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_jax import METHODS, PPO, Config, Hyperparameters, Preset, init_state, rollout, train_step
from hgail_jax.config import BEST, DEMONSTRATIONS
from hgail_jax.experts import init_expert, keep_best
from hgail_jax.learner import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.samples import Samples
from tests.support import TINY

ENV = hgail_envs.make("point")
HYPER = Hyperparameters()


def random_policy(observation, rng):
    return jax.random.normal(rng, (*observation.shape[:-1], 3)), jnp.zeros(observation.shape[:-1])


roll_out = jax.jit(lambda seed: rollout(ENV, random_policy, jax.random.key(seed), 6))


def with_returns(trajectory, returns, distance=0.0, valid=True):
    """The trajectory, its episodes told apart by their actions, with the returns asked for."""
    length, episodes = trajectory.reward.shape
    return trajectory.replace(
        reward=jnp.broadcast_to(jnp.array(returns) / length, (length, episodes)),
        action=jnp.broadcast_to(jnp.array(returns)[:, None], trajectory.action.shape),
        valid=jnp.broadcast_to(jnp.array(valid), (episodes,)),
        outcome=trajectory.outcome.replace(distance_l1=jnp.broadcast_to(jnp.array(distance), (episodes,))),
    )


def demonstrations(count=40, observation=6, action=3):
    return Samples(jnp.ones((count, observation)), jnp.ones((count, action)), jnp.ones(count))


def test_episodes_are_kept_under_the_goals_they_pursued():
    trajectory = roll_out(0)
    best = init_expert(ENV, TINY.replace(expert_source=BEST, best_episodes=6), None)
    kept = keep_best(ENV, HYPER, best, with_returns(trajectory, np.arange(6.0)))
    np.testing.assert_array_equal(kept.samples.observation[:, 0, :3], trajectory.features[:-1, 5])
    np.testing.assert_array_equal(kept.samples.observation[:, 0, 3:], trajectory.desired[:-1, 5])


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
        jax.eval_shape(functools.partial(init_state, ENV, TINY.replace(**config), HYPER), jax.random.key(0), given)


def test_an_unknown_source_is_refused():
    with pytest.raises(ValueError, match="expert_source is 'dreams'; it must be one of relabelled, frozen"):
        Config(PPO(), expert_source="dreams")


def test_every_roll_out_to_learn_from_can_enter_the_buffer_and_no_other():
    config = METHODS["gasil"].apply(Preset(TINY.replace(best_episodes=5), HYPER)).config
    start = jax.jit(functools.partial(init_state, ENV, config))(HYPER, jax.random.key(0))
    step = jax.jit(functools.partial(train_step, ENV, config))
    for phase, episodes in ((SKIP, 0), (PRETRAIN, 4), (POLICY, 4), (DISCRIMINATOR, 4), (EVALUATE, 0)):
        state, _ = step(start, np.array([phase]))
        assert float(state.expert.samples.weight.sum()) == episodes * 50
