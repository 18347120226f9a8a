import csv
import dataclasses
import json
import shlex
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from hgail_envs.engines.c import usable_cores
from hgail_envs.randomization import LEVELS
from hgail_envs.scenes import assets_directory
from hgail_jax import TrainOptions, load_policy
from hgail_jax.cli import train as run
from hgail_jax.config import REWARDS, STRATEGIES
from hgail_jax.trainer.checkpoint import Checkpoints
from hgail_jax.trainer.folder import RunFolder
from hgail_jax.trainer.train_options import plan
from tests.hgail_jax.trainer.test_checkpoint import saved_in
from tests.support import compile_once, make_runs_tiny, refused

TINY = ["--seeds", "2", "--num-envs", "2", "--rounds", "1"]


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with pytest.MonkeyPatch.context() as patch:
        make_runs_tiny(patch)
        compile_once(patch)
        yield


@pytest.fixture(scope="module")
def reach_run(tmp_path_factory):
    """A tiny run of the real thing; its film is only asked for."""
    folder = tmp_path_factory.mktemp("runs") / "reach"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "film", lambda path, *shown: path.write_text(repr([type(one).__name__ for one in shown])))
        run.main([*TINY, "--video", "--out", str(folder)])
    return folder


def test_a_run_writes_everything(reach_run):
    names = {str(path.relative_to(reach_run)) for path in reach_run.rglob("*") if path.is_file()}
    names = {name for name in names if not name.startswith("checkpoints/")}
    policies = {f"policies/seed-{seed}.npz" for seed in range(2)}
    assert names == {".lock", "config.json", "metrics.csv", "summary.json", "curves.png", "rollout.mp4"} | policies
    assert (reach_run / "rollout.mp4").read_text() == "['Reach', 'MeanPolicy']"
    assert (reach_run / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert saved_in(reach_run) == [1, 2]


def test_summary_says_what_was_reached_and_what_made_it(reach_run):
    summary = json.loads((reach_run / "summary.json").read_text())
    assert (summary["task"], summary["method"], summary["seeds"]) == ("reach", "hgail", 2)
    for key in ("success_rate", "success_rate_l1", "distance_l1", "distance_l2"):
        assert len(summary[key]["per_seed"]) == 2
        assert summary[key]["mean"] == pytest.approx(np.mean(summary[key]["per_seed"]))
        assert summary[key]["std"] == pytest.approx(np.std(summary[key]["per_seed"]))
    assert summary["env_steps_per_seed"] == 4 * 2 * 50  # pre-training and three phases of one round
    assert summary["diverged_seeds"] == []
    assert set(summary["wall_seconds"]) >= {"compile", "train", "total"}
    assert summary["env_steps_per_second"] > 0
    assert summary["evaluation_episodes_per_seed"] == 8
    assert summary["device"]["platform"] == "cpu"
    assert summary["cpu_cores"] == usable_cores()
    assert summary["versions"]["mujoco"] == summary["versions"]["mujoco-mjx"] == mujoco.__version__


def test_metrics_have_a_row_per_seed_and_round(reach_run):
    with (reach_run / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["round"], row["env_steps"]) for row in rows] == [
        ("0", "0", "100"),
        ("1", "0", "100"),
        ("0", "1", "400"),
        ("1", "1", "400"),
    ]
    for row in rows:
        assert 0 <= float(row["success_rate"]) <= 1
        assert 0 < float(row["distance_l2"]) <= float(row["distance_l1"])
    assert rows[0]["reward"] == ""  # no policy phase in round 0
    assert float(rows[2]["reward"]) > 0
    assert {row["diverged_rate"] for row in rows} == {row["dropped_rate"] for row in rows} == {"0.0"}


def test_the_same_command_writes_the_same_numbers_and_a_film_that_cannot_be_made_costs_no_result(
    reach_run, in_folder, capsys, monkeypatch
):
    def refuse(*arguments):
        raise RuntimeError("MuJoCo cannot render here")

    monkeypatch.setattr(run, "film", refuse)
    run.main([*TINY, "--video", "--out", "again"])
    assert capsys.readouterr().err.splitlines()[-1] == "no video: MuJoCo cannot render here"
    assert Path("again/summary.json").exists()

    def rows(folder):
        with (folder / "metrics.csv").open() as file:
            return [row | {"seconds": ""} for row in csv.DictReader(file)]

    assert rows(Path("again")) == rows(reach_run)


def test_policies_can_be_loaded(reach_run):
    action = load_policy(reach_run / "policies" / "seed-1.npz")(np.zeros((5, 9)))
    assert action.shape == (5, 4)
    assert (np.abs(action) <= 1).all()


def test_folders_are_numbered(in_folder, monkeypatch):
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    run.main(["--task", "point", *TINY])
    run.main(["--task", "point", "--method", "hgail-no", *TINY])
    run.main(["--task", "point", *TINY])
    assert {path.name for path in Path("runs").iterdir()} == {"point-hgail-1", "point-hgail-no-1", "point-hgail-2"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "poke"], "unknown task 'poke'; choose from point, reach"),
        (["--seeds", "-1"], "seeds is -1; it must be at least 1"),
        (["--num-envs", "-4"], "num_envs is -4; it must be at least 1"),
        (["--rounds", "-1"], "rounds is -1; it must be at least 0"),
        (["--p-ht", "1.5"], "p_ht is 1.5; it must be from 0 to 1"),
        (["--method", "ppo", "--p-ht", "0.5"], "--p-ht changes nothing for the method ppo"),
        (
            ["--method", "gcsl", "--no-standardize-reward"],
            "--no-standardize-reward changes nothing for the method gcsl",
        ),
        (["--method", "ppo", "--no-pretrain"], "--no-pretrain changes nothing for the method ppo"),
        (["--method", "hgail-no", "--strategy", "final"], "--strategy changes nothing where p_ht is 0"),
        (["--p-ht", "0", "--strategy", "final"], "--strategy changes nothing where p_ht is 0"),
        (["--p-ht", "nan"], "p_ht is nan; it must be from 0 to 1"),
        (["--substeps", "3"], "substeps is 3; it must be at least 4"),
        (["--substeps", "0"], "substeps is 0; it must be at least 4"),
        (["--impl", "warp"], "impl 'warp' needs warp-lang and an NVIDIA GPU"),
        (
            ["--method", "gasil", "--learner", "td3", "--environment-reward", "1"],
            "with which the discriminator has no say: that is the method her",
        ),
        (
            ["--learner", "td3", "--num-envs", "20000"],
            "num_envs, within buffer_episodes (--settings), is 20000; it must be at most 8192",
        ),
        (["--settings", "taus=1"], "Config has no field 'taus', nor has the learner ppo"),
        (["--settings", "rounds=1"], "setting 'rounds=1': rounds is --rounds here"),
        (["--settings", "tau"], "setting 'tau' is not name=value with a number, true, false or a list of numbers"),
        (["--settings", "tau=0.5"], "Config has no field 'tau', nor has the learner ppo"),
        (["--learner", "td3", "--settings", "goal_jitter=1"], "changes nothing for the method her, which has no"),
        (["--task", "push", "--settings", "shuffled_goals=2"], "shuffled_goals is 2; it must be from 0 to 1"),
        (["--bc-weight", "-1"], "bc_weight is -1.0; it must be at least 0"),
        (["--exploration-noise", "0"], "exploration_noise is 0.0; it must be positive"),
        (["--exploration-noise", "1", "2"], "exploration_noise is (1.0, 2.0); it must be one number or 4"),
        (["--task-options", "height"], "task option 'height' is not name=value"),
        (["--task-options", "height=[1]"], "task option 'height=[1]' is not name=value"),
        (["--task-options", "height=very tall"], "task option 'height=very tall' is not name=value"),
        (["--task-options", "height=tall"], "no option 'height'; it takes impl, substeps, worlds"),
        (
            ["--task", "push", "--task-options", "observation=whole"],
            "observation is 'whole'; choose from compact, official",
        ),
        (["--task", "point", "--video"], "task 'point' has no scene to film; leave out --video"),
        (["--evaluate-every", "0"], "evaluate_every is 0; it must be at least 1"),
        (["--task-options", "substeps=5"], "substeps is --substeps here"),
        (["--task-options", "worlds=5"], "worlds follows from the numbers of seeds and environments"),
        (["--task-options", "height=1.5"], "no option 'height'; it takes impl, substeps, worlds"),
        (["--task", "point", "--substeps", "4"], "--substeps and --impl are for the tasks of an arm"),
        (["--task", "point", "--robot", "franka"], "--robot is for the tasks of an arm; 'point' is none"),
        (["--robot", "panda"], "robot is 'panda'; choose from fetch, franka"),
        (["--task-options", "robot=franka"], "robot is --robot here"),
        (["--method", "magic"], "method is 'magic'; choose from hgail, hgail-no"),
        (["--seeds", "many"], "--seeds INT: invalid literal for int() with base 10: 'many'"),
        (["--seed", "8"], "Unrecognized options: --seed, 8; did you mean --first-seed or --seeds?"),
        (["--wind", "8"], "Unrecognized options: --wind, 8\n"),
        (["--first-seed", "-1"], "first_seed is -1; it must be at least 0"),
        (["--first-seed", "2147483640"], "first_seed is 2147483640; it must be at most 2147483639"),
        (["--checkpoint-every", "0"], "checkpoint_every is 0; it must be at least 1"),
        (["--task", ".a:B"], "cannot load task '.a:B'"),
        (["--task", ":"], "unknown task ':'; choose from point, reach"),
        (["--resume", ""], "resume is ''; it must be a run's folder, or auto"),
        (["--logger", "csv,paper"], "logger is 'paper'; choose from csv, tensorboard, wandb"),
        (["--method", "gail-demo", "--demos", "none"], "hgail train: there is no file none"),
        (["--resume", "missing"], "there is no folder missing to resume"),
        (["--resume", "file"], "there is no folder file to resume"),
        (["--resume", "there", "--out", "here"], "--resume and --out exclude each other"),
        (["--out", "there"], "there exists already"),
        (["--out", "file/run"], "cannot make the folder file/run"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(in_folder, capsys, arguments, message):
    Path("there").mkdir()
    Path("file").write_text("")
    assert refused(run.main, arguments, message, capsys).startswith("hgail train: ")
    assert {path.name for path in in_folder.rglob("*")} == {"there", "file"}


def test_double_precision_is_refused_before_anything_begins(in_folder, capsys):
    line = "hgail train: JAX_ENABLE_X64 is set, and training is in float32; unset it\n"
    with jax.enable_x64(True):
        refused(run.main, ["--task", "point", "--seeds", "1"], line, capsys)
    assert not list(in_folder.iterdir())


def test_an_unwritable_folder_is_refused(in_folder, capsys, monkeypatch):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)  # root may write anywhere, so no mode of a folder would do
    refused(run.main, ["--out", "closed/run"], "cannot make the folder closed/run", capsys)


@pytest.mark.parametrize(("seeds", "envs", "said"), [(1, 1, "1 seed × 1 env"), (8, 2, "8 seeds × 2 envs")])
def test_a_run_says_how_large_it_is(in_folder, capsys, monkeypatch, seeds, envs, said):
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    run.main(["--task", "point", "--seeds", str(seeds), "--num-envs", str(envs), "--out", "run"])
    assert capsys.readouterr().out.splitlines()[0] == f"hgail on point, {said} -> run"


def test_a_run_says_which_robot_it_has(in_folder, capsys, monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    run.main(["--task", "reach", "--robot", "franka", "--seeds", "1", "--num-envs", "1", "--out", "run"])
    assert capsys.readouterr().out.splitlines()[0] == "hgail on reach with franka, 1 seed × 1 env -> run"


@pytest.mark.parametrize(
    ("words", "shared"),
    [
        (["--task", "tests.hgail_jax.line:Line"], True),  # for td3
        (["--task", "tests.hgail_jax.test_methods:OwnSizes"], False),
        (["--task", "tests.hgail_jax.test_methods:OwnSizes", "--learner", "td3"], True),
        (["--task", "point", "--preset", "paper"], False),
        (["--task", "tests.hgail_jax.line:Line", "--preset", "paper"], False),  # the preset's settings are for all
        (["--task", "tower", "--learner", "ppo", "--seeds", "1", "--num-envs", "1"], False),
    ],
)
def test_a_run_with_settings_that_were_not_chosen_for_its_task_says_so(in_folder, capsys, monkeypatch, words, shared):
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    run.main([*words, "--out", "run"])
    assert ("has no settings of its own for" in capsys.readouterr().out) == shared


def test_a_student_s_settings_are_its_own(in_folder, capsys, monkeypatch, rendering):
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    teacher = str(assets_directory() / "policies" / "push.npz")
    sizes = ["--seeds", "1", "--num-envs", "1", "--renderer", "opengl"]
    run.main(["--task", "push", "--observe", "camera", "--teacher", teacher, *sizes, "--out", "run"])
    assert "settings of its own" not in capsys.readouterr().out


HANDED_ON = {
    "seeds": (3, lambda run: run.seeds),
    "first_seed": (7, lambda run: run.first_seed),
    "num_envs": (6, lambda run: run.config.num_envs),
    "rounds": (5, lambda run: run.config.rounds),
    "pretrain": (False, lambda run: run.config.learner.pretrain),
    "impl": ("jax", lambda run: run.env.impl),
    "substeps": (7, lambda run: run.env.substeps),
    "randomize": ("mild", lambda run: next(name for name in LEVELS if LEVELS[name] == run.env.randomization)),
    "task_options": (("observation=official",), lambda run: tuple("=".join(one) for one in run.task_options.items())),
    "p_ht": (0.25, lambda run: run.hyperparameters.p_ht),
    "strategy": ("final", lambda run: list(STRATEGIES)[run.hyperparameters.strategy]),
    "reward": ("r3", lambda run: list(REWARDS)[run.hyperparameters.reward]),
    "standardize_reward": (False, lambda run: run.hyperparameters.standardize_reward),
    "environment_reward": (0.75, lambda run: run.hyperparameters.environment_reward),
    "bc_weight": (0.125, lambda run: run.hyperparameters.bc_weight),
    "exploration_noise": ((0.5,), lambda run: (run.hyperparameters.exploration_noise,)),
    "checkpoint_every": (4, lambda run: run.checkpoint_every),
    "evaluate_every": (3, lambda run: run.evaluate_every),
    "evaluation_episodes": (9, lambda run: run.evaluation_episodes),
    "settings": (("discount=0.5",), lambda run: (f"discount={run.hyperparameters.discount}",)),
    "logger": ("tensorboard,csv", lambda run: ",".join(run.loggers)),
}
"""An option's value, which is no default, and where a run has it."""
OF_CAMERA = {"observe", "teacher", "camera", "picture_size", "look", "renderer", "target", "picture_kind"}
ELSEWHERE = {"task", "method", "learner", "preset", "demos", "devices", "out", "resume", "robot"} | OF_CAMERA
"""Options with tests of their own."""


def test_every_option_is_handed_on():
    assert {field.name for field in dataclasses.fields(TrainOptions)} == HANDED_ON.keys() | ELSEWHERE
    others = {"task": "push", "learner": "ppo"}
    plain = plan(TrainOptions(**others), "cpu")
    for name, (value, found) in HANDED_ON.items():
        assert found(plan(TrainOptions(**others, **{name: value}), "cpu")) == value, name
        assert name == "randomize" or found(plain) != value, name


def test_the_robot_is_an_option_of_the_task():
    pytest.importorskip("gymnasium_robotics")
    run = plan(TrainOptions(task="push", robot="franka"), "cpu")
    assert run.task_options == {"robot": run.env.robot.name} == {"robot": "franka"}
    assert plan(TrainOptions(task="push"), "cpu").task_options == {}  # as in runs of before


@pytest.mark.parametrize(
    ("task", "learner", "given", "expected"),
    [
        ("slide", "td3", (), {"achieved": "passed"}),
        ("slide", "td3", ("achieved=at-rest",), {"achieved": "at-rest"}),
        ("grasp", "td3", (), {"cube": "tracked"}),
        ("grasp", "td3", ("cube=at-start",), {"cube": "at-start"}),
        ("grasp", "ppo", (), {}),
    ],
)
def test_a_run_knows_the_options_that_its_task_has_by_default(task, learner, given, expected):
    run = plan(TrainOptions(task=task, learner=learner, task_options=given), "cpu")
    assert run.task_options == expected
    assert {name: getattr(run.env, name) for name in expected} == expected


def test_options_of_several_processes_are_handed_on(in_folder, capsys, monkeypatch):
    joined = []

    def join(*numbers, **options):
        joined.append((numbers, options))
        raise ValueError("nobody answers")

    monkeypatch.setattr(run, "join", join)
    words = ["--coordinator", "here:1", "--num-processes", "3", "--process-id", "2", "--heartbeat-timeout", "7"]
    refused(run.main, [*words, "--distributed", "auto"], "hgail train: nobody answers\n", capsys)
    assert joined == [(("here:1", 3, 2), {"auto": True, "heartbeat_timeout": 7})]
    assert not list(in_folder.iterdir())


@pytest.mark.slow
def test_a_run_promotes_no_ranks_or_types(in_folder):
    """Under settings that forbid it, up to its policies and its curves."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        run.main(["--task", "point", "--seeds", "1", "--num-envs", "3", "--rounds", "1", "--out", "run"])
    assert json.loads(Path("run/summary.json").read_text())["diverged_seeds"] == []
    assert load_policy("run/policies/seed-0.npz")(np.zeros((2, 6))).shape == (2, 3)


@pytest.mark.parametrize(("weight", "batch"), [(None, 512), (0.5, 512), (0.0, 0)])
def test_a_bc_weight_of_0_leaves_the_bc_loss_out(weight, batch):
    """Also of a method that has it by default."""
    prepared = plan(TrainOptions(task="point", method="gcsl", bc_weight=weight), "cpu")
    assert prepared.config.learner.bc_batch == batch
    assert prepared.hyperparameters.bc_weight == (1.0 if weight is None else weight)


def test_an_option_by_its_old_name_is_taken_with_a_line(in_folder, capsys, monkeypatch):
    planned = []
    monkeypatch.setattr(run, "plan", lambda options, platform: planned.append(options) or plan(options, platform))
    monkeypatch.setattr(run, "train_run", lambda *_: None)
    run.main(["--task", "point", "--iterations", "1", "--out", "run"])
    assert planned[0].rounds == 1
    shown = capsys.readouterr()
    assert shown.err == "hgail train: --iterations is --rounds now; the old name goes with the next release\n"
    assert shown.out.endswith("train --task point --rounds 1 --resume run\n")


def test_every_option_has_a_help_line(capsys):
    with pytest.raises(SystemExit):
        run.main(["--help"])
    shown = capsys.readouterr().out
    for option in run.Command.__dataclass_fields__:
        assert f"--{option.replace('_', '-')}" in shown
    assert "(default: reach)" in shown
    assert "None" not in shown
    assert "(default: the task's)" in shown


def test_help_leaves_out_what_changes_nothing_for_the_method(capsys):
    with pytest.raises(SystemExit):
        run.main(["--task", "point", "--method", "ppo", "--help"])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " has --method " in line]
    assert "--exploration-noise" in line and "--p-ht" not in line and "--bc-weight" not in line


def test_help_has_the_settings_of_randomised_episodes(capsys):
    def help_of(*words):
        with pytest.raises(SystemExit):
            run.main(["--task", "push", *words, "--help"])
        return next(line for line in capsys.readouterr().out.splitlines() if " has --method " in line)

    assert "--p-ht 0.8" in help_of() and "--method her --learner td3" in help_of("--randomize", "mild")


def test_help_of_a_task_that_is_not_there_is_the_help(capsys):
    with pytest.raises(SystemExit) as exit_info:
        run.main(["--task", "poke", "--help"])
    assert exit_info.value.code == 0
    assert "--num-envs INT" in capsys.readouterr().out


TASK_WITH_A_MISTAKE = """
import numpy as np
from hgail_envs.point import Point

class Mistaken(Point):
    def step_physics(self, physics, action):
        return physics + np.asarray(action)

class Greedy(Point):
    training = {"ppo": {"cpu": {"num_envs": 4}}}
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Mistaken", "Mistaken.step_physics fails ("),
        ("Greedy", "Greedy.training['ppo']['cpu'] is not TrainingDefaults of fields that there are"),
    ],
)
def test_a_mistake_in_a_user_s_task_is_one_line_and_writes_nothing(in_folder, capsys, monkeypatch, name, message):
    Path("mistaken.py").write_text(TASK_WITH_A_MISTAKE)
    monkeypatch.syspath_prepend(str(in_folder))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    refused(run.main, ["--task", f"mistaken:{name}"], message, capsys)
    assert [path.name for path in in_folder.iterdir()] == ["mistaken.py"]


@pytest.mark.parametrize(
    ("words", "resumed"),
    [
        ([], ["--resume", "my run"]),
        (["--seeds", "2", "--out", "my run", "--no-pretrain"], ["--seeds", "2", "--no-pretrain", "--resume", "my run"]),
        (["--out=other", "--task-options", "a=1", "b=2"], ["--task-options", "a=1", "b=2", "--resume", "my run"]),
        (
            ["--resume", "auto", "--exploration-noise", "1", "2"],
            ["--exploration-noise", "1", "2", "--resume", "my run"],
        ),
        (["--resume=auto"], ["--resume", "my run"]),
    ],
)
def test_a_run_resumes_by_its_own_command_line(words, resumed, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: str(Path(sys.executable).with_name(name)))
    said, command = run._resume_hint(words, Path("my run")).split(": ")
    assert said == "resume with"
    assert shlex.split(command) == ["hgail", "train", *resumed]


@pytest.mark.parametrize("found", [None, "/usr/bin/hgail"])
@pytest.mark.parametrize(
    ("executable", "program"), [("venv/bin/python", "venv/bin/hgail"), ("usr/bin/python", "hgail")]
)
def test_a_run_of_an_environment_that_is_not_activated_resumes_by_its_command(
    in_folder, monkeypatch, executable, program, found
):
    (in_folder / "venv" / "bin").mkdir(parents=True)
    (in_folder / "venv" / "bin" / "hgail").touch()
    monkeypatch.setattr("shutil.which", lambda name: found)
    monkeypatch.setattr(sys, "executable", str(in_folder / executable))
    assert run._resume_hint([], Path("run")) == f"resume with: {program} train --resume run"


@pytest.mark.parametrize(
    ("saved", "said"),
    [
        (None, "stopped before round 0"),
        (1, "stopped after round 0 of 4"),  # as of a resumed run, while its program is compiled
        (5, "stopped after round 4 of 4"),  # as in the final evaluation
    ],
)
def test_a_stopped_run_says_how_far_it_is(saved, said):
    checkpoints = Checkpoints("checkpoints", {})
    checkpoints.saved = saved
    stopped = plan(TrainOptions(task="point", rounds=4), "cpu")
    assert run._stopped(stopped, RunFolder(Path("run"), checkpoints, None)) == said


@pytest.mark.parametrize(
    ("per_seed", "said"),
    [
        ([0.9], "success 0.900, L1 distance"),
        ([0.8, 1.0], "success 0.900 (worst seed 0.800), L1 distance"),
        ([0.8, 0.9, 1.0], "success 0.900 ± 0.248 (worst seed 0.800), L1 distance"),
    ],
)
def test_few_seeds_have_no_interval_and_one_has_no_worst(per_seed, said, tmp_path, capsys):
    measured = {"mean": 0.9, "std": 0.1, "per_seed": per_seed}
    summary = {
        "seeds": len(per_seed),
        "success_rate": measured,
        "distance_l1": measured,
        "wall_seconds": dict.fromkeys(("compile", "train", "evaluation", "total"), 1.0),
        "env_steps_per_seed": 100,
        "env_steps_per_second": 100.0,
        "diverged_seeds": [],
    }
    run._report(summary, tmp_path)
    assert capsys.readouterr().out.startswith(said)
