import dataclasses
import functools
import itertools
import json
import re
from typing import ClassVar

import pytest

import hgail_envs
from experiments import RESULTS
from hgail_envs.base import GoalEnv, TrainingDefaults
from hgail_envs.point import Point
from hgail_envs.tasks.reach import Reach
from hgail_jax import METHODS, PPO, PRESETS, TD3, Hyperparameters, TrainOptions
from hgail_jax.evaluate import whole_rollouts
from hgail_jax.learners import LEARNERS
from hgail_jax.settings.defaults import (
    DEFAULTS,
    SHARED,
    SHARED_WITH_SCENE,
    default_learner,
    has_own_settings,
    task_preset,
)
from hgail_jax.settings.presets import AS_WRITTEN
from hgail_jax.train import env_steps, phase_table
from hgail_jax.trainer.train_options import plan
from hgail_jax.trainer.training import with_settings
from tests.support import ROOT

EIGHT = {"substeps": 8}


@pytest.mark.parametrize(
    ("task", "platform", "num_envs", "rounds", "substeps", "episodes", "evaluate_every"),
    [
        ("reach", "cpu", 64, 4, 4, 128, 1),
        ("reach", "gpu", 256, 4, 4, 512, 1),
        ("grasp", "cpu", 512, 16, 8, 512, 2),
        ("grasp", "gpu", 1024, 40, 8, 1024, 1),
    ],
)
def test_a_run_takes_what_the_readme_says(task, platform, num_envs, rounds, substeps, episodes, evaluate_every):
    run = plan(TrainOptions(task=task), platform)
    assert (run.config.num_envs, run.config.rounds, run.env.substeps) == (num_envs, rounds, substeps)
    assert run.evaluate_every == evaluate_every
    assert plan(TrainOptions(task=task, evaluate_every=3), platform).evaluate_every == 3
    assert whole_rollouts(run.evaluation_episodes, run.config.num_envs) * run.config.num_envs == episodes
    assert run.seeds == 8


@pytest.mark.parametrize(
    ("task", "layers", "more_updates", "fewer_samples"),
    [
        ("push", 2, 2, 4),
        ("pick-and-place", 2, 2, 4),
        ("grasp", 2, 4, 4),
        ("slide", 3, 2, 8),
        ("stack", 3, 2, 4),
    ],
)
def test_td3_takes_on_a_cpu_what_the_page_says(task, layers, more_updates, fewer_samples):
    """Gradient steps for a step of the environment, samples in one, beside a GPU's; the steps of the published run."""
    env, (cpu, gpu) = hgail_envs.find_class(task), (DEFAULTS[task]["td3"][name].config for name in ("cpu", "gpu"))
    assert (cpu.policy_hidden, gpu.policy_hidden) == ((128,) * layers, (256,) * 3)
    assert cpu.learner.updates / cpu.num_envs == more_updates * gpu.learner.updates / gpu.num_envs
    assert fewer_samples * cpu.learner.batch == gpu.learner.batch
    published = {run["name"]: run["env_steps"] for run in json.loads((RESULTS / "runs.json").read_text())}
    assert env_steps(env, cpu, phase_table(cpu)).sum() == published[f"{task}-td3-cpu"]


def test_the_discriminator_s_rate_falls_on_the_tasks_that_the_page_names():
    last = {task: of["td3"]["gpu"].config.learner.final_discriminator_learning_rate for task, of in DEFAULTS.items()}
    falling = [task for task, rate in last.items() if rate != 1.0]
    assert {last[task] for task in falling} == {0.1}
    named = re.search(r"falls to a tenth by default on (.*?)\.", (ROOT / "docs" / "adversary.md").read_text())[1]
    assert sorted(re.findall(r"\w+", named.replace(" and ", ", "))) == sorted(falling)


def test_a_task_changes_the_default_preset_and_no_other():
    grasp = hgail_envs.find_class("grasp")
    changed = task_preset(grasp, "cpu")
    assert changed.config.learner.bc_batch == 2048
    assert changed.hyperparameters.exploration_noise == (0.2, 0.2, 0.2, 0.5)
    assert changed.config.discriminator_minibatches == PRESETS["parallel"].config.discriminator_minibatches
    paper = task_preset(grasp, "cpu", "paper")
    assert (paper.config, paper.hyperparameters) == (PRESETS["paper"].config, PRESETS["paper"].hyperparameters)
    assert (paper.task_options, paper.evaluate_every) == (changed.task_options, changed.evaluate_every) == (EIGHT, 2)
    assert PRESETS["parallel"].config.learner.bc_batch == 0  # and not in place
    with pytest.raises(ValueError, match="preset is 'tiny'; choose from parallel, paper"):
        task_preset(grasp, "cpu", "tiny")


class Longer(Reach):
    """Reach, which is trained as reach is."""


class Own(Reach):
    """Reach, with defaults of its own."""

    training: ClassVar = {
        "ppo": {"cpu": TrainingDefaults({"num_envs": 7, "minibatches": 2}, {"p_ht": 0.5}, EIGHT, evaluate_every=3)},
        "td3": {"cpu": TrainingDefaults({"updates": 9}, method="her")},
    }


class Below(Own):
    """A task that extends one of the user's."""


def test_a_task_that_extends_another_is_trained_as_it_is_unless_it_says_otherwise():
    for platform in ("cpu", "gpu"):
        assert task_preset(Longer, platform) == DEFAULTS["reach"]["ppo"][platform]
    for task in (Own, Below):
        preset = task_preset(task, "cpu")
        assert preset.config == PRESETS["parallel"].config.replace(num_envs=7, minibatches=2)
        assert preset.hyperparameters == PRESETS["parallel"].hyperparameters.replace(p_ht=0.5)
        assert (preset.task_options, preset.evaluate_every) == (EIGHT, 3)
        off_policy = task_preset(task, "cpu", learner="td3")
        assert off_policy.config == SHARED_WITH_SCENE["td3"]["cpu"].config.replace(updates=9)
        assert (off_policy.method, off_policy.task_options) == ("her", EIGHT)
        assert task_preset(task, "gpu", learner="td3") == SHARED_WITH_SCENE["td3"]["gpu"]


def test_settings_of_a_task_s_own_are_those_for_the_learner_and_the_platform():
    own = [has_own_settings(Own, learner, platform) for learner in ("ppo", "td3") for platform in ("cpu", "gpu")]
    assert own == [True, False, True, False]
    assert has_own_settings(Longer, "td3", "gpu")  # reach's


class Moved(GoalEnv):
    """A user's own task, without settings."""


class InScene(Moved):
    """The same with a scene."""

    scene = "push"


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_a_user_s_task_is_trained_by_td3_and_with_a_scene_as_push_is(platform):
    for task in (Moved, InScene):
        assert default_learner(task) == "td3"
    found = task_preset(InScene, platform, learner="td3")
    push = DEFAULTS["push"]["td3"][platform]
    rounds = push.config.rounds if platform == "cpu" else 10
    assert found.config == push.config.replace(rounds=rounds)
    assert (found.hyperparameters, found.task_options, found.method) == (push.hyperparameters, EIGHT, "hgail")
    assert task_preset(Moved, platform, learner="td3") == SHARED["td3"][platform]


BY_THE_METHOD = {"expert_source", "learner"}


@pytest.mark.parametrize("learner", LEARNERS)
def test_every_size_and_hyperparameter_is_an_option_or_a_setting(learner):
    chosen = task_preset(Point, "cpu", learner=learner)
    of_options = {field.name for field in dataclasses.fields(TrainOptions)}
    sizes = vars(chosen.config) | vars(chosen.config.learner)
    hyperparameters = chosen.hyperparameters.as_dict()
    for name, value in (sizes | hyperparameters).items():
        if name in of_options | BY_THE_METHOD | {*LEARNERS[learner].ignored}:
            continue
        other = not value if isinstance(value, bool) else value + 1 if isinstance(value, int) else (8,)
        if isinstance(value, float):
            other = 0.5 * value or 0.25
        run = plan(with_settings(TrainOptions("point", learner=learner, seeds=1), {name: other}), "cpu")
        found = {**vars(run.config), **vars(run.config.learner), **vars(run.hyperparameters)}
        assert found[name] == other != value, name


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_randomised_episodes_have_settings_of_their_own_with_td3_alone(platform):
    def settings(task, **options):
        run = plan(TrainOptions(task=task, **options), platform)
        return run.config.rounds, run.hyperparameters.p_ht, run.hyperparameters.environment_reward

    usual, randomized = settings("push"), settings("push", randomize="full-history")
    assert usual == (8 if platform == "gpu" else 10, 0.8, 0.0)
    assert randomized == (30 if platform == "gpu" else 36, 0.6, 1.0)
    assert settings("pick-and-place", randomize="full") == (36, 0.6, 1.0)
    for same in ("slide", "grasp"):  # the latter's learner is PPO
        assert settings(same) == settings(same, randomize="full")
    assert settings("push", randomize="none-history") == usual  # which only adds to the observation
    grasp = plan(TrainOptions(task="grasp", learner="td3", randomize="mild"), platform)
    rounds = 24 if platform == "gpu" else 36
    assert (grasp.config.rounds, grasp.task_options, grasp.hyperparameters.p_ht) == (rounds, {"cube": "tracked"}, 0.6)


@pytest.mark.parametrize(
    "changes",
    [None, TrainingDefaults({"phases": 2}), TrainingDefaults({}, {"p_h": 0.2}), TrainingDefaults({"rounds": -1})],
)
def test_defaults_that_name_no_fields_are_refused(changes):
    odd = type("Odd", (Point,), {"training": {"ppo": {"cpu": changes}}})
    with pytest.raises(ValueError, match=r"Odd\.training\['ppo'\]\['cpu'\] is not TrainingDefaults of fields that"):
        task_preset(odd, "cpu")


def test_defaults_of_no_learner_are_refused():
    odd = type("Odd", (Point,), {"training": {"cpu": TrainingDefaults()}})
    for find in (default_learner, lambda task: task_preset(task, "cpu", learner="td3")):
        with pytest.raises(ValueError, match=r"learner in Odd\.training is 'cpu'; choose from ppo, td3"):
            find(odd)
    with pytest.raises(ValueError, match="method is 'hgial'; choose from hgail"):
        task_preset(type("Odd", (Point,), {"training": {"ppo": {"cpu": TrainingDefaults(method="hgial")}}}), "cpu")


def test_a_learner_takes_the_hyperparameters_of_its_class_alone():
    env = hgail_envs.make("point")
    for learner, other in ((PPO, TD3), (TD3, PPO)):
        config = DEFAULTS["point"][learner.name]["cpu"].config
        hyper = DEFAULTS["point"][learner.name]["cpu"].hyperparameters
        assert type(hyper) is learner.hyperparameters and hyper.validate(env.action_size, config) is hyper
        with pytest.raises(ValueError, match=f"the learner {learner.name} takes {learner.hyperparameters.__name__}, "):
            other.hyperparameters().validate(env.action_size, config)
    own = TD3.hyperparameters().as_dict().keys() - Hyperparameters().as_dict().keys()
    assert own == {"epsilon", "tau", "target_noise", "discriminator_horizon", "negative_p_ht"}


made = functools.cache(hgail_envs.make)


def test_every_task_of_the_package_has_defaults_on_either_platform_that_it_can_be_made_and_trained_with():
    assert set(DEFAULTS) == set(hgail_envs.TASKS)
    for task, learner, platform in itertools.product(DEFAULTS, LEARNERS, ("cpu", "gpu")):
        preset = task_preset(hgail_envs.find_class(task), platform, learner=learner)
        if (task, learner) != ("tower", "crl"):  # which is refused
            assert preset.config.learner.name == learner
            env = made(task, **preset.task_options)
            preset.config.validate(env)
            applied = METHODS[preset.method].apply(preset)
            applied.hyperparameters.validate(env.action_size, applied.config)


def test_the_paper_s_sizes_are_those_it_tells():
    """Section 5 of the paper: steps, learning rates, batches, covariance."""
    config = PRESETS["paper"].config.replace(**AS_WRITTEN)
    ppo = config.learner
    assert (ppo.policy_phases, ppo.discriminator_phases, ppo.final_learning_rate) == (16, 3, 1.0)
    assert (config.num_envs * 50 / ppo.minibatches, config.discriminator_batch) == (128, 64)
    numbers = PRESETS["paper"].hyperparameters
    assert (numbers.policy_learning_rate, numbers.discriminator_learning_rate) == (1e-3, 4e-4)
    assert numbers.exploration_noise == 1.0
    assert set(AS_WRITTEN) == {"policy_phases"}  # the one departure
