import json
import os
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import stablehlo

import hgail_envs
from hgail_jax import (
    PPO,
    TD3,
    Config,
    MeanPolicy,
    export_policy,
    init_state,
    load_policy,
    make_policy,
    save_policy,
)
from hgail_jax.io.policy import from_state
from hgail_jax.samples import Samples


@pytest.fixture
def policy(shipped_policy):
    return load_policy(shipped_policy)


def start(env, config, seen):
    """Returns an untrained state that has counted observations `[100, 6]`."""

    @jax.jit
    def counted(rng, seen):
        return init_state(env, config, config.learner.hyperparameters(), rng).count(Samples(seen, None, jnp.ones(100)))

    return counted(jax.random.key(0), seen.astype(np.float32))


def actions(env, config, state, observation):
    """Returns the actions without noise, as training would take them."""
    act = jax.jit(lambda state, seen: make_policy(env, config, state, noise=0.0)(seen, jax.random.key(3))[0])
    return np.asarray(act(state, observation))


def test_a_saved_policy_is_the_mean_action(tmp_path):
    env, config, rng = hgail_envs.make("point"), Config(PPO()), np.random.default_rng(1)
    state = start(env, config, 0.1 * rng.normal(size=(100, 6)))
    # weights large enough that some actions are clipped
    networks = jax.tree.map(lambda leaf: 3.0 * np.asarray(leaf) + 0.1, state.learner.actor_critic)
    state = state.replace(learner=state.learner.replace(actor_critic=networks))
    observation = 0.2 * rng.normal(size=(20, 6)).astype(np.float32)
    expected = actions(env, config, state, observation)
    save_policy(tmp_path / "p.npz", from_state("point", env, config, state))
    policy = load_policy(tmp_path / "p.npz")
    np.testing.assert_allclose(policy(observation), np.clip(expected, -1, 1), rtol=1e-4, atol=1e-5)
    assert (policy.task, policy.goal_size, policy.observation_size, policy.action_size) == ("point", 3, 6, 3)
    assert policy.versions["jax"] == jax.__version__
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


def test_the_file_can_be_read_with_numpy_alone(shipped_policy, policy):
    """As the documentation of the format has it, without this package."""
    file = np.load(shipped_policy, allow_pickle=False)
    header = json.loads(str(file["header"]))
    observation = np.random.default_rng(0).normal(size=(50, header["observation"]["features"] + 3))
    hidden = np.clip((observation - file["mean"]) / file["std"], -5.0, header["observation"]["clip"])
    for index in range(header["layers"]):
        hidden = hidden @ file[f"weights_{index}"] + file[f"biases_{index}"]
        hidden = np.tanh(hidden) if index < header["layers"] - 1 else hidden
    action = np.clip(hidden, header["action"]["low"], header["action"]["high"])
    np.testing.assert_allclose(policy(observation), action, rtol=1e-6)
    assert header["observation"] == {"features": 6, "goal": 3, "clip": 5.0}
    assert header["versions"]["jax"]


def test_the_exported_program_is_the_policy(policy, tmp_path):
    """Run by StableHLO's own interpreter."""
    export_policy(tmp_path / "p.mlirbc", policy)
    with ir.Context() as context:
        stablehlo.register_dialect(context)
        program = stablehlo.deserialize_portable_artifact(context, (tmp_path / "p.mlirbc").read_bytes())
        for observation in np.random.default_rng(0).normal(size=(5, 9)).astype(np.float32):
            (action,) = stablehlo.eval_module(program, [ir.DenseElementsAttr.get(observation)])
            np.testing.assert_allclose(np.array(action), policy(observation), atol=1e-5)


def test_an_observation_of_another_size_is_refused(policy):
    for observation in (np.zeros(8), np.zeros((9, 2)), 1.0):
        with pytest.raises(ValueError, match="an observation of reach has 9 numbers"):
            policy(observation)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "p.npz").write_bytes(content)
    with pytest.raises(ValueError, match="does not hold a policy"):
        load_policy(tmp_path / "p.npz")


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", header=np.array([{"format": "hgail_jax policy 2"}], dtype=object))
    with pytest.raises(ValueError, match=r"does not hold a policy.*pickle"):
        load_policy(tmp_path / "p.npz")


def rewrite(source, target, header=None, save=np.savez, **arrays):
    with np.load(source) as file:
        content = {name: file[name] for name in file.files}
    changed = json.loads(str(content["header"])) | (header or {})
    save(target, **(content | arrays | {"header": np.array(json.dumps(changed))}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": {"format": "hgail_jax policy 1"}}, "its format is 'hgail_jax policy 1'"),
        ({"header": {"layers": 10**9}}, "it has no 1000000000 layers"),
        ({"header": {"task": None}}, "it names no task"),
        ({"header": {"task": ""}}, "it names no task"),
        ({"header": {"layers": 0}}, "it has no 0 layers"),
        ({"header": {"layers": 4}}, "weights_3"),
        ({"header": {"layers": 2}}, "not have the sizes"),
        ({"header": {"activation": "relu"}}, "does not compute"),
        ({"header": {"observation": {"features": 7, "goal": 3, "clip": 5.0}}}, "not have the sizes"),
        ({"header": {"observation": {"features": 0, "goal": 9, "clip": 5.0}}}, "does not fit"),
        ({"header": {"action": {"size": 3, "low": -1.0, "high": 1.0}}}, "not have the sizes"),
        ({"header": {"observation": None}}, "does not hold a policy"),
        ({"mean": np.zeros(8, np.float32)}, "does not fit"),
        ({"std": np.zeros(9, np.float32)}, "does not fit"),
        ({"mean": np.full(9, np.nan, np.float32)}, "not all of its arrays are finite"),
        ({"mean": np.zeros(9)}, "not all of its arrays are finite float32"),
        ({"biases_1": np.zeros((64, 64), np.float32)}, "layers do not fit"),
        ({"weights_2": np.zeros((63, 4), np.float32)}, "layers do not fit"),
        ({"save": np.savez_compressed}, "it is compressed"),
    ],
)
def test_files_that_do_not_fit_together_are_refused(tmp_path, shipped_policy, changes, message):
    rewrite(shipped_policy, tmp_path / "same.npz")
    assert isinstance(load_policy(tmp_path / "same.npz"), MeanPolicy)
    rewrite(shipped_policy, tmp_path / "p.npz", **changes)
    with pytest.raises(ValueError, match=message):
        load_policy(tmp_path / "p.npz")


def test_a_truncated_or_altered_file_is_refused(tmp_path, shipped_policy):
    content = shipped_policy.read_bytes()
    for length in range(0, len(content), len(content) // 20):
        (tmp_path / "p.npz").write_bytes(content[:length])
        with pytest.raises(ValueError, match="does not hold a policy"):
            load_policy(tmp_path / "p.npz")
    altered = bytearray(content)
    with zipfile.ZipFile(shipped_policy) as archive:
        altered[archive.getinfo("weights_0.npy").header_offset + 300] ^= 1
    (tmp_path / "p.npz").write_bytes(altered)
    with pytest.raises(ValueError, match="CRC"):
        load_policy(tmp_path / "p.npz")


def test_a_missing_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "p.npz")


def test_a_file_that_is_none_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"there is no file {tmp_path}/none.npz"):
        load_policy(tmp_path / "none.npz")
    os.mkfifo(tmp_path / "pipe")  # to open it would wait for ever
    for name in ("pipe", "."):
        with pytest.raises(ValueError, match="does not hold a policy: it is no regular file"):
            load_policy(tmp_path / name)


# Policies of TD3: layer normalisation between the layers, tanh after the last


@pytest.fixture
def off_policy(tmp_path):
    """A policy that was saved and loaded, observations, and the actions that training would take."""
    env, config = hgail_envs.make("point"), Config(learner=TD3(), policy_hidden=(16, 8), layer_norm=True)
    noise = np.random.default_rng(0)
    state = start(env, config, 0.1 * noise.normal(size=(100, 6)) + 0.05)
    target = jax.tree.map(
        lambda leaf: np.asarray(leaf) + noise.normal(size=leaf.shape).astype(np.float32), state.learner.target
    )  # unlike the online networks, and with scales and offsets
    state = state.replace(learner=state.learner.replace(target=target))
    observation = 0.2 * noise.normal(size=(50, 6)).astype(np.float32)
    expected = actions(env, config, state, observation)
    save_policy(tmp_path / "td3.npz", from_state("point", env, config, state))
    return load_policy(tmp_path / "td3.npz"), observation, expected


def test_a_policy_of_td3_acts_from_its_file_as_in_training(off_policy, tmp_path):
    policy, observation, expected = off_policy
    assert 0.3 < np.abs(expected).mean() < 0.95
    np.testing.assert_allclose(policy(observation), expected, atol=1e-5)
    np.testing.assert_allclose(policy(jnp.asarray(observation), xp=jnp), expected, atol=1e-5)
    assert policy.squash
    header = json.loads(str(np.load(tmp_path / "td3.npz")["header"]))
    assert (header["activation"], header["squash"], header["layers"]) == ("layer-norm-relu", True, 3)


def test_the_exported_program_of_td3_is_the_policy(off_policy, tmp_path):
    policy, observation, expected = off_policy
    export_policy(tmp_path / "p.mlirbc", policy)
    with ir.Context() as context:
        stablehlo.register_dialect(context)
        program = stablehlo.deserialize_portable_artifact(context, (tmp_path / "p.mlirbc").read_bytes())
        for seen, wanted in zip(observation[:5], expected[:5], strict=True):
            (action,) = stablehlo.eval_module(program, [ir.DenseElementsAttr.get(seen)])
            np.testing.assert_allclose(np.array(action), wanted, atol=1e-5)


def test_a_file_without_a_word_on_squashing_is_clipped(tmp_path, shipped_policy):
    """As those of format 2 were before there was another learner."""
    with np.load(shipped_policy) as file:
        content = {name: file[name] for name in file.files}
    header = json.loads(str(content["header"]))
    for name in ("squash", "randomization", "task_options"):
        header.pop(name, None)
    content |= {"header": np.array(json.dumps(header)), "biases_2": content["biases_2"] + np.float32(2.0)}
    np.savez(tmp_path / "old.npz", **content)
    old = load_policy(tmp_path / "old.npz")
    assert not old.squash
    action = old(np.random.default_rng(0).normal(size=(20, 9)) * 0.1)
    np.testing.assert_array_equal(action, np.ones((20, 4)))  # which no tanh of so small a number is


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": {"activation": "layer-norm-tanh"}}, "does not compute"),
        ({"scale_0": np.ones(15, np.float32)}, "layers do not fit"),
        ({"offset_1": np.full(8, np.nan, np.float32)}, "not all of its arrays are finite"),
    ],
)
def test_files_of_td3_that_do_not_fit_together_are_refused(off_policy, tmp_path, changes, message):
    rewrite(tmp_path / "td3.npz", tmp_path / "p.npz", **changes)
    with pytest.raises(ValueError, match=message):
        load_policy(tmp_path / "p.npz")


def test_a_file_of_layer_normalisation_without_its_arrays_is_refused(tmp_path, shipped_policy):
    rewrite(shipped_policy, tmp_path / "p.npz", header={"activation": "layer-norm-relu"})
    with pytest.raises(ValueError, match="scale_0"):
        load_policy(tmp_path / "p.npz")
