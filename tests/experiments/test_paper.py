import dataclasses
import json
import shutil
import threading

import numpy as np
import pytest

import hgail_envs
from experiments.paper import __main__ as paper
from experiments.paper import statistics, tables, work
from experiments.paper.off_policy import OFF_POLICY_STUDIES
from experiments.paper.programs import group_by_program, make_program, train_program
from experiments.paper.studies import STUDIES, SWEEP, studies_of
from experiments.paper.study import REPORTED_SEEDS, TUNING_SEEDS, Study, choose_seeds
from experiments.paper.tables import make_rows, write_markdown
from experiments.paper.trials import Scale, hash_json, work_out
from experiments.paper.work import Unfinished
from hgail_jax import PRESETS, env_steps, phase_table
from hgail_jax.settings.defaults import DEFAULTS
from hgail_jax.settings.presets import AS_WRITTEN
from hgail_jax.train import EVALUATE
from hgail_jax.trainer.loop import Program

QUICK = ["--quick", "--seeds", "3"]
BY_NAME = {study.name: study for study in STUDIES}


def trials_of(study, task, platform="gpu"):
    return [work_out(Scale(task, platform), setting, range(8)) for setting in study.settings]


def phases_of(trial):
    return make_program(hgail_envs.make("point"), [trial], None).phases()


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


def test_a_study_by_real_training_and_that_it_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
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
    # r4 is r3 by algebra, so nothing but rounding may tell them apart before many updates have been made
    assert rows[2]["curves"]["distance_l1"][1][0] == pytest.approx(rows[3]["curves"]["distance_l1"][1][0], rel=0.05)

    (planned,) = paper.plan(paper.Options(quick=True, figure=(7,)), "cpu")
    trials, stopped = [planned.trial(setting) for setting in settings], threading.Event()
    stopped.set()
    env = hgail_envs.make("point")
    assert train_program(env, trials, None, tmp_path / "checkpoints", stopped) is None  # after a round
    resumed = train_program(env, trials, None, tmp_path / "checkpoints", threading.Event())
    assert [(row["curves"], row["final"]) for row in rows] == [(each["curves"], each["final"]) for each in resumed]
    assert len(prepared) == 3


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


def test_each_setting_is_compared_with_the_one_of_its_panel():
    for study in STUDIES:
        for setting in study.settings:
            reference = study.compared_with(setting)
            if reference is None:
                assert setting.name == (study.reference or study.settings[0].name)
            else:
                assert reference in study.settings and reference != setting
    table3 = BY_NAME["table3"]
    assert [table3.compared_with(setting) for setting in table3.settings[1::2]] == [*table3.settings[::2]]
    assert BY_NAME["table1"].compared_with(BY_NAME["table1"].settings[-1]).name == "HGAIL"


def test_several_tasks_are_one_command_and_their_seeds_one_mean(tmp_path, trained):
    paper.main([*QUICK, "--study", "gasil", "--task", "point", "reach", "--out", str(tmp_path)])
    means = json.loads((tmp_path / "gasil-point-reach.json").read_text())["means"]
    of_tasks = [read(tmp_path / f"gasil-{task}.json") for task in ("point", "reach")]
    for row, *of_setting in zip(means, *of_tasks, strict=True):
        assert all(row["setting"] == each["setting"] and row["panel"] == each["panel"] for each in of_setting)
        values = sorted(value for each in of_setting for value in each["final"]["success"])
        assert row["success_iqm"] == pytest.approx(np.mean(values[1:-1]))  # of six, one off either end


def test_seeds_for_choosing_settings_are_others_than_those_for_reporting(tmp_path, trained, capsys):
    assert not set(REPORTED_SEEDS) & set(TUNING_SEEDS)
    paper.main(["--quick", "--study", "gasil", "gail-demo-weight", "--out", str(tmp_path)])
    for name, seeds, purpose in (
        ("gasil", [0, 1], "reporting"),
        ("gail-demo-weight", [1000, 1001], "choosing"),
    ):
        assert all(row["identity"]["seeds"] == seeds for row in read(tmp_path / f"{name}-point.json"))
        assert f"Seeds {min(seeds)} to {max(seeds)} are for {purpose}" in (tmp_path / f"{name}-point.md").read_text()
    with pytest.raises(ValueError, match="from 1000 on they are for choosing"):
        choose_seeds(tuning=False, count=1001)
    assert not any(study.tuning for task in ("reach", "grasp") for study in studies_of(task))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "nothing to make; name a --table, a --figure or a --study"),
        (["--table", "4"], "invalid choice '4'"),
        (["--figure", "8"], "invalid choice '8'"),
        (["--task", "poke", "--all"], "choose from"),
        (["--seeds", "0", "--all"], "seeds is 0; it must be at least 1"),
        (["--study", "dreams"], "study is 'dreams'; choose from table1, table1-longer"),
        (
            ["--study", "off-policy", "--task", "grasp"],
            "study 'off-policy' on 'grasp': 'as it is' and 'HER' are both HER",
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


@pytest.mark.parametrize(("task", "platform"), [("reach", "gpu"), ("reach", "cpu"), ("grasp", "gpu")])
def test_methods_have_equal_steps_and_the_longer_ones_ten_times_as_many(task, platform):
    def steps(config):
        return env_steps(hgail_envs.find_class(task), config, phase_table(config)).sum()

    expected = steps(Scale(task, platform).preset().config)
    for trial in trials_of(BY_NAME["table1"], task, platform):
        one_more = dataclasses.replace(trial.config, rounds=trial.config.rounds + 1)
        a_round = steps(one_more) - steps(trial.config)
        assert abs(steps(trial.config) - expected) <= a_round / 2
        assert trial.method != "hgail" or trial.setting.panel or steps(trial.config) == expected
    for trial in trials_of(BY_NAME["table1-longer"], task, platform):
        assert steps(trial.config) == pytest.approx(10 * expected, rel=0.02)


def test_settings_of_few_rounds_are_evaluated_in_every_one():
    for trial in trials_of(BY_NAME["table1-longer"], "reach", "gpu") + trials_of(BY_NAME["table1"], "grasp", "gpu"):
        np.testing.assert_array_equal(phases_of(trial), phase_table(trial.config))


def test_settings_of_ten_times_the_steps_are_evaluated_in_every_tenth_of_many_rounds_and_the_last():
    for trial in trials_of(BY_NAME["table1-longer"], "grasp", "gpu"):
        evaluated = np.flatnonzero(phases_of(trial)[:, -1] == EVALUATE)
        assert [*evaluated] == [*range(0, trial.config.rounds, 10), trial.config.rounds]
        np.testing.assert_array_equal(phases_of(trial)[:, :-1], phase_table(trial.config)[:, :-1])


def test_settings_that_differ_in_numbers_alone_share_a_program():
    sweep = trials_of(Study("sweep", "", SWEEP), "reach")
    assert len(sweep) >= 15
    assert len(group_by_program(sweep)) == 1
    assert len({trial.key() for trial in sweep}) == len(sweep)
    assert len(group_by_program(trials_of(BY_NAME["p_ht"], "reach"))) == 2  # with and without pre-training
    assert len(group_by_program(trials_of(BY_NAME["table2"], "reach"))) == 4
    parts = trials_of(BY_NAME["parts"], "push")
    assert [len(group) for group in group_by_program(parts)] == [6, 1, 1, 1]
    assert {trial.config.rounds for trial in parts} == {40}  # a third of its own
    assert {trial.evaluate_every for trial in parts} == {5}
    assert [trial.task_options.get("observation") for trial in parts] == [None] * 8 + ["official"]
    assert len({trial.key() for trial in parts}) == 8  # one of the solved weights is the task's own
    assert studies_of("push") == (BY_NAME["parts"],)


def test_of_a_discriminator_s_samples_one_choice_is_changed_or_all_are_the_paper_s():
    preset = DEFAULTS["grasp"]["td3"]["gpu"].hyperparameters
    trials = trials_of(BY_NAME["off-policy-samples"], "grasp", "gpu")
    changes = [
        {name: value for name, value in vars(trial.hyperparameters).items() if value != getattr(preset, name)}
        for trial in trials
    ]
    choices = {"shuffled_goals", "goal_jitter", "negative_p_ht", "negative_weight"}
    papers = {"shuffled_goals": 0.0, "goal_jitter": 0.0, "negative_weight": 1.0}  # p_ht of grasp's is 0 already
    assert papers in changes and {"environment_reward": 1.0} in changes
    assert all(
        len(change) == 1 and set(change) <= choices for change in changes if change not in (papers, {}, changes[-1])
    )


@pytest.mark.parametrize("task", ["push", "grasp"])
def test_studies_off_policy_change_one_thing_of_the_learner_td3_and_have_its_steps(task):
    numbers, sizes = (trials_of(BY_NAME[name], task, "gpu") for name in ("off-policy", "off-policy-sizes"))
    assert [trial.setting.name for trial in numbers if trial.method == "her"] == ["HER"]
    preset = DEFAULTS[task]["td3"]["gpu"]
    of_task = env_steps(hgail_envs.find_class(task), preset.config, phase_table(preset.config)).sum()
    for trial in numbers + sizes:
        changed = [
            name
            for name, value in vars(trial.hyperparameters).items()
            if value != getattr(preset.hyperparameters, name)
        ]
        before, after = (vars(config) | vars(config.learner) for config in (preset.config, trial.config))
        changed += [name for name in before if before[name] != after[name] and name not in ("learner", "best_episodes")]
        if trial.method == "her" and preset.method != "her":  # has no discriminator
            changed.remove("discriminator_minibatches")
        if trial.method == "her":
            changed = [name for name in changed if name not in ("environment_reward", "discriminator_minibatches")]
        assert len(changed) <= 1 and trial.task_options == preset.task_options
        assert env_steps(hgail_envs.find_class(task), trial.config, phase_table(trial.config)).sum() == of_task
        assert not changed or trial.setting.name != "as it is"


def test_rewards_are_compared_beside_other_goals_and_ppo():
    trials = trials_of(BY_NAME["off-policy-rewards"], "stack", "gpu")
    her, alike, own_goals, ppo = group_by_program(trials)
    assert [trial.hyperparameters.environment_reward for trial in (*her, *alike, *own_goals)] == [1.0, 0.0, 0.5, 1.0]
    assert [trial.config.training_goals for trial in (*her, *alike, *own_goals, *ppo)] == [True] * 3 + [False, True]
    assert [trial.method for trial in (*her, *own_goals)] == ["her"] * 2
    assert [trial.config.discriminator_minibatches for trial in (*her, *own_goals)] == [0, 0]
    (row,) = ppo
    assert row.config == DEFAULTS["stack"]["ppo"]["gpu"].config and row.config.learner.name == "ppo"


@pytest.mark.parametrize("task", ["push", "pick-and-place"])
def test_methods_with_td3_have_its_steps_and_none_but_her_a_reward(task):
    trials = trials_of(BY_NAME["off-policy-methods"], task, "gpu")
    preset = DEFAULTS[task]["td3"]["gpu"]
    for trial in trials:
        penalty = 10.0 if trial.setting.demonstrations else 0.0
        assert trial.config.learner == dataclasses.replace(preset.config.learner, gradient_penalty=penalty)
    assert {trial.config.rounds for trial in trials} == {preset.config.rounds}
    shuffled = ", half the negatives shuffled"
    of_half = {trial.setting.name: trial for trial in trials if trial.setting.name.endswith(shuffled)}
    assert {float(trial.hyperparameters.shuffled_goals) for trial in of_half.values()} == {0.5}
    found = {
        trial.setting.name: (
            trial.config.expert_source,
            trial.setting.demonstrations,
            float(trial.hyperparameters.p_ht),
            float(trial.hyperparameters.environment_reward),
        )
        for trial in trials
    }
    for name in of_half:
        assert found.pop(name) == found[name.removesuffix(shuffled)]
    assert {name.removesuffix(shuffled) for name in of_half} == {"GAIL-demo (20)", "GAIL-demo (100)", "GASIL"}
    assert found == {
        "HGAIL": ("relabelled", 0, preset.hyperparameters.p_ht, 0.0),
        "HGAIL-no": ("relabelled", 0, 0.0, 0.0),
        "GAIL-demo (20)": ("demonstrations", 20, 0.0, 0.0),
        "GAIL-demo (100)": ("demonstrations", 100, 0.0, 0.0),
        "GASIL": ("best", 0, 0.0, 0.0),
        "HER": ("relabelled", 0, preset.hyperparameters.p_ht, 1.0),
    }


def test_a_program_has_the_task_with_the_options_of_its_trials(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(work, "train_program", lambda env, *others: made.append(env))
    scale, study = Scale("push", "cpu", quick=True), BY_NAME["parts"]
    for job in Unfinished(work.Work(scale, 2, tmp_path, (study,))).jobs():
        job.carry_out(threading.Event())
    assert [env.observation for env in made] == ["compact"] * 3 + ["official"]


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_bc_is_weighed_as_their_names_say(task):
    trials = {trial.setting.name: trial for trial in trials_of(BY_NAME["table1"], task)}
    weights = {"with BC": 1.0, "BC × 3": 3.0, "BC × 10": 10.0}
    for name, weight in weights.items():
        trial = trials[f"GAIL-demo (20), {name}"]
        assert (trial.method, trial.setting.demonstrations) == ("gail-demo", 20)
        assert float(trial.hyperparameters.bc_weight) == weight
        assert trial.config.learner.bc_batch > 0
    assert trials["GAIL-demo (20), no BC"].config.learner.bc_batch == 0


def test_the_paper_s_sizes_have_one_change_each_and_the_preset_a_second_one():
    trials = trials_of(BY_NAME["paper-sizes"], "reach")
    assert len({trial.key() for trial in trials}) == len(trials) >= 48
    second = [trial for trial in trials if trial.setting.panel == "phases 1 + 3"]
    preset = PRESETS["paper"].config
    for trial in second:
        assert (trial.config.learner.policy_phases, trial.config.learner.discriminator_phases) == (1, 3)
        assert (trial.config.num_envs, trial.config.learner.minibatches) == (
            preset.num_envs,
            preset.learner.minibatches,
        )
    assert len(second) == 6
    for trial in trials_of(BY_NAME["paper-sizes"], "reach", "cpu"):
        steps = env_steps(hgail_envs.find_class("reach"), trial.config, phase_table(trial.config)).sum()
        least, most = (490_000, 510_000) if trial.setting.panel == "phases 1 + 3" else (180_000, 260_000)
        assert least <= steps <= most
    for trial in [trial for trial in trials if trial not in second]:
        wanted = {**trial.setting.config, **trial.setting.hyperparameters}
        changes = {name: value for name, value in wanted.items() if value != AS_WRITTEN.get(name)}
        changes.pop("pretrain", None)
        assert len(changes) <= 2 or trial.setting.name == "raw rewards and advantages"
        assert trial.config.learner.policy_phases == changes.get("policy_phases", 16)
        assert float(trial.hyperparameters.exploration_noise) == changes.get("exploration_noise", 1.0)
        assert float(trial.hyperparameters.policy_learning_rate) == changes.get("policy_learning_rate", 1e-3)
        samples = trial.config.num_envs * 50 // trial.config.learner.minibatches
        assert samples == pytest.approx(128, abs=6) or set(changes) <= {"epochs", "minibatches"}
    programs = group_by_program(trials)
    assert sorted(map(len, programs))[-2:] == [18, 18]  # what differs in numbers alone, with pre-training and without


def test_sizes_of_grasp_are_those_that_their_names_tell():
    trials = trials_of(BY_NAME["grasp-sizes"], "grasp")
    assert len({trial.key() for trial in trials}) == len(trials) == 12
    for trial in trials:
        sizes = f"{trial.config.num_envs} episodes, {trial.config.rounds} rounds"
        wide = trial.config.policy_hidden == trial.config.discriminator_hidden == (256, 256)
        assert trial.setting.panel == sizes + (", 256 wide" if wide else "")
        assert trial.setting.name == f"BC × {float(trial.hyperparameters.bc_weight):g}"


def test_sizes_stay_a_preset_s_where_nothing_is_said():
    assert Scale("reach", "gpu").preset("paper").config == dataclasses.replace(
        PRESETS["paper"].config, best_episodes=256
    )


@pytest.mark.slow
def test_the_paper_s_sizes_are_trained(tmp_path, monkeypatch):
    """One setting of each size and of each number, but for what takes long."""
    study = BY_NAME["paper-sizes"]
    settings = tuple(
        setting
        for setting in study.settings
        if setting.config.get("num_envs", 0) < 64 and setting.panel != "phases 1 + 3"
    )
    monkeypatch.setattr(paper, "STUDIES", (dataclasses.replace(study, settings=settings[:18] + settings[-2:]),))
    paper.main(["--quick", "--study", "paper-sizes", "--out", str(tmp_path)])
    rows = read(tmp_path / "paper-sizes-point.json")
    assert len(rows) == 20 and all(row["identity"]["seeds"] == [1000, 1001] for row in rows)
    assert all(row["diverged_seeds"] == 0 for row in rows)
    ends = {row["setting"]: row["distance_l1"] for row in rows[:18]}
    assert len(set(ends.values())) == len(ends)  # each change changes something


@pytest.mark.slow
def test_everything_runs_and_the_sweep_is_timed(tmp_path):
    paper.main(["--quick", "--all", "--sweep", "--out", str(tmp_path)])
    timed = json.loads((tmp_path / "sweep-point.json").read_text())
    assert timed["ratio"] == timed["one_after_another_seconds"]["train"] / timed["one_program_seconds"]["train"]
    assert len(timed["settings"]) == len(SWEEP)
    assert len(read(tmp_path / "table1-point.json")) == len(BY_NAME["table1"].settings)
    assert not [path for path in (tmp_path / "parts").iterdir() if path.is_dir()]  # no checkpoint is left
