"""Exported policies that see pictures: what runtimes compute from them, and what they say of themselves."""

import functools
import json

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.pictures import KINDS
from hgail_jax.cli import export as command
from hgail_jax.io.camera_export import export_camera_onnx, export_camera_policy
from hgail_jax.io.policy import save_policy
from hgail_jax.vision.network import init_eyes
from hgail_jax.vision.policy import CameraPolicy

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


@functools.cache
def policy(cameras=("front", "wrist"), size=18, kind="colour"):
    """An untrained policy for push; the size is odd for its strides."""
    rng = np.random.default_rng(0)
    eyes = init_eyes(jax.random.key(0), len(cameras), 10, (4, 5, 6, 7), (8, 9), (4, 3), KINDS[kind])
    noisy = jax.tree.map(lambda values: np.asarray(values + 0.1 * rng.normal(size=values.shape), np.float32), eyes)
    mean, std, centre = (rng.uniform(0.5, 1.0, count).astype(np.float32) for count in (10, 10, 3))
    return CameraPolicy("push", 4, cameras, size, mean, std, centre, noisy, {"jax": "0"}, look="varied", kind=kind)


def seen(count, which):
    rng = np.random.default_rng(1)
    numbers = which.mean + which.std * rng.normal(size=(count, 10))
    return rng.integers(0, 256, (count, *which.pictures_shape)).astype(np.uint8), numbers.astype(np.float32)


@pytest.mark.parametrize(
    ("cameras", "kind"), [(("front", "wrist"), "colour"), (("side",), "colour"), (("front", "wrist"), "depth")]
)
def test_the_model_computes_the_policy(cameras, kind, tmp_path):
    which = policy(cameras, kind=kind)
    export_camera_onnx(tmp_path / "p.onnx", which)
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx")
    pictures, numbers = seen(5, which)
    given = {camera: pictures[:, index] for index, camera in enumerate(cameras)} | {"numbers": numbers}
    (action,) = session.run(None, given)
    assert np.ptp(action, axis=0).min() > 1e-3
    np.testing.assert_allclose(action, which(pictures, numbers), atol=1e-5)
    assert {each.name: (each.type, each.shape[1:]) for each in session.get_inputs()} == {
        **{camera: ("tensor(uint8)", [18, 18, KINDS[kind]]) for camera in cameras},
        "numbers": ("tensor(float)", [10]),
    }


@pytest.mark.parametrize("kind", KINDS)
def test_the_portable_program_computes_the_policy(kind, tmp_path):
    export_camera_policy(tmp_path / "p.mlirbc", policy(kind=kind))
    assert (tmp_path / "p.mlirbc").read_bytes()[:4] == b"ML\xefR"


def test_the_metadata_describe_pictures_and_numbers(tmp_path):
    export_camera_onnx(tmp_path / "p.onnx", policy(), success=0.5)
    model = onnx.load(tmp_path / "p.onnx")
    about = {prop.key: json.loads(prop.value) for prop in model.metadata_props}
    assert about["pictures"] | {"cameras": 0} == {
        "cameras": 0,
        "size": 18,
        "colours": "red, green, blue",
        "rows": "the upper first",
        "range": [0, 255],
    }
    front, wrist = about["pictures"]["cameras"]
    assert (front["name"], front["body"], front["position"], front["fovy"]) == (
        "front",
        "world",
        [2.15, 0.75, 0.95],
        45,
    )
    assert front["intrinsics"]["fx"] == pytest.approx(9.0 / np.tan(np.deg2rad(22.5)))
    assert (wrist["name"], wrist["body"]) == ("wrist", "gripper")
    names = [row["name"] for row in about["numbers"]]
    assert names[:7] == [*(f"gripper {what} {axis}" for what in ("position", "velocity") for axis in "xyz"), names[6]]
    assert names[6:9] == [f"target position {axis}" for axis in "xyz"] and about["goal"] == about["numbers"][-4:]
    assert [(row["mean"], row["std"]) for row in about["numbers"]] == list(
        zip(policy().mean.tolist(), policy().std.tolist(), strict=True)
    )
    assert (about["task"], about["success"], about["look"], about["robot"]) == ("push", 0.5, "varied", "fetch")
    assert about["control_period"] == hgail_envs.make("push").control_period


def test_the_metadata_of_depth_say_what_is_black_and_white_in_metres(tmp_path):
    export_camera_onnx(tmp_path / "p.onnx", policy(kind="depth"))
    about = {prop.key: json.loads(prop.value) for prop in onnx.load(tmp_path / "p.onnx").metadata_props}
    assert about["pictures"] | {"cameras": 0} == {
        "cameras": 0,
        "size": 18,
        "kind": "depth: distance from the camera's plane, white where none was measured",
        "metres": [0.0, 1.6],
        "rows": "the upper first",
        "range": [0, 255],
    }


def test_a_policy_that_sees_the_target_describes_no_goal(tmp_path):
    eyes = init_eyes(jax.random.key(0), 1, 6, (4, 4, 4, 4), (8,), (4, 6))
    ones = np.ones(6, np.float32)
    which = CameraPolicy("push", 0, ("front",), 16, ones, ones, ones, jax.tree.map(np.asarray, eyes))
    export_camera_onnx(tmp_path / "p.onnx", which)
    about = {prop.key: json.loads(prop.value) for prop in onnx.load(tmp_path / "p.onnx").metadata_props}
    assert (len(about["numbers"]), about["goal"], about["target"]) == (6, [], "seen")


@pytest.mark.parametrize("ending", ["onnx", "mlirbc", "npz"])
def test_the_command_writes_each_format(ending, tmp_path, capsys):
    save_policy(tmp_path / "p.npz", policy())
    out = tmp_path / f"out.{ending}"
    command.main(["--policy", str(tmp_path / "p.npz"), "--out", str(out), "--episodes", "0"])
    assert out.exists() and str(out.name) in capsys.readouterr().out
