"""The past that a policy reads on a robot is the one that it read in training."""

import jax
import numpy as np
import pytest

from hgail_envs.past import Past
from hgail_envs.point import Point
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv

ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 3)).astype(np.float32)


@pytest.mark.parametrize(("known", "history"), [(0, 0), (0, 3), (2, 0), (2, 1), (4, 2)])
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_it_is_what_the_policy_read_in_training(known, history, delay):
    delay = min(delay, known or delay)
    sizes = Randomization(delay=(delay, delay), robot_noise=0.01, history=history, known_delay=known)
    env, past = RandomizedEnv(Point(), sizes), Past(sizes, delay, action_size=3)
    state = env.reset(jax.random.key(0))
    for action in ACTIONS:
        features = np.asarray(state.info["features"])
        seen = features[-3:]
        np.testing.assert_array_equal(np.append(past.before(seen), seen), features)
        past.add(action, seen)
        state = env.step(state, action)


@pytest.mark.parametrize("delay", [-1, 3])
def test_a_delay_that_the_policy_does_not_know_is_refused(delay):
    with pytest.raises(ValueError, match=f"delay is {delay}; the policy knows delays from 0 to 2"):
        Past(Randomization(known_delay=2), delay)
    Past(Randomization(history=1), 3)
