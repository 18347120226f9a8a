import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from hgail_jax import Config, Hyperparameters, init_state, load_policy, save_policy
from hgail_jax.files import replace_file
from hgail_jax.policy import from_state
from hgail_jax.updates import act


def test_a_saved_policy_is_the_mean_action(tmp_path):
    env = envs.make("point")
    state = init_state(env, Config(), Hyperparameters(), jax.random.key(0))
    state = state.observe(jax.random.normal(jax.random.key(1), (100, 6)) * 0.1, jnp.ones(100))
    # weights large enough that some actions are clipped
    state = state.replace(actor_critic=jax.tree.map(lambda leaf: 3.0 * leaf + 0.1, state.actor_critic))
    observation = jax.random.normal(jax.random.key(2), (20, 6)) * 0.2
    expected, _ = act(env, Config(), state, noise=0.0)(observation, jax.random.key(3))
    save_policy(tmp_path / "p.npz", from_state("point", state))
    policy = load_policy(tmp_path / "p.npz")
    np.testing.assert_allclose(policy(np.asarray(observation)), np.clip(expected, -1, 1), rtol=1e-4, atol=1e-5)
    assert policy.task == "point"
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "p.npz").write_bytes(content)
    with pytest.raises(ValueError, match="is not a policy file"):
        load_policy(tmp_path / "p.npz")


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", header=np.array([{"format": "hgail_jax policy 1"}], dtype=object))
    with pytest.raises(ValueError, match="is not a policy file"):
        load_policy(tmp_path / "p.npz")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), replace_file(path) as file:
        file.write("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.txt"]
