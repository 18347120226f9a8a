import pytest

import hgail_envs
from hgail_jax import Hyperparameters, phase_table
from hgail_jax.seeds import compile_train_step, init_sweep, seed_keys
from tests.support import TINY


@pytest.fixture(scope="session")
def step_of_two():
    """The compiled step of two states side by side, tiny ones of point."""
    env = hgail_envs.make("point")
    states = init_sweep(env, TINY, [Hyperparameters()] * 2, seed_keys(0, 1))
    return compile_train_step(env, TINY, states, phase_table(TINY)[0])
