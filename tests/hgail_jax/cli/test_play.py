import ctypes.util
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import envs
from envs._platform import headless_backend
from hgail_jax.cli import play
from hgail_jax.io.policy import load_policy
from hgail_jax.playback import Stage


def test_the_policy_that_is_shipped_grasps_and_lifts(grasp_policy):
    env = envs.make("grasp", impl="jax")
    stage = Stage(env, load_policy(grasp_policy), seed=0)
    heights = [stage.data.body("cube").xpos[2] for _ in stage.play(1)]
    assert stage.outcomes == [True]
    assert len(heights) == env.episode_length + env.probe_length + 10
    assert heights[0] == pytest.approx(0.425, abs=1e-3)
    assert heights[-1] > 0.6
    start = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 1)[0])
    np.testing.assert_allclose(stage.model.site("target").pos, start.info["desired_goal"][:3], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--task", "point"], "has no scene to show"),
        (["--task", "poke"], "unknown task 'poke'"),
        (["--policy", "none.npz"], "none.npz"),
        (["--episodes", "many"], "invalid literal for int()"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        play.main(arguments)
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    with pytest.raises(SystemExit) as exit_info:
        play.main(["--task", "grasp", "--policy", str(shipped_policy)])
    assert exit_info.value.code == 2
    assert "the policy is for 'reach'" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["play", "transfer"])
def test_without_a_display_mujoco_renders_with_what_is_there(module):
    backend = headless_backend(ctypes.util.find_library)
    if sys.platform != "linux" or backend is None:
        pytest.skip("neither EGL nor OSMesa")
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    code = f"import {module}; from mujoco import gl_context; print(gl_context.GLContext.__module__)"
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    printed = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert f"mujoco.{backend}" in printed.stdout
