"""What the studies compare: settings, steps, and which of them share a program."""

import dataclasses

import numpy as np
import pytest

import hgail_envs
from experiments.paper.programs import group_by_program, make_program
from experiments.paper.studies import STUDIES, SWEEP, studies_of
from experiments.paper.study import Study
from experiments.paper.trials import Scale, work_out
from hgail_jax import PRESETS, env_steps, phase_table
from hgail_jax.settings.defaults import DEFAULTS
from hgail_jax.train import EVALUATE

BY_NAME = {study.name: study for study in STUDIES}


def trials_of(study, task, platform="gpu"):
    return [work_out(Scale(task, platform), setting, range(8)) for setting in study.settings]


def phases_of(trial):
    return make_program(hgail_envs.make("point"), [trial], None).phases()


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
    *trials, contrastive = trials_of(BY_NAME["off-policy-methods"], task, "gpu")
    preset = DEFAULTS[task]["td3"]["gpu"]
    assert (contrastive.method, contrastive.config.learner.name) == ("crl", "crl")
    assert contrastive.config.rounds == preset.config.rounds
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


def test_sizes_stay_a_preset_s_where_nothing_is_said():
    assert Scale("reach", "gpu").preset("paper").config == dataclasses.replace(
        PRESETS["paper"].config, best_episodes=256
    )
