import dataclasses

import pytest

import hgail_envs
from hgail_jax import PRESETS, TrainOptions
from hgail_jax.defaults import AS_WRITTEN, task_preset
from hgail_jax.seeds import evaluation_episodes
from hgail_jax.trainer.options import plan


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
    assert evaluation_episodes(run.config, run.evaluation_episodes) == episodes
    assert run.seeds == 8


def test_a_task_changes_the_default_preset_and_no_other():
    grasp = hgail_envs.find_class("grasp")
    changed = task_preset(grasp, "cpu")
    assert changed.config.bc_batch == 2048
    assert changed.hyperparameters.action_std == (0.2, 0.2, 0.2, 0.5)
    assert changed.config.discriminator_minibatches == PRESETS["parallel"].config.discriminator_minibatches
    assert task_preset(grasp, "cpu", "paper") == PRESETS["paper"]
    assert PRESETS["parallel"].config.bc_batch == 0  # and not in place
    with pytest.raises(ValueError, match="preset is 'tiny'; choose from parallel, paper"):
        task_preset(grasp, "cpu", "tiny")


def test_the_paper_s_sizes_are_those_it_tells():
    """Section 5 of the paper: steps, learning rates, batches, covariance."""
    config = dataclasses.replace(PRESETS["paper"].config, **AS_WRITTEN)
    assert (config.policy_phases, config.discriminator_phases, config.final_learning_rate) == (16, 3, 1.0)
    assert (config.num_envs * 50 / config.minibatches, config.discriminator_batch) == (128, 64)
    numbers = PRESETS["paper"].hyperparameters
    assert (numbers.policy_learning_rate, numbers.discriminator_learning_rate) == (1e-3, 4e-4)
    assert numbers.action_std == 1.0
    assert set(AS_WRITTEN) == {"policy_phases"}  # the one departure
