"""What `python -m experiments.paper` trains and writes."""

import dataclasses
import json
import shutil
import threading

import numpy as np
import pytest

import hgail_envs
from experiments.paper import __main__ as paper
from experiments.paper import figures, statistics, tables, work
from experiments.paper.off_policy import OFF_POLICY_FIGURE, OFF_POLICY_STUDIES
from experiments.paper.programs import train_program
from experiments.paper.studies import SWEEP
from experiments.paper.study import Study
from experiments.paper.tables import make_rows, write_markdown
from experiments.paper.trials import Scale, hash_json
from experiments.paper.work import Unfinished
from hgail_jax import Demonstrations, env_steps, load_demonstrations, phase_table
from hgail_jax.trainer.loop import Program
from tests.experiments.test_paper_studies import BY_NAME, trials_of

QUICK = ["--quick", "--seeds", "3"]


def read(path):
    """The settings of a study's file."""
    return json.loads(path.read_text())["settings"]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != ".lock"}


def results_of(trials):
    """What training might have given: numbers that follow from the trial's hash."""
    found = []
    for trial in trials:
        rng = np.random.default_rng(int(trial.key(), 16))
        steps = env_steps(hgail_envs.make("point"), trial.config, phase_table(trial.config)).cumsum()
        curve = {name: rng.uniform(size=(len(steps), len(trial.seeds))).tolist() for name in ("success", "distance_l1")}
        names = ("success", "achieved", "success_l1", "distance_l1", "distance_l2")
        seconds = {"compile": 1.0, "train": 6.0, "evaluation": 1.0}
        found.append(
            {
                "curves": curve | {"rounds": list(range(len(steps))), "env_steps": steps.tolist()},
                "final": {name: rng.uniform(size=len(trial.seeds)).tolist() for name in names},
                "diverged_seeds": 0,
                "program": {"settings": len(trials), "seconds": seconds, "dropped": 0.0},
            }
        )
    return found


def made(results, trials, commits=("c0ffee1",), dates=("2026-01-01",)):
    """Results as they are kept: with what they are of and what made them."""
    return [
        result
        | {"identity": trial.identity()}
        | {
            "made_by": {
                "commit": commits[index % len(commits)],
                "date": dates[index % len(dates)],
                "command": "python -m experiments.paper --all",
                "device": {"kind": "a chip"},
                "versions": {"jax": "0.10.2", "warp-lang": None, "driver": "580.1"},
            }
        }
        for index, (result, trial) in enumerate(zip(results, trials, strict=True))
    ]


@pytest.fixture(scope="module", autouse=True)
def few_resamples():
    """Bootstrap intervals have tests of their own; here they need not be fine."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(statistics, "_RESAMPLES", 200)
        yield


@pytest.fixture
def trained(monkeypatch):
    """Stands in for the training; lists what it was asked for."""
    asked = []

    def train(env, trials, demonstrations, folder, stop):
        asked.append([trial.setting.name for trial in trials])
        return results_of(trials)

    monkeypatch.setattr(work, "train_program", train)
    return asked


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    """A folder with table 3; not to be written to."""
    folder = tmp_path_factory.mktemp("table3")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(work, "train_program", lambda env, trials, *others: results_of(trials))
        paper.main([*QUICK, "--table", "3", "--out", str(folder)])
    return folder


@pytest.fixture
def table3(made_once, tmp_path):
    """A folder with table 3."""
    return shutil.copytree(made_once, tmp_path / "paper")


@pytest.mark.slow  # real training; what is trained has stand-ins elsewhere
def test_a_study_by_real_training_resumes_where_it_was_stopped(tmp_path, monkeypatch):
    study, prepared, compiled = BY_NAME["rewards"], [], []
    settings = tuple(dataclasses.replace(setting, steps=1) for setting in study.settings[:4])  # one program
    compile_program = Program.compile

    def compile_once(program):
        if not compiled:
            compiled.append(compile_program(program))
        return compiled[0]

    monkeypatch.setattr(Program, "compile", compile_once)
    monkeypatch.setattr(hgail_envs.find_class("point"), "prepare", lambda env: prepared.append(env))
    monkeypatch.setattr(paper, "STUDIES", (dataclasses.replace(study, settings=settings),))
    paper.main(["--quick", "--figure", "7", "--out", str(tmp_path)])
    rows = read(tmp_path / "rewards-point.json")
    assert [row["setting"] for row in rows] == ["r1", "r2", "r3", "r4"]
    for row in rows:
        assert row["success_rate"] == pytest.approx(np.mean(row["final"]["success"]))
        assert row["distance_l1"] >= row["distance_l2"] > 0
        assert (row["diverged_seeds"], row["program"]["settings"], row["identity"]["seeds"]) == (0, 4, [0, 1])
        assert row["curves"]["env_steps"][-1] == row["env_steps_per_seed"]
        assert len(row["curves"]["rounds"]) == len(row["curves"]["success"]) == 2
    # r4 is r3 by algebra, so nothing but rounding may separate them before many updates have been made
    assert rows[2]["curves"]["distance_l1"][1][0] == pytest.approx(rows[3]["curves"]["distance_l1"][1][0], rel=0.05)

    (planned,) = paper.plan(paper.Options(quick=True, figure=(7,)), "cpu")
    trials, stopped = [planned.trial(setting) for setting in settings], threading.Event()
    stopped.set()
    env = hgail_envs.make("point")
    assert train_program(env, trials, None, tmp_path / "checkpoints", stopped) is None  # after a round
    resumed = train_program(env, trials, None, tmp_path / "checkpoints", threading.Event())
    assert [(row["curves"], row["final"]) for row in rows] == [(each["curves"], each["final"]) for each in resumed]
    assert len(prepared) == 3


@pytest.mark.slow  # as those of tables 2 and 3 below, for all studies
def test_every_study_writes_its_files_and_figures_are_drawn_from_them(tmp_path, trained, monkeypatch):
    drawn = []
    monkeypatch.setattr(tables, "draw_figure", lambda folder, number: drawn.append(number))
    paper.main([*QUICK, "--all", "--out", str(tmp_path)])
    names = ("table1", "table1-longer", "table2", "table3", "p_ht", "rewards", "ablations", "gasil", "standardization")
    files = {f"{name}-point.{ending}" for name in names for ending in ("md", "json")}
    assert contents(tmp_path).keys() == files
    assert sorted(drawn) == [3, 3, 4, 5, 6, 7]
    paper.main(["--plots-only", "--out", str(tmp_path)])
    figures = {f"figure{number}.png" for number in range(3, 8)}
    assert contents(tmp_path).keys() == files | figures
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in figures)


def test_a_study_s_file_is_what_was_measured(made_once):
    (planned,) = paper.plan(paper.Options(quick=True, seeds=3, table=(3,)), "cpu")
    rows = read(made_once / "table3-point.json")
    for setting, row in zip(BY_NAME["table3"].settings, rows, strict=True):
        trial = planned.trial(setting)
        (result,) = results_of([trial])
        assert (row["setting"], row["panel"]) == (setting.name, setting.panel)
        assert (row["identity"], row["identity"]["seeds"]) == (trial.identity(), [0, 1, 2])
        assert (row["final"], row["curves"]) == (result["final"], result["curves"])
        made_by = row["made_by"]
        assert {"command", "commit", "device", "versions", "date"} <= made_by.keys()
        assert {"hgail-jax", "mujoco", "mujoco-mjx", "warp-lang", "jax", "driver"} <= made_by["versions"].keys()


@pytest.mark.parametrize(("name", "kept"), [*((study.name, True) for study in OFF_POLICY_STUDIES), ("parts", False)])
def test_curves_are_kept_of_studies_that_ask_for_them(name, kept):
    study, trials = BY_NAME[name], trials_of(BY_NAME[name], "push")
    results = made(results_of(trials), trials)
    for row, result in zip(make_rows("push", study, results), results, strict=True):
        assert row.get("curves") == (result["curves"] if kept else None)


def test_settings_are_compared_by_their_seeds(made_once):
    rows = read(made_once / "table3-point.json")
    for index, row in enumerate(rows):
        others = rows[index + 1 :]
        assert [*row["better_than"]] == [f"{other['setting']}, {other['panel']}" for other in others]
        for other, (probability, low, high) in zip(others, row["better_than"].values(), strict=True):
            pairs = [(x, y) for x in row["final"]["success"] for y in other["final"]["success"]]
            assert probability == pytest.approx(np.mean([(x > y) + 0.5 * (x == y) for x, y in pairs]))
            assert low <= probability <= high


def test_a_table_has_the_paper_s_numbers_beside_ours():
    trials = trials_of(BY_NAME["table1"], "reach")
    results = made([results_of([trial])[0] for trial in trials], trials)
    rows = make_rows("reach", BY_NAME["table1"], results)
    by_name = {row["setting"]: row for row in rows if not row["panel"]}
    assert (by_name["GASIL"]["paper_success"], by_name["GASIL"]["paper_distance_l1"]) == (".42 ± .08", ".20 ± .07")
    assert by_name["PPO"]["paper_success"] == "0"
    assert by_name["GCSL"]["paper_success"] == ""
    final = results[0]["final"]
    assert rows[0]["success_rate"] == pytest.approx(np.mean(final["success"]))
    assert rows[0]["seconds"] == 6.0


def test_what_is_there_is_left_and_what_is_missing_comes_back(table3, trained):
    arguments = [*QUICK, "--table", "3", "--out", str(table3)]
    before, times = contents(table3), {path: path.stat().st_mtime_ns for path in table3.iterdir() if path.is_file()}
    paper.main(arguments)
    assert {path: path.stat().st_mtime_ns for path in times} == times
    for missing in (["figure5.png", "table3-point.md"], ["table3-point.md", "table3-point.json"]):
        for name in missing:
            (table3 / name).unlink()
        paper.main(arguments)
        assert contents(table3) == before
    assert not trained  # from what had been trained


def test_a_stopped_run_keeps_the_programs_that_it_has(tmp_path, trained, monkeypatch, capsys):
    train = work.train_program

    def stop_at_the_second(*arguments):
        if trained:
            raise OSError(28, "No space left on device")
        return train(*arguments)

    monkeypatch.setattr(work, "train_program", stop_at_the_second)
    arguments = [*QUICK, "--table", "2", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as exit_info:
        paper.main(arguments)
    assert exit_info.value.code == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("paper: stopped: ")
    monkeypatch.setattr(work, "train_program", train)
    paper.main(arguments)
    assert len(trained) == 4  # each program once
    assert (tmp_path / "figure4.png").exists()


def test_results_of_other_settings_are_set_aside_as_older_once_there_are_new_ones(table3, trained, monkeypatch, capsys):
    before, old = contents(table3), read(table3 / "table3-point.json")
    arguments = ["--quick", "--seeds", "4", "--table", "3", "--out", str(table3)]
    with monkeypatch.context() as stopped:
        stopped.setattr(work, "train_program", lambda *arguments: None)
        paper.main(arguments)
    assert contents(table3) == before
    paper.main(arguments)
    assert "table3 of point is made again, and what is there goes to older/" in capsys.readouterr().out
    (older,) = (table3 / "older").iterdir()
    assert older.name == hash_json({f"{row['setting']}, {row['panel']}": row["identity"] for row in old})
    assert {path.name for path in older.iterdir()} == {"table3-point.md", "table3-point.json"}
    assert (older / "table3-point.json").read_bytes() == before["table3-point.json"]
    assert (older / "table3-point.md").read_text().startswith("**Older:**")
    assert {len(row["identity"]["seeds"]) for row in read(table3 / "table3-point.json")} == {4}
    assert "lder" not in (table3 / "table3-point.md").read_text()


def test_rows_of_another_commit_than_the_newest_are_marked_as_older(tmp_path):
    study = Study("two", "two", tuple(BY_NAME["rewards"].settings[:3]))
    trials = trials_of(study, "point", "cpu")
    results = made(results_of(trials), trials, ("aaa1111", "bbb2222", "aaa1111"), ("2026-01-01", "2025-12-31"))
    rows = make_rows("point", study, results)
    assert [row["older"] for row in rows] == [False, True, False]
    write_markdown(tmp_path / "two.md", "point", study, rows)
    text = (tmp_path / "two.md").read_text()
    assert [*map(text.count, ("*older* (bbb2222)", "*older* (aaa1111)"))] == [1, 0]
    assert "commit aaa1111, a chip; jax 0.10.2; driver 580.1" in text and "commit bbb2222" in text
    same = made(results_of(trials), trials, ("bbb2222",), ("2026-01-01", "2025-12-31"))
    assert not any(row["older"] for row in make_rows("point", study, same))


def test_several_tasks_are_one_command(tmp_path, trained):
    paper.main([*QUICK, "--study", "gasil", "--task", "point", "reach", "--out", str(tmp_path)])
    of_tasks = [read(tmp_path / f"gasil-{task}.json") for task in ("point", "reach")]
    for rows in of_tasks:
        assert [row["setting"] for row in rows] == [setting.name for setting in BY_NAME["gasil"].settings]
    assert len({row["identity"]["task"] for rows in of_tasks for row in rows}) == 2


def test_demonstrations_are_of_what_the_learner_observes(tmp_path, trained, monkeypatch):
    """TD3 observes where the cube is, three numbers, at each step of grasp."""

    def record(env, task, episodes):
        sizes = {"features": env.feature_size, "goal": env.goal_size, "action": env.action_size}
        of_steps = {name: np.zeros((episodes, 2, size), np.float32) for name, size in sizes.items()}
        of_episodes = dict.fromkeys(("success", "returns", "distance_l1"), np.ones(episodes, np.float32))
        return Demonstrations(task, **of_steps, **of_episodes, made_by={})

    monkeypatch.setattr(work, "record", record)
    paper.main([*QUICK, "--study", "table1", "off-policy-methods", "--task", "grasp", "--out", str(tmp_path)])
    recorded = [load_demonstrations(path, "grasp") for path in sorted((tmp_path / "demonstrations").iterdir())]
    assert [one.features.shape for one in recorded] == [(100, 2, 11), (100, 2, 8)]  # grasp-td3.npz, grasp.npz
    made = {row["identity"]["demonstrations"] for row in read(tmp_path / "off-policy-methods-grasp.json")}
    assert made == {None, *(recorded[0].first(count).sha256 for count in (20, 100))}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "nothing to make; name a --table, a --figure or a --study"),
        (["--table", "4"], "invalid choice '4'"),
        (["--figure", "9"], "invalid choice '9'"),
        (["--task", "poke", "--all"], "choose from"),
        (["--seeds", "0", "--all"], "seeds is 0; it must be at least 1"),
        (["--study", "dreams"], "study is 'dreams'; choose from table1, table1-longer"),
        (
            ["--study", "off-policy", "--task", "grasp"],
            "study 'off-policy' on 'grasp': 'as it is' and 'HER' are both HER",
        ),
        (
            ["--study", "off-policy-methods", "--task", "tower"],
            "needs a task whose observation is its features and its goal",
        ),
        (["--study", "parts"], "study 'parts' is for tasks with the option 'observation'; 'reach' has none"),
        (["--plots-only"], "holds no figure's data"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        paper.main([*arguments, "--out", "results"])
    error = capsys.readouterr().err
    assert exit_info.value.code == 2
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_a_program_has_the_task_with_the_options_of_its_trials(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(work, "train_program", lambda env, *others: made.append(env))
    scale, study = Scale("push", "cpu", quick=True), BY_NAME["parts"]
    for job in Unfinished(work.Work(scale, 2, tmp_path, (study,))).jobs():
        job.carry_out(threading.Event())
    assert [env.observation for env in made] == ["compact"] * 3 + ["official"]


@pytest.mark.slow
def test_everything_runs_and_the_sweep_is_timed(tmp_path):
    paper.main(["--quick", "--all", "--sweep", "--out", str(tmp_path)])
    timed = json.loads((tmp_path / "sweep-point.json").read_text())
    assert timed["ratio"] == timed["one_after_another_seconds"]["train"] / timed["one_program_seconds"]["train"]
    assert len(timed["settings"]) == len(SWEEP)
    assert len(read(tmp_path / "table1-point.json")) == len(BY_NAME["table1"].settings)
    assert not [path for path in (tmp_path / "parts").iterdir() if path.is_dir()]  # no checkpoint is left


def test_methods_by_td3_are_drawn_over_steps_and_over_a_setting_s_seconds(tmp_path, monkeypatch):
    curves = {"env_steps": [100_000, 200_000], "success": [[0.0, 0.5], [1.0, 1.0]]}
    row = {"setting": "HGAIL", "panel": "", "seconds": 1.0, "curves": curves, "made_by": {"commit": "abc"}}
    content = {"study": "off-policy-methods", "task": "push", "settings": [row]}
    (tmp_path / "off-policy-methods-push.json").write_text(json.dumps(content))
    drawn = []
    monkeypatch.setattr(figures, "write_figure", lambda figure, path, dpi: drawn.append(figure))
    figures.draw_figure(tmp_path, OFF_POLICY_FIGURE)
    lines = [axis.lines[0].get_xydata().tolist() for axis in drawn[0].axes]
    assert lines == [[[100_000, 0.25], [200_000, 1.0]], [[0.5, 0.25], [1.0, 1.0]]]
    ticks = [[label.get_text() for label in axis.get_xticklabels()] for axis in drawn[0].axes]
    assert "150k" in ticks[0] and not any("m" in label for label in ticks[1])  # half a second is no 500m
    assert all(len(labels) <= 8 for labels in ticks)  # they would overlap
