import imageio
import jax
import numpy as np
import pytest

import envs
from hgail_jax.cli import play
from hgail_jax.io.policy import load_policy
from hgail_jax.playback import Playback


def test_the_policy_that_is_shipped_grasps_and_lifts(grasp_policy):
    env = envs.make("grasp")
    playback = Playback(env, load_policy(grasp_policy), seed=0)
    heights = [playback.data.body("cube").xpos[2] for _ in playback.play(1)]
    assert playback.outcomes == [True]
    assert len(heights) == env.episode_length + env.probe_length + 10
    assert heights[0] == pytest.approx(0.425, abs=1e-3)
    assert heights[-1] > 0.6
    start = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 1)[0])
    np.testing.assert_allclose(playback.model.site("target").pos, start.info["desired_goal"][:3], atol=1e-6)


def test_a_film_is_written_and_nothing_else(tmp_path, monkeypatch, capsys, rendering):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("hgail_jax.playback._SIZE", (48, 64))  # where there is no GPU, large pictures take long
    play.main(["--task", "reach", "--episodes", "1"])
    assert [path.name for path in tmp_path.iterdir()] == ["reach.mp4"]
    with imageio.get_reader("reach.mp4", format="FFMPEG") as film:
        assert film.get_meta_data()["size"] == (64, 48)
        assert film.count_frames() == 50 + 10
    assert capsys.readouterr().out.splitlines()[-2:] == ["reach.mp4", "1 of 1 episodes succeeded"]


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_the_package_has_a_policy_of_its_own_for_each_task_that_it_plays(task):
    env, policy = play._load(play.Options(task=task))
    assert policy.task == task
    assert policy.action_size == env.action_size


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--seed", "-1"], "seed is -1; it must be at least 0"),
        (["--task", "point"], "task 'point' has no scene to show; choose from reach, grasp"),
        (["--task", "poke"], "unknown task 'poke'"),
        (["--policy", "none.npz"], "hgail play: there is no file none.npz"),
        (["--episodes", "many"], "invalid literal for int()"),
        (["--task", "grasp-aperture"], "grasp-aperture.npz"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        play.main(arguments)
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("hgail play: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    with pytest.raises(SystemExit) as exit_info:
        play.main(["--task", "grasp", "--policy", str(shipped_policy)])
    assert exit_info.value.code == 2
    assert "the policy is for 'reach', not for 'grasp'" in capsys.readouterr().err
