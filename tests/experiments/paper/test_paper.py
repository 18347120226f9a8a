import csv
import dataclasses
import json
import threading

import numpy as np
import pytest

import envs
from experiments.paper import __main__ as paper
from experiments.paper import work
from experiments.paper.programs import group_by_program, make_program, train_program
from experiments.paper.studies import STUDIES, SWEEP, Study
from experiments.paper.tables import table_rows
from experiments.paper.trials import Scale, hash_json, work_out
from hgail_jax import PRESETS, env_steps, schedule
from hgail_jax.statistics import confidence_interval
from hgail_jax.train import EVALUATE

QUICK = ["--quick", "--seeds", "3"]
BY_NAME = {study.name: study for study in STUDIES}


def trials_of(study, task, platform="gpu"):
    return [work_out(Scale(task, platform), setting, 8) for setting in study.settings]


def phases_of(trial):
    return make_program(envs.make("point"), [trial], None).phases()


def read(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def results_of(trials):
    """What training might have given: numbers that follow from the trial's hash."""
    found = []
    for trial in trials:
        rng = np.random.default_rng(int(trial.key(), 16))
        steps = env_steps(envs.make("point"), trial.config, schedule(trial.config)).cumsum()
        curve = {name: rng.uniform(size=(len(steps), trial.seeds)).tolist() for name in ("success", "distance_l1")}
        names = ("success", "achieved", "success_l1", "distance_l1", "distance_l2")
        seconds = {"compile": 1.0, "train": 6.0, "evaluation": 1.0}
        found.append(
            curve
            | {
                "rounds": list(range(len(steps))),
                "env_steps": steps.tolist(),
                "final": {name: rng.uniform(size=trial.seeds).tolist() for name in names},
                "evaluation_episodes": 8,
                "diverged_seeds": 0,
                "program": {"settings": len(trials), "seconds": seconds, "dropped": 0.0},
            }
        )
    return found


@pytest.fixture
def trained(monkeypatch):
    """Stands in for the training; lists what it was asked for."""
    asked = []

    def train(env, trials, demonstrations, folder, stop):
        asked.append([trial.setting.name for trial in trials])
        return results_of(trials)

    monkeypatch.setattr(work, "train_program", train)
    return asked


def test_tables_and_figures_by_real_training(tmp_path, monkeypatch):
    study = BY_NAME["rewards"]
    with_pretraining = tuple(
        dataclasses.replace(setting, steps=1) for setting in study.settings if setting.panel == "with pre-training"
    )
    monkeypatch.setattr(paper, "STUDIES", (dataclasses.replace(study, settings=with_pretraining),))
    paper.main(["--quick", "--figure", "7", "--out", str(tmp_path)])
    rows = read(tmp_path / "rewards-point.csv")
    assert [row["setting"] for row in rows] == ["r1", "r2", "r3", "r4"]
    for row in rows:
        assert 0 <= float(row["success_rate"]) <= 1
        assert float(row["distance_l1"]) >= float(row["distance_l2"]) > 0
        assert int(row["diverged_seeds"]) == 0
    curves = read(tmp_path / "figure7-point.csv")
    last = [row for row in curves if row["env_steps"] == rows[0]["env_steps_per_seed"]]
    assert {row["seed"] for row in last} == {"0", "1"}
    # r4 is r3 by algebra, so nothing but rounding may tell them apart before many updates have been made
    first = {row["setting"]: float(row["distance"]) for row in curves if row["round"] == "1" and row["seed"] == "0"}
    assert first["r3"] == pytest.approx(first["r4"], rel=0.05)
    said = json.loads((tmp_path / "rewards-point.json").read_text())
    assert said["hash"] == hash_json(said["settings"])
    assert said["made"]["r1, with pre-training"]["program"]["settings"] == 4
    finals = [said["made"][f"{row['setting']}, with pre-training"]["final"]["success"] for row in rows]
    assert [float(row["success_rate"]) for row in rows] == pytest.approx(np.mean(finals, axis=1))


def test_a_program_that_is_stopped_goes_on_where_it_was(tmp_path):
    planned = paper.plan(paper.Options(quick=True, figure=(7,)), "cpu")
    trials = [planned.trial(setting) for setting in BY_NAME["rewards"].settings[:2]]
    env, stopped = envs.make("point"), threading.Event()
    (whole, *_) = train_program(env, trials, None, tmp_path / "whole", threading.Event())
    stopped.set()
    assert train_program(env, trials, None, tmp_path / "parts", stopped) is None  # after a round
    (resumed, *_) = train_program(env, trials, None, tmp_path / "parts", threading.Event())
    for name in ("rounds", "env_steps", "success", "distance_l1", "final"):
        assert resumed[name] == whole[name]


def test_every_study_writes_its_files(tmp_path, trained):
    paper.main([*QUICK, "--all", "--out", str(tmp_path)])
    names = {path.name for path in tmp_path.iterdir()} - {"parts", "demonstrations"}
    tables = ("table1", "table1-longer", "table2", "table3", "p_ht", "rewards", "ablations", "gasil", "standardization")
    expected = {f"{name}-point.{ending}" for name in tables for ending in ("csv", "md", "json")}
    expected |= {f"figure{number}{ending}" for number in range(3, 8) for ending in ("-point.csv", ".png")}
    assert names == expected | {"figure3-longer-point.csv"}
    for number in range(3, 8):
        assert (tmp_path / f"figure{number}.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_s_data_is_what_was_measured(tmp_path, trained):
    paper.main([*QUICK, "--table", "3", "--out", str(tmp_path)])
    planned = paper.plan(paper.Options(quick=True, seeds=3, table=(3,)), "cpu")
    rows = read(tmp_path / "figure5-point.csv")
    for trial in map(planned.trial, BY_NAME["table3"].settings):
        (result,) = results_of([trial])
        of_trial = [row for row in rows if (row["setting"], row["panel"]) == (trial.setting.name, trial.setting.panel)]
        assert len(of_trial) == 3 * len(result["env_steps"])
        for row in of_trial:
            index, seed = int(row["round"]), int(row["seed"])
            assert int(row["env_steps"]) == result["env_steps"][index]
            assert float(row["success"]) == pytest.approx(result["success"][index][seed])
            assert float(row["distance"]) == pytest.approx(result["distance_l1"][index][seed])


def test_intervals_are_student_s():
    """Against a printed table of t: 2.365 for 7 degrees of freedom."""
    values = np.array([0.9, 0.95, 1.0, 1.0, 0.85, 0.97, 0.99, 1.0])
    expected = 2.3646 * np.sqrt(np.sum((values - values.mean()) ** 2) / 7) / np.sqrt(8)
    assert confidence_interval(values) == pytest.approx(expected, rel=1e-4)
    assert np.isnan(confidence_interval(np.array([1.0])))


def test_a_table_has_the_paper_s_numbers_beside_ours():
    made_by = {"made_by": {"device": {"kind": "a chip"}}}
    results = [results_of([trial])[0] | made_by for trial in trials_of(BY_NAME["table1"], "reach")]
    rows = table_rows("reach", BY_NAME["table1"], results)
    by_name = {row["setting"]: row for row in rows if not row["panel"]}
    assert (by_name["GASIL"]["paper_success"], by_name["GASIL"]["paper_distance_l1"]) == (".42 ± .08", ".20 ± .07")
    assert by_name["PPO"]["paper_success"] == "0"
    assert by_name["GCSL"]["paper_success"] == ""
    final = results[0]["final"]
    assert rows[0]["success_rate"] == pytest.approx(np.mean(final["success"]))
    assert (rows[0]["seeds"], rows[0]["device"], rows[0]["seconds"]) == (8, "a chip", 6.0)


def test_what_is_there_is_left_and_what_is_missing_comes_back(tmp_path, trained):
    arguments = [*QUICK, "--table", "2", "--out", str(tmp_path)]
    paper.main(arguments)
    asked = len(trained)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.is_file()}
    paper.main(arguments)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.is_file()} == before
    (tmp_path / "figure4.png").unlink()
    paper.main(arguments)
    assert (tmp_path / "figure4.png").exists()
    (tmp_path / "table2-point.md").unlink()
    (tmp_path / "table2-point.json").unlink()
    paper.main(arguments)
    assert (tmp_path / "table2-point.md").exists()
    assert len(trained) == asked  # from what had been trained


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


def test_results_of_other_settings_are_refused(tmp_path, trained, capsys):
    paper.main([*QUICK, "--table", "3", "--out", str(tmp_path)])
    before = (tmp_path / "table3-point.csv").read_bytes()
    with pytest.raises(SystemExit) as exit_info:
        paper.main(["--quick", "--seeds", "4", "--table", "3", "--out", str(tmp_path)])
    assert exit_info.value.code == 2
    assert "future, with pre-training.seeds is 3 there and 4 here" in capsys.readouterr().err
    assert (tmp_path / "table3-point.csv").read_bytes() == before


def test_figures_are_drawn_again_from_their_data(tmp_path, trained, monkeypatch):
    paper.main([*QUICK, "--figure", "5", "7", "--out", str(tmp_path)])
    pictures = {name: (tmp_path / name).read_bytes() for name in ("figure5.png", "figure7.png")}
    for path in list(tmp_path.iterdir()):
        if path.suffix in (".png", ".json"):
            path.unlink()
    paper.main(["--plots-only", "--out", str(tmp_path)])
    assert {name: (tmp_path / name).read_bytes() for name in pictures} == pictures


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "nothing to make; name a --table, a --figure or a --study"),
        (["--table", "4"], "choose from"),
        (["--figure", "8"], "choose from"),
        (["--task", "poke", "--all"], "choose from"),
        (["--seeds", "0", "--all"], "seeds is 0; it must be at least 1"),
        (["--study", "dreams"], "study is 'dreams'; choose from table1, table1-longer"),
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


@pytest.mark.parametrize(("task", "platform"), [("reach", "gpu"), ("reach", "cpu"), ("grasp", "gpu")])
def test_methods_have_equal_steps_and_the_longer_ones_ten_times_as_many(task, platform):
    def steps(config):
        return env_steps(envs.find_class(task), config, schedule(config)).sum()

    expected = steps(Scale(task, platform).preset().config)
    for trial in trials_of(BY_NAME["table1"], task, platform):
        assert steps(trial.config) == pytest.approx(expected, rel=0.07)
        assert trial.setting.method != "hgail" or trial.setting.panel or steps(trial.config) == expected
    for trial in trials_of(BY_NAME["table1-longer"], task, platform):
        assert steps(trial.config) == pytest.approx(10 * expected, rel=0.02)


def test_settings_of_few_rounds_are_evaluated_in_every_one():
    for trial in trials_of(BY_NAME["table1-longer"], "reach", "gpu") + trials_of(BY_NAME["table1"], "grasp", "gpu"):
        np.testing.assert_array_equal(phases_of(trial), schedule(trial.config))


def test_settings_of_ten_times_the_steps_are_evaluated_in_every_tenth_of_many_rounds_and_the_last():
    for trial in trials_of(BY_NAME["table1-longer"], "grasp", "gpu"):
        evaluated = np.flatnonzero(phases_of(trial)[:, -1] == EVALUATE)
        assert [*evaluated] == [*range(0, trial.config.rounds, 10), trial.config.rounds]
        np.testing.assert_array_equal(phases_of(trial)[:, :-1], schedule(trial.config)[:, :-1])


def test_settings_that_differ_in_numbers_alone_share_a_program():
    sweep = trials_of(Study("sweep", "", SWEEP), "reach")
    assert len(sweep) >= 15
    assert len(group_by_program(sweep)) == 1
    assert len({trial.key() for trial in sweep}) == len(sweep)
    assert len(group_by_program(trials_of(BY_NAME["p_ht"], "reach"))) == 2  # with and without pre-training
    assert len(group_by_program(trials_of(BY_NAME["table2"], "reach"))) == 4


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_likelihoods_are_weighed_as_their_names_say(task):
    trials = {trial.setting.name: trial for trial in trials_of(BY_NAME["table1"], task)}
    weights = {"with likelihood": 1.0, "likelihood × 3": 3.0, "likelihood × 10": 10.0}
    for name, weight in weights.items():
        trial = trials[f"GAIL-demo (20), {name}"]
        assert (trial.setting.method, trial.setting.demonstrations) == ("gail-demo", 20)
        assert float(trial.hyperparameters.likelihood_weight) == weight
        assert trial.config.likelihood_batch > 0
    assert trials["GAIL-demo (20), no likelihood"].config.likelihood_batch == 0


def test_sizes_stay_a_preset_s_where_nothing_is_said():
    assert Scale("reach", "gpu").preset("paper").config == dataclasses.replace(
        PRESETS["paper"].config, best_episodes=256
    )


@pytest.mark.slow
def test_everything_runs_and_the_sweep_is_timed(tmp_path):
    paper.main(["--quick", "--all", "--sweep", "--out", str(tmp_path)])
    timed = json.loads((tmp_path / "sweep-point.json").read_text())
    assert timed["ratio"] == timed["one_after_another_seconds"]["train"] / timed["one_program_seconds"]["train"]
    assert len(timed["settings"]) == len(SWEEP)
    assert len(read(tmp_path / "table1-point.csv")) == len(BY_NAME["table1"].settings)
    assert not [path for path in (tmp_path / "parts").iterdir() if path.is_dir()]  # no checkpoint is left
