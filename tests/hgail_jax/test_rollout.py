import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.point import Point
from hgail_jax import rollout


class Probed(Point):
    """The point, measured where three further steps, each with half the action before it, bring it."""

    probe_length = 3

    def probe_action(self, action):
        return 0.5 * action

    def outcome(self, end, probed):
        return self.measure(probed.info["achieved_goal"], end.info["desired_goal"])


def turning(observation, rng):
    """Goes for the goal in a way that depends on the observation alone, and beyond the bounds of an action."""
    del rng
    return 9.0 * observation[:, [4, 5, 3]] + 5.0 * observation[:, :3], jnp.zeros(len(observation))


@pytest.mark.parametrize("probe", [False, True, jnp.array(False), jnp.array(True)])
def test_a_roll_out_is_the_loop_over_its_steps_and_its_probe(probe):
    episodes = jax.jit(lambda rng: rollout(Probed(), turning, rng, 4, probe=probe))(jax.random.key(0))
    goal = np.asarray(episodes.desired[0], np.float64)
    assert len(np.unique(goal)) == goal.size
    position = np.zeros((4, 3))
    for step in range(50):
        np.testing.assert_allclose(episodes.features[step], position, atol=1e-5)
        np.testing.assert_array_equal(episodes.achieved[step], episodes.features[step])
        np.testing.assert_array_equal(episodes.desired[step], goal)
        action = 9.0 * goal[:, [1, 2, 0]] + 5.0 * position
        np.testing.assert_allclose(episodes.action[step], action, atol=1e-4)
        position = position + 0.03 * np.clip(action, -1.0, 1.0)
        reached = np.linalg.norm(position - goal, axis=-1) <= 0.05
        np.testing.assert_array_equal(episodes.reward[step], np.where(reached, 0.0, -1.0))
    np.testing.assert_allclose(episodes.features[50], position, atol=1e-5)
    assert len(episodes.features) == len(episodes.reward) + 1 == 51
    for halved in (0.5, 0.25, 0.125) if probe else ():
        position = position + 0.03 * np.clip(halved * action, -1.0, 1.0)
    np.testing.assert_allclose(episodes.outcome.distance_l1, np.abs(position - goal).sum(axis=-1), atol=1e-5)
