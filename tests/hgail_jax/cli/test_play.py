import contextlib
import dataclasses
import os
import sys
from pathlib import Path

import imageio
import jax
import mujoco
import numpy as np
import pytest
from PIL import Image

import hgail_envs
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import randomize
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import KINDS, Pictures
from hgail_jax.cli import play, policies
from hgail_jax.io.policy import load_policy, save_policy
from hgail_jax.play.playback import caption, film, frames
from hgail_jax.play.playback import play as play_episodes
from hgail_jax.play.session import Session
from tests.hgail_jax.test_terminal import Terminal
from tests.support import ROOT
from tests.support import refused as refused_by

REACH = "hgail_envs.tasks.reach:Reach"

PLAYED = "reach, grasp, push, pick-and-place, slide, stack, tower"
"""Tasks whose policies come with the package."""


def test_the_policy_that_is_shipped_grasps_and_lifts(grasp_policy):
    env = hgail_envs.make("grasp")
    session = Session(env, load_policy(grasp_policy), seed=0)
    heights = [session.data.body("cube").xpos[2] for _ in play_episodes(session, 1)]
    assert session.outcomes == [True]
    assert len(heights) == env.episode_length + env.lift_test_steps + 15
    assert heights[0] == pytest.approx(0.425, abs=1e-3)
    assert heights[-1] > 0.6
    start = jax.jit(env.reset)(jax.random.split(jax.random.key(0))[1])
    np.testing.assert_allclose(session.model.site("target").pos, start.info["desired_goal"][:3], atol=1e-6)


def test_a_film_is_written_and_nothing_else(tmp_path, monkeypatch, capsys, rendering):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("hgail_jax.play.playback._SIZE", (48, 64))  # where there is no GPU, large pictures take long
    monkeypatch.setattr(hgail_envs.find_class("reach"), "episode_length", 20)
    play.main(["--task", "reach", "--episodes", "1"])
    assert [path.name for path in tmp_path.iterdir()] == ["reach.mp4"]
    with imageio.get_reader("reach.mp4", format="FFMPEG") as written:
        assert written.get_meta_data()["size"] == (64, 48)
        assert written.count_frames() == 20 + 15
    shown = capsys.readouterr()
    assert shown.out.splitlines()[1:] == ["reach.mp4", "1 of 1 episodes succeeded"]
    assert shown.err == "compiling and filming ...\n"


@pytest.mark.parametrize(("threshold", "colour"), [(0.05, (0, 158, 115)), (0.0, (213, 94, 0))])
def test_the_edge_of_the_last_pose_shows_the_success(monkeypatch, shipped_policy, threshold, colour):
    env, pictures, steps = hgail_envs.make("reach"), [], 20 if threshold else 2
    monkeypatch.setattr(env, "success_threshold", threshold)
    monkeypatch.setattr(env, "episode_length", steps)
    monkeypatch.setattr("hgail_jax.play.playback.open_renderer", lambda *_: contextlib.nullcontext(BlackPictures()))
    monkeypatch.setattr("hgail_jax.play.playback.open_film", lambda *_: contextlib.nullcontext(pictures.append))
    assert film(Path("film.mp4"), env, load_policy(shipped_policy), episodes=2) == [threshold > 0] * 2
    episode = [False] * steps + [True] * 15
    for at in ((0, 0), (47, 63), (7, 32), (24, 56)):  # a picture is 48 by 64, the edge 8 wide
        on_the_edge = [bool((picture[at] == colour).all()) for picture in pictures]
        assert on_the_edge == [*episode, *episode]
    assert not any((picture[8:-8, 8:-8] == colour).all(axis=-1).any() for picture in pictures)


@pytest.mark.parametrize(
    "kind", ["depth", *(pytest.param(kind, marks=pytest.mark.slow) for kind in {*KINDS} - {"depth"})]
)
def test_a_film_shows_what_the_policy_sees(kind, monkeypatch, tmp_path, rendering):
    env = hgail_envs.make("push")
    env = CameraEnv(env, Pictures(env, ["front", "side"], 64, target="seen", kind=kind))
    env.episode_length = 3  # where there is no GPU, pictures take long
    monkeypatch.setattr("hgail_jax.play.playback._HOLD", 1)
    frames, seen = [], []
    monkeypatch.setattr("hgail_jax.play.playback.open_film", lambda *_: contextlib.nullcontext(frames.append))
    see = Session.seen.fget
    monkeypatch.setattr(Session, "seen", property(lambda session: seen.append(see(session)) or seen[-1]))
    film(tmp_path / "f.mp4", env, lambda _: np.zeros(4), episodes=1)
    assert len(frames) == len(seen) > env.episode_length and seen[0].std() > 10.0
    for frame, pictures in zip(frames, seen, strict=True):
        for camera, top in enumerate((480 - 8 - 2 * 130, 480 - 8 - 130)):
            inset = frame[top + 1 : top + 129, 9 : 9 + 128]
            np.testing.assert_array_equal(inset[::2, ::2], pictures[camera])
            np.testing.assert_array_equal(inset[1::2, 1::2], pictures[camera])


def test_pictures_say_the_time_and_the_distance_and_show_the_zone_of_success(monkeypatch, shipped_policy):
    shown, said, distances = BlackPictures(), [], []
    monkeypatch.setattr("hgail_jax.play.playback.open_renderer", lambda *_: contextlib.nullcontext(shown))
    session = Session(hgail_envs.make("reach", impl="c"), load_policy(shipped_policy))
    for _ in frames(session, 1, 48, 64):
        said.append(caption(session))
        distances.append(np.linalg.norm(session.data.site("grip").xpos - session.target))
        zone = shown.scene.geoms[0]
        assert shown.scene.ngeom == 1 and zone.size[0] == pytest.approx(0.05)
        np.testing.assert_allclose(zone.pos, session.target, atol=1e-6)
    times = [f"{0.04 * step:.1f} s, {100 * distances[step]:.1f} cm" for step in range(50)]
    assert said == [*times, *["success"] * 15]


def test_a_policy_of_another_robot_is_said_to_be_one(shipped_policy, monkeypatch, capsys):
    policy = load_policy(shipped_policy)
    monkeypatch.setattr(play, "make_task", lambda *_, **physics: physics)
    assert play._load("reach", shipped_policy, "none", robot="so101")[0] == {"robot": "so101"}
    assert capsys.readouterr().out.endswith(", trained on fetch, here on so101, nominal\n")
    assert policies.describe_policy(shipped_policy, policy, None, "so101").endswith(
        ", trained on fetch, here on so101, nominal"
    )
    assert policies.describe_policy(shipped_policy, policy, None, "fetch") == policies.describe_policy(
        shipped_policy, policy, None
    )


OF_ITS_OWN = Randomization(delay=(0, 2), history=1)


@pytest.mark.parametrize(
    ("trained", "level", "printed"),
    [
        (LEVELS["none"], None, "nominal"),
        (LEVELS["none"], "mild", "randomised: mild (trained without)"),
        (LEVELS["full-history"], None, "randomised: full-history"),
        (LEVELS["full-history"], "none", "nominal"),
        (LEVELS["mild-history"], "full", "randomised: full, shown the past as in its training"),
        (LEVELS["full-history"], "full-known-delay", "randomised: full-known-delay, shown the past as in its training"),
        (LEVELS["full-known-delay"], "full-known-delay", "randomised: full-known-delay"),
        (OF_ITS_OWN, None, "randomised: as in its training"),
        (OF_ITS_OWN, "full", "randomised: full, shown the past as in its training"),
    ],
)
def test_the_policy_s_file_and_the_randomisation_are_printed(
    trained, level, printed, in_folder, shipped_policy, capsys
):
    policy, size = load_policy(shipped_policy), randomize(hgail_envs.make("reach"), trained).observation_size
    first, *others = policy.layers
    layers = ((np.zeros((size, first[1].size), np.float32), first[1]), *others)
    normalisation = {"mean": np.zeros(size, np.float32), "std": np.ones(size, np.float32)}
    save_policy("mine.npz", dataclasses.replace(policy, layers=layers, randomization=trained, **normalisation))
    path = Path("mine.npz") if level else in_folder / "mine.npz"
    play._load("reach", path, level)
    assert capsys.readouterr().out == f"policy mine.npz, {printed}\n"


def test_the_file_of_a_policy_from_elsewhere_is_printed_as_it_is(in_folder, shipped_policy, capsys):
    play._load("reach", None, None)
    assert capsys.readouterr().out == f"policy {shipped_policy}, nominal\n"


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_the_package_has_a_policy_of_its_own_for_each_task_that_it_plays(task):
    env, policy = play._load(task, None, None)
    assert policy.task == task
    assert policy.action_size == env.action_size


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--seed", "-1"], "seed is -1; it must be at least 0"),
        (["--task", "point"], f"task 'point' has no scene to show; choose from {PLAYED}\n"),
        (["--task", "point", "--web"], f"task 'point' has no scene to show; choose from {PLAYED}\n"),
        (["--task", "point", "--out", "none/film.mp4"], "task 'point' has no scene to show; choose from"),
        (
            ["--task", "point", "--policy", "mine.npz"],
            f"mine.npz plays no other; without --policy choose from {PLAYED}",
        ),
        (["--task", "poke"], "unknown task 'poke'"),
        (["--policy", "none.npz"], "hgail play: there is no file or folder none.npz"),
        (["--episodes", "many"], "--episodes INT: invalid literal for int() with base 10: 'many'"),
        (["--task", REACH], f"no policy of {REACH} comes with the package; name one by --policy"),
        (["--out", "film.avi"], "film.avi has an unknown format; it must end in .mp4, .gif, .webp"),
        (["--web", "--out", "film.mp4"], "--web writes no film"),
        (["--web", "--port", "0"], "port is 0; it must be at least 1"),
        (["--web", "--port", "70000"], "port is 70000; it must be at most 65535"),
        (["--port", "8080"], "--port and --host are for --web"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    refused(arguments, message, capsys)
    assert not list(tmp_path.iterdir())


def refused(arguments, message, capsys, code=2, program=play.main):
    assert refused_by(program, arguments, message, capsys, code).startswith("hgail play: ")


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """A folder to run in, without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    return tmp_path


def test_a_film_that_is_there_is_kept(in_folder, capsys, monkeypatch):
    monkeypatch.setattr(play, "find_policies", None)  # which is slow, and what follows slower
    (in_folder / "mine.gif").write_text("kept")
    refused(["--task", "reach", "--out", "mine.gif"], "mine.gif exists already; name another file", capsys)
    assert (in_folder / "mine.gif").read_text() == "kept"


def test_a_film_without_a_name_takes_the_next_that_is_free(shipped_policy, in_folder, monkeypatch):
    played = []
    monkeypatch.setattr(play, "film", lambda path, *_: played.append(path.name) or path.touch() or [])
    (in_folder / "reach-3.mp4").symlink_to("nowhere")
    for _ in range(3):
        play.main(["--policy", str(shipped_policy)])
    assert played == ["reach.mp4", "reach-2.mp4", "reach-4.mp4"]


def test_a_policy_that_is_no_regular_file_is_refused(in_folder, capsys):
    os.mkfifo(in_folder / "pipe.npz")
    (in_folder / "folder.npz").mkdir()
    for name in ("pipe.npz", "folder.npz"):
        refused(["--policy", name], f"{name} does not hold a policy: it is no regular file", capsys)


@pytest.mark.parametrize(
    ("environment", "options", "message"),
    [
        pytest.param(
            {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "none"},
            ["--out", "x.mp4"],
            "cannot render",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"DISPLAY": ":97"},
            ["--out", "x.mp4"],
            "cannot render on DISPLAY=:97; set MUJOCO_GL=egl or",
            marks=pytest.mark.slow,
        ),
        ({"DISPLAY": ":97"}, [], "no window opens on DISPLAY=:97; --out writes a film, --web serves a page"),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="DISPLAY and MUJOCO_GL are of Linux")
def test_where_nothing_can_be_shown_one_line_says_why(environment, options, message, forks):
    words = ["play", "--task", "reach", "--episodes", "1", *options]
    ended = forks.run(f"from hgail_jax.cli import main; main({words})", {"MUJOCO_GL": None} | environment)
    assert ended.returncode == 1
    (line,) = [line for line in ended.stderr.splitlines() if line != "compiling and filming ..."]
    assert line.startswith("hgail play: ")
    assert message in line
    assert not list(ended.folder.iterdir())


USERS_REACH = """
from hgail_envs.tasks.reach import Reach

class Near(Reach):
    episode_length = 3
"""


@pytest.mark.slow
def test_a_user_s_task_is_played(in_folder, shipped_policy, capsys, monkeypatch, rendering):
    monkeypatch.syspath_prepend(in_folder)
    monkeypatch.setattr("hgail_jax.play.playback._SIZE", (48, 64))
    (in_folder / "my_reach.py").write_text(USERS_REACH)
    policy = dataclasses.replace(load_policy(shipped_policy), task="my_reach:Near")
    save_policy("near.npz", policy)
    play.main(["--task", "my_reach:Near", "--policy", "near.npz", "--episodes", "1", "--out", "near.webp"])
    assert capsys.readouterr().out.splitlines()[:2] == ["policy near.npz, nominal", "near.webp"]
    with Image.open(in_folder / "near.webp") as written:
        assert written.size == (64, 48)
        assert written.n_frames > 1


class BlackPictures:
    """A renderer that shows nothing, and needs no GL."""

    def __init__(self):
        self.scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), 10)

    def update_scene(self, *_):
        self.scene.ngeom = 0

    def render(self):
        return np.zeros((48, 64, 3), np.uint8)


def test_a_terminal_shows_how_far_the_film_is(in_folder, shipped_policy, monkeypatch):
    monkeypatch.syspath_prepend(in_folder)
    (in_folder / "one_more_reach.py").write_text(USERS_REACH)
    monkeypatch.setattr("hgail_jax.play.playback.open_renderer", lambda *_: contextlib.nullcontext(BlackPictures()))
    monkeypatch.setattr(sys, "stderr", Terminal())
    film(in_folder / "near.gif", hgail_envs.make("one_more_reach:Near"), load_policy(shipped_policy), episodes=2)
    frames = sys.stderr.frames()
    pictures = 2 * (3 + 15)  # episodes with their ends held
    filmed = [frame.split(", ")[1] for frame in frames if frame.startswith("filming")]
    assert list(dict.fromkeys(filmed)) == [f"picture {number} of {pictures}" for number in range(1, pictures + 1)]
    assert frames[0].startswith("compiling and filming, 00:00 elapsed")
    assert frames[-1].startswith("writing near.gif")
    assert max(map(len, frames)) < 80


def test_without_a_task_a_policy_is_played_on_its_own(shipped_policy, in_folder, capsys, monkeypatch):
    played = []

    def note(path, env, *_):
        played.append((path.name, type(env).__name__))
        return []

    monkeypatch.setattr(play, "film", note)
    play.main(["--policy", str(shipped_policy)])
    play.main(["--policy", str(shipped_policy), "--task", "reach"])
    play.main([])
    assert played == [("reach.mp4", "Reach"), ("reach.mp4", "Reach"), ("grasp.mp4", "Grasp")]
    policy = load_policy(shipped_policy)
    capsys.readouterr()
    monkeypatch.syspath_prepend(in_folder)
    (in_folder / "evil.py").write_text("raise SystemExit('the file has run code')")
    for task in ("poke", "evil:Near"):
        save_policy("other.npz", dataclasses.replace(policy, task=task))
        refused(
            ["--policy", "other.npz"],
            f"other.npz was trained on '{task}', which is none of this package; name a task of your own by --task",
            capsys,
        )
    save_policy("other.npz", dataclasses.replace(policy, task=""))
    refused(["--policy", "other.npz"], "other.npz does not hold a policy: it names no task", capsys)


def test_help_says_which_task_is_played(capsys):
    with pytest.raises(SystemExit):
        play.main(["--help"])
    assert "(default: the task of --policy, or grasp)" in " ".join(capsys.readouterr().out.split())


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    line = "the policy is for 'reach', not for 'grasp': the policy reads 9 numbers; observations of grasp have 12\n"
    refused(["--task", "grasp", "--policy", str(shipped_policy)], line, capsys)


def test_a_policy_of_a_task_that_got_another_name_is_played(shipped_policy, in_folder, capsys):
    save_policy("old.npz", dataclasses.replace(load_policy(shipped_policy), task="old_file:Near"))
    env, policy = play._load(REACH, Path("old.npz"), None)
    assert (type(env).__name__, policy.task) == ("Reach", REACH)
    assert capsys.readouterr().err == f"old.npz was trained on old_file:Near; --task makes it {REACH}\n"
    play._load(REACH, shipped_policy, None)
    capsys.readouterr()
    save_policy("goal.npz", dataclasses.replace(load_policy(shipped_policy), goal_size=4))
    refused(["--policy", "goal.npz"], "the policy has goals of 4 numbers; goals of reach have 3", capsys)


def test_copies_of_a_run_s_policies_are_no_seeds(in_folder):
    for name in ("seed-10", "seed-2", "seed-2 copy", "best"):
        (in_folder / f"{name}.npz").touch()
    assert [path.stem for path in policies.policy_files(in_folder)] == ["seed-2", "seed-10"]


def official_policy(path, **task_options):
    """A policy that stands still, of push's 25 numbers and 4 of its goal."""
    layers = ((np.zeros((29, 4), np.float32), np.zeros(4, np.float32)),)
    sizes = {"mean": np.zeros(29, np.float32), "std": np.ones(29, np.float32)}
    push = load_policy(ROOT / "assets" / "policies" / "push.npz")
    save_policy(path, dataclasses.replace(push, layers=layers, task_options=task_options, **sizes))


def test_a_policy_of_another_observation_is_refused(in_folder, capsys):
    official_policy("official.npz")
    numbers = "the policy reads 29 numbers; observations of push have 19"
    refused(["--policy", "official.npz"], numbers, capsys)


def test_a_policy_is_played_with_the_task_options_it_was_trained_with(in_folder):
    official_policy("official.npz", observation="official")
    env, policy = play._load("push", Path("official.npz"), None)
    assert env.observation == "official"
    assert policy.task_options == {"observation": "official"}


def test_a_policy_of_the_package_goes_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (named,) = policies.policy_files(Path("reach-robust"))
    assert named.samefile(ROOT / "assets" / "policies" / "reach-robust.npz")
    with pytest.raises(FileNotFoundError, match="nor a policy of that name in the package"):
        policies.policy_files(Path("policies/reach"))
    (tmp_path / "reach-robust").write_text("this folder's comes first")
    assert policies.policy_files(Path("reach-robust")) == [Path("reach-robust")]


@pytest.mark.parametrize(
    ("files", "level", "expected"),
    [
        (("reach", "reach-robust"), None, "reach"),
        (("reach", "reach-robust"), "none", "reach"),
        (("reach", "reach-robust"), "mild", "reach-robust"),
        (("reach", "reach-robust", "reach-mild"), "mild", "reach-mild"),
        (("reach", "reach-mild"), "full", "reach"),
        ((), "mild", None),
    ],
)
def test_randomised_episodes_are_played_with_the_policy_of_their_level_else_the_robust_one(
    files, level, expected, tmp_path, monkeypatch
):
    monkeypatch.setattr(policies, "assets_directory", lambda: tmp_path)
    (tmp_path / "policies").mkdir()
    for file in files:
        (tmp_path / "policies" / f"{file}.npz").touch()
    path = policies.shipped("reach", level)
    assert (path and path.stem) == expected


def test_the_page_is_given_the_command_s_options(monkeypatch, in_folder):
    web, given = pytest.importorskip("hgail_jax.play.page"), []

    class Page:
        port = 8099

        def __init__(self, open_session, tasks, *numbers):
            given.extend([tasks[0], *numbers, open_session("reach", 7)])

        def run(self):
            assert not list(in_folder.iterdir())

    monkeypatch.setattr(web, "Page", Page)
    monkeypatch.setattr(web, "free_port", lambda host, port, first: port)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr("hgail_jax.play.session.Session", lambda env, policy, seed: (env.randomization.delay, seed))
    words = ["--web", "--task", "reach", "--randomize", "mild"]
    play.main([*words, "--seed", "5", "--host", "0.0.0.0", "--port", "8099"])
    assert given == ["reach", 5, "0.0.0.0", 8099, (LEVELS["mild"].delay, 7)]


@pytest.mark.parametrize("program", ["film", "show"])
def test_films_and_the_viewer_are_given_episodes_and_seed(monkeypatch, in_folder, program):
    given = []
    monkeypatch.setattr(play, program, lambda *words: given.extend(words[-2:]) or [True])
    monkeypatch.setenv("DISPLAY", ":0" if program == "show" else "")
    play.main(["--task", "reach", "--episodes", "2", "--seed", "5"])
    assert given == [2, 5]
