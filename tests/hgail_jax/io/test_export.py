"""ONNX files: what onnxruntime computes from them, and what they say of themselves."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import randomize
from hgail_envs.scenes import assets_directory
from hgail_jax import load_policy
from hgail_jax.io.export import check_described, export_onnx
from hgail_jax.policy import MeanPolicy

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

POLICIES = (assets_directory() / "policies").glob("*.npz")
SHIPPED = sorted(path for path in POLICIES if not path.stem.endswith("-camera"))  # which have tests of their own


def exported(policy, path, **more):
    export_onnx(path, policy, **more)
    model = onnx.load(path)
    return model, {prop.key: json.loads(prop.value) for prop in model.metadata_props}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_model_computes_the_policy(path, tmp_path):
    policy = load_policy(path)
    model, _ = exported(policy, tmp_path / "p.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx")
    far = np.random.default_rng(0).normal(size=(10_000, policy.observation_size)) * 4.0  # beyond the clip at 5, too
    observation = (policy.mean + policy.std * far).astype(np.float32)
    (action,) = session.run(None, {"observation": observation})
    np.testing.assert_allclose(action, policy(observation), rtol=0, atol=1e-5)
    for batch in (0, 1, 3):
        assert session.run(None, {"observation": observation[:batch]})[0].shape == (batch, policy.action_size)
    assert (model.ir_version, [(each.domain, each.version) for each in model.opset_import]) == (8, [("", 17)])
    assert [file.name for file in tmp_path.iterdir()] == ["p.onnx"]


DIFFERENT = ("push", "tower")  # the past and the actions on their way are described below


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=() if path.stem in DIFFERENT else pytest.mark.slow) for path in SHIPPED],
    ids=lambda path: path.stem,
)
def test_the_metadata_describe_each_number(path, tmp_path):
    policy = load_policy(path)
    _, metadata = exported(policy, tmp_path / "p.onnx")
    options = {"impl": "c", "substeps": 4}
    env = randomize(hgail_envs.make(policy.task, **policy.task_options | options), policy.randomization)
    rows = metadata["observation"]
    assert [row["index"] for row in rows] == list(range(env.observation_size))
    assert len({row["name"] for row in rows}) == len(rows)
    assert metadata["goal"] == rows[-env.goal_size :]
    assert [(row["low"], row["high"]) for row in metadata["action"]] == [(-1.0, 1.0)] * env.action_size
    assert {row["frame"] for row in rows} - {""} <= set(metadata["frames"])
    assert (metadata["task"], metadata["control_period"]) == (policy.task, env.control_period)
    assert metadata["history"] == metadata["randomization"]["history"] == policy.randomization.history
    assert metadata["versions"]["jax"]
    assert "success" not in metadata
    assert [(row["mean"], row["std"]) for row in rows] == list(
        zip(policy.mean.tolist(), policy.std.tolist(), strict=True)
    )
    state = jax.jit(env.reset)(jax.random.key(0))
    position = [row["index"] for row in rows if row["name"] in [f"target position {axis}" for axis in "xyz"]]
    np.testing.assert_array_equal(np.asarray(state.obs)[position], state.info["desired_goal"][:3])
    # as docs/real-robot.md has them; slide's is Gymnasium-Robotics'
    starts = {"push": (1.363, 0.749, 0.416), "slide": (1.013, 0.749, 0.4155)}
    start = starts.get(policy.task, (1.342, 0.749, 0.535))
    np.testing.assert_allclose(metadata["start"] + [metadata["table_height"]], [*start, 0.4], atol=7e-4)
    assert metadata["robot"] == "fetch"


def knowing(task):
    """Returns a policy that knows a delay of two steps and remembers one step, of reach's sizes."""
    sizes, size = Randomization(known_delay=2, history=1), 2 * (1 + 4) + (4 + 6) + 6 + 3
    layer = np.zeros((size, 4), np.float32), np.zeros(4, np.float32)
    return MeanPolicy(task, 3, np.zeros(size, np.float32), np.ones(size, np.float32), (layer,), randomization=sizes)


@pytest.mark.parametrize("task", ["reach", "no_such_module:Task"])
def test_the_actions_on_their_way_are_described(task, tmp_path):
    _, metadata = exported(knowing(task), tmp_path / "p.onnx")
    assert (metadata["known_delay"], metadata["history"]) == (2, 1)
    names = [row["name"] for row in metadata["observation"]]
    assert len(names) == len(set(names)) == 2 * (1 + 4) + (4 + 6) + 6 + 3
    assert [name.endswith("on its way") for name in names] == [True] * 10 + [False] * 19


def test_a_tracked_cube_s_place_is_named(tracking_policy):
    names = [number.name for number in check_described(tracking_policy).features.numbers]
    assert names[8:] == [f"cube position less gripper position {axis}" for axis in "xyz"]


def test_a_policy_of_another_robot_names_it_and_its_start(shipped_policy, tmp_path):
    pytest.importorskip("gymnasium_robotics")
    policy = dataclasses.replace(load_policy(shipped_policy), task_options={"robot": "franka"})
    _, metadata = exported(policy, tmp_path / "p.onnx")
    assert (metadata["robot"], metadata["scale"]) == ("franka", 1.0)
    assert metadata["lowest_height"] == pytest.approx(0.4 + 0.0185 + 0.004)  # the pads' ends are below the gripper
    np.testing.assert_allclose(metadata["start"], [1.344, 0.749, 0.6], atol=1e-3)


def test_success_is_written_if_it_is_known(shipped_policy, tmp_path):
    _, metadata = exported(load_policy(shipped_policy), tmp_path / "p.onnx", success=0.75)
    assert metadata["success"] == 0.75


def test_a_policy_of_another_task_is_written_without_its_code(shipped_policy, tmp_path):
    policy = dataclasses.replace(load_policy(shipped_policy), task="no_such_module:Task")
    _, metadata = exported(policy, tmp_path / "p.onnx")
    assert [row["name"] for row in metadata["goal"]] == ["goal 0", "goal 1", "goal 2"]
    assert "control_period" not in metadata


def test_a_user_s_task_names_its_numbers_if_its_code_may_be_run(shipped_policy, tmp_path):
    policy = dataclasses.replace(load_policy(shipped_policy), task="hgail_envs.tasks.reach:Reach")
    for trusted, name in ((False, "goal 0"), (True, "target position x")):
        _, metadata = exported(policy, tmp_path / f"{trusted}.onnx", trusted=trusted)
        assert metadata["goal"][0]["name"] == name
        assert ("control_period" in metadata) == trusted


def test_a_policy_that_does_not_fit_its_task_writes_nothing(shipped_policy, tmp_path):
    policy = dataclasses.replace(load_policy(shipped_policy), task="push")
    with pytest.raises(ValueError, match="reads 9 numbers, which is no observation of push"):
        export_onnx(tmp_path / "p.onnx", policy)
    assert not list(tmp_path.iterdir())
