"""What the methods come to on a task that each should solve, or should not."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import FEW_UPDATES
from hgail_envs.base import TrainingDefaults
from hgail_envs.point import Point
from hgail_envs.tasks.push import Push
from hgail_jax import (
    METHODS,
    PPO,
    PRESETS,
    TD3,
    Config,
    Hyperparameters,
    Preset,
    init_state,
    make_policy,
    phase_table,
    rollout,
)
from hgail_jax.config import REWARDS, STRATEGIES
from hgail_jax.learner import DISCRIMINATOR, POLICY, PRETRAIN
from hgail_jax.play.recording import record
from hgail_jax.seeds import compile_train_step, init_seeds, init_sweep, seed_keys, split_sweep
from hgail_jax.settings.defaults import DEFAULTS, SHARED, task_preset
from hgail_jax.trainer.train_options import TrainOptions, choose, plan

SEEDS = 2
SMALL = Config(
    num_envs=128,
    learner=PPO(pretrain_policy_minibatches=100, pretrain_policy_batch=256, pretrain_discriminator_minibatches=100),
    discriminator_batch=256,
    best_episodes=100,
    policy_hidden=(32, 32),
    discriminator_hidden=(64, 64),
)
HYPER = Hyperparameters(policy_learning_rate=1e-3, discriminator_learning_rate=5e-4)


class Line(Point):
    """A point on a line: who stands still, or walks at random, is at its goal in one episode of five."""

    episode_length = 20
    feature_size = goal_size = action_size = 1
    controllers = {"straight": lambda seen: jnp.clip(20.0 * (seen[..., 1:] - seen[..., :1]), -1.0, 1.0)}  # noqa: RUF012

    def reset_physics(self, rng):
        return jnp.zeros(1)

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (1,), minval=-0.3, maxval=0.3)


def train(config, states):
    """Returns the success rates after each round, `[rounds + 1, settings * seeds]`, and the states."""
    step = compile_train_step(Line(), config, states, phase_table(config)[0])
    success = []
    for row in phase_table(config):
        states, metrics = step(states, row)
        success.append(np.asarray(metrics.evaluation.success))
    return np.array(success), states


def policies_after_an_update_of_each_kind(config, settings, demonstrations):
    """Returns all parameters of the policy for each of the settings, as one array."""
    phases, updates = phase_table(config), config.learner.phase_updates()

    @jax.jit
    def learnt(hyper):
        rng = jax.random.key(0)
        state = init_state(Line(), config, hyper, rng, demonstrations=demonstrations)
        given = rollout(Line(), make_policy(Line(), config, state, 1.0), rng, config.num_envs)
        for phase in (PRETRAIN, DISCRIMINATOR, POLICY):
            if phase in phases:
                state, _ = updates[phase](Line(), config, state, given, jax.random.fold_in(rng, phase))
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(state.learner.actor_critic["policy"])])

    return [np.asarray(learnt(setting.as_arrays())) for setting in settings]


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=() if name == "gcsl" else pytest.mark.slow)
        for name, method in METHODS.items()
        if "ppo" in method.learners
    ],
)
def test_options_without_effect_are_those_that_leave_the_policy_as_it_is(method):
    changes = {
        "p_ht": {"p_ht": 0.4},
        "strategy": {"strategy": STRATEGIES["final"]},
        "reward": {"reward": REWARDS["r3"]},
        "standardize_reward": {"standardize_reward": False},
        "bc_weight": {"bc_weight": 2.0},
        "environment_reward": {"environment_reward": 0.5},
    }
    small = SMALL.replace(num_envs=8, rounds=1, bc_batch=32, **FEW_UPDATES)
    preset = METHODS[method].apply(Preset(small, HYPER))
    settings = [preset.hyperparameters.replace(**change) for change in ({}, *changes.values())]
    demonstrations = record(Line(), "line", 4).samples(Line()) if method == "gail-demo" else None
    policies = policies_after_an_update_of_each_kind(preset.config, settings, demonstrations)
    unchanged = {name for name, policy in zip(changes, policies[1:], strict=True) if (policy == policies[0]).all()}
    if method == "hgail-no":  # which --p-ht changes, and then --strategy too
        unchanged.remove("strategy")
    without = dataclasses.replace(preset, config=small.replace(pretrain=False))
    if METHODS[method].apply(without).config == preset.config:
        unchanged.add("pretrain")
    assert unchanged == set(METHODS[method].without_effect)


@pytest.mark.slow
def test_hindsight_is_what_teaches_from_scratch():
    """HGAIL and HGAIL without hindsight, from scratch, in one program: they differ in a probability alone."""
    presets = [METHODS[name].apply(Preset(SMALL, HYPER)) for name in ("hgail", "hgail-no")]
    assert presets[0].config == presets[1].config
    config = SMALL.replace(pretrain=False, rounds=8)
    settings = [preset.hyperparameters for preset in presets]
    success, _ = train(config, init_sweep(Line(), config, settings, seed_keys(0, SEEDS)))
    with_it, without = split_sweep(success.T, 2)[:, :, -1]
    assert success[0].max() <= 0.3
    assert with_it.min() >= 0.9
    assert without.max() <= 0.4


@pytest.mark.slow
def test_adversarial_imitation_keeps_what_demonstrations_taught():
    """GAIL from 20 demonstrations: success is 1 after the pre-training, and it stays there."""
    preset = METHODS["gail-demo"].apply(Preset(SMALL, HYPER))
    config = preset.config.replace(bc_batch=0, rounds=3)
    samples = record(Line(), "line", 20).samples(Line())
    success, states = train(config, init_seeds(Line(), config, preset.hyperparameters, seed_keys(0, SEEDS), samples))
    assert success[0].min() >= 0.95
    assert success.mean() >= 0.9
    for seed in range(SEEDS):  # who demonstrates does not change
        jax.tree.map(lambda kept, given, i=seed: np.testing.assert_array_equal(kept[i], given), states.expert, samples)


@pytest.mark.slow
def test_the_best_episodes_so_far_teach():
    """Not every seed finds good ones in so few rounds: 16 of them together do."""
    preset = METHODS["gasil"].apply(Preset(SMALL.replace(num_envs=64), HYPER))
    config = preset.config.replace(rounds=8)
    success, states = train(config, init_seeds(Line(), config, preset.hyperparameters, seed_keys(0, 16)))
    assert success[0].mean() <= 0.25
    assert success[-3:].mean() >= success[0].mean() + 0.1
    # No policy succeeds in more than 20 steps, nor, as it starts, in more than the 14 after the first strides.
    assert (np.asarray(states.expert.returns) >= -10).all()


# Methods and learners


@pytest.mark.parametrize(
    ("method", "learner", "message"),
    [
        ("ppo", "td3", "this method has no learner td3; choose from ppo"),
        ("gcsl", "td3", "this method has no learner td3; choose from ppo"),
        ("her", "ppo", "this method has no learner ppo; choose from td3"),
    ],
)
def test_a_learner_that_a_method_does_not_have_is_refused(method, learner, message):
    preset = Preset(Config(learner={"ppo": PPO, "td3": TD3}[learner]()))
    with pytest.raises(ValueError, match=message):
        METHODS[method].apply(preset)
    with pytest.raises(ValueError, match=f"learner of the method {method}"):
        choose("point", "cpu", method, "parallel", learner)


def test_off_policy_methods_change_what_they_differ_in_and_nothing_else():
    preset = DEFAULTS["slide"]["td3"]["gpu"]
    papers = {"goal_jitter": 0.0, "shuffled_goals": 0.0, "negative_p_ht": 0.0, "negative_weight": 1.0}
    expected = {
        "hgail": ({}, {}),
        "hgail-no": ({}, {"p_ht": 0.0} | papers),
        "gail-demo": (
            {"expert_source": "demonstrations", "training_goals": False, "gradient_penalty": 10.0},
            {"p_ht": 0.0, "bc_weight": 0.0, "environment_reward": 0.0} | papers,
        ),
        "gasil": (
            {"expert_source": "best", "training_goals": False},
            {"p_ht": 0.0, "environment_reward": 0.0} | papers,
        ),
        "her": ({"discriminator_minibatches": 0}, {"environment_reward": 1.0}),
    }
    assert set(expected) == {name for name, method in METHODS.items() if "td3" in method.learners}
    for name, (sizes, scalars) in expected.items():
        applied = METHODS[name].apply(preset)
        assert applied.config == preset.config.replace(**sizes)
        assert applied.hyperparameters == preset.hyperparameters.replace(**scalars)
        assert applied.task_options == preset.task_options


def test_on_policy_methods_change_what_they_differ_in_and_nothing_else():
    """A method that clones has a batch to clone, of the preset's size or its own, the larger."""
    hyper = Hyperparameters(p_ht=0.7, bc_weight=0.3, ppo_weight=0.2, environment_reward=0.4)
    few, many = (Preset(Config(PPO(bc_batch=count), rounds=3), hyper) for count in (8, 2048))
    expected = {
        "hgail": ({}, {}),
        "hgail-no": ({}, {"p_ht": 0.0}),
        "gail-demo": (
            {"expert_source": "demonstrations", "training_goals": False, "bc_batch": 512},
            {"bc_weight": 1.0},
        ),
        "gasil": ({"expert_source": "best", "training_goals": False}, {}),
        "ppo": (
            {"pretrain": False, "discriminator_phases": 0, "bc_batch": 0, "training_goals": False},
            {"environment_reward": 1.0, "ppo_weight": 1.0},
        ),
        "gcsl": ({"discriminator_phases": 0, "bc_batch": 512}, {"ppo_weight": 0.0, "environment_reward": 1.0}),
    }
    assert set(expected) == {name for name, method in METHODS.items() if "ppo" in method.learners}
    for name, (sizes, scalars) in expected.items():
        for preset in (PRESETS["parallel"], few, many):
            raised = sizes | ({"bc_batch": 2048} if preset is many and sizes.get("bc_batch") else {})
            applied = METHODS[name].apply(preset)
            assert applied.config == preset.config.replace(**raised)
            assert applied.hyperparameters == preset.hyperparameters.replace(**scalars)


class HeavyPush(Push):
    """A user's task that extends one of the package's, and so has its settings."""


OWN: dict = {
    "ppo": {"cpu": TrainingDefaults({"num_envs": 8}, {"strategy": 1, "reward": 2, "standardize_reward": False})}
}


class OwnSizes(Push):
    """One with its own settings, for PPO alone."""

    training: ClassVar = OWN


class OwnPoint(Point):
    """One without an arm, which is made at once."""

    training: ClassVar = OWN


def test_a_task_s_own_settings_stay_where_no_option_says_otherwise():
    task = f"{__name__}:OwnPoint"
    own = plan(TrainOptions(task=task), "cpu").hyperparameters
    assert (own.strategy, own.reward, own.standardize_reward) == (1, 2, False)
    given = plan(TrainOptions(task=task, strategy="future", reward="r1"), "cpu").hyperparameters
    assert (given.strategy, given.reward) == (STRATEGIES["future"], REWARDS["r1"])
    assert plan(TrainOptions(task=task, standardize_reward=True), "cpu").hyperparameters.standardize_reward is True


def test_a_student_has_its_settings_on_a_users_task_too():
    extended, own = (task_preset(task, "gpu", learner="student") for task in (HeavyPush, OwnSizes))
    assert extended == DEFAULTS["push"]["student"]["gpu"] and own == SHARED["student"]["gpu"] != extended
    assert (own.method, own.config.learner.name, own.config.num_envs) == ("camera", "student", 512)
    small = dataclasses.replace(extended.config.learner, updates=8, batch=64)
    assert task_preset(Push, "cpu", learner="student").config == extended.config.replace(learner=small, num_envs=16)


@pytest.mark.parametrize(
    ("task", "method", "preset", "given", "chosen"),
    [
        ("push", "hgail", "parallel", None, "td3"),
        ("push", "hgail", "paper", None, "ppo"),
        ("push", "ppo", "parallel", None, "ppo"),
        ("push", "hgail", "parallel", "ppo", "ppo"),
        ("pick-and-place", "gasil", "parallel", None, "td3"),
        ("slide", "hgail", "parallel", None, "td3"),
        ("reach", "hgail", "parallel", None, "ppo"),
        ("reach", "her", "parallel", None, "td3"),
        ("reach", "hgail", "parallel", "td3", "td3"),
        ("hgail_envs.tasks.grasp:Grasp", "gail-demo", "parallel", None, "ppo"),
        ("tests.hgail_jax.test_methods:HeavyPush", "hgail", "parallel", None, "td3"),
        ("tests.hgail_jax.test_methods:OwnSizes", "hgail", "parallel", None, "ppo"),
    ],
)
def test_the_learner_is_the_one_named_or_else_the_task_s_or_the_method_s(task, method, preset, given, chosen):
    assert choose(task, "cpu", method, preset, given).config.learner.name == chosen


@pytest.mark.parametrize(
    ("task", "platform", "learner", "randomize", "method"),
    [
        ("push", "gpu", None, "none", "hgail"),
        ("push", "gpu", None, "full", "her"),
        ("slide", "cpu", None, "none", "hgail"),
        ("slide", "gpu", None, "none", "hgail"),
        ("slide", "cpu", "ppo", "none", "hgail"),
        ("grasp", "cpu", "td3", "none", "her"),
        ("grasp", "gpu", "td3", "none", "hgail"),
        ("stack", "gpu", None, "none", "hgail"),
        ("tower", "gpu", None, "none", "hgail"),
        ("reach", "gpu", None, "none", "hgail"),
        ("reach", "gpu", "td3", "none", "hgail"),
        ("reach", "cpu", "td3", "none", "her"),
    ],
)
def test_a_task_s_default_method_is_the_one_that_trains_it(task, platform, learner, randomize, method):
    chosen = choose(task, platform, None, "parallel", learner, randomize)
    assert chosen.method == method
    weight, minibatches = chosen.hyperparameters.environment_reward, chosen.config.discriminator_minibatches
    assert (weight == 1.0) == (minibatches == 0) == (method == "her")


def test_an_unknown_learner_is_refused():
    with pytest.raises(ValueError, match="learner"):
        choose("point", "cpu", "hgail", "parallel", "sac")


@pytest.mark.parametrize(
    ("task", "changes", "trained"),
    [
        ("slide", {}, True),
        ("slide", {"environment_reward": 0.5}, True),
        ("slide", {"method": "her"}, False),
        ("push", {}, True),
        ("push", {"method": "her"}, False),
        ("push", {"method": "gasil"}, True),
        ("slide", {"method": "gasil"}, True),
        ("push", {"learner": "ppo", "environment_reward": 1.0}, True),
    ],
)
def test_off_policy_a_discriminator_is_trained_where_it_has_a_say(task, changes, trained):
    run = plan(TrainOptions(task=task, impl="c", **changes), "gpu")
    assert (run.config.discriminator_minibatches > 0) == trained
    assert trained == (run.hyperparameters.environment_reward < 1.0) or run.config.learner.name == "ppo"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "her", "environment_reward": 0.5}, "--environment-reward is decided by the method her"),
        ({"method": "ppo", "environment_reward": 0.5}, "--environment-reward is decided by the method ppo"),
        (
            {"task": "reach", "learner": "td3", "environment_reward": 0.5},
            "is decided by the method her, the task's default",
        ),
        (
            {"learner": "td3", "environment_reward": 1.0},
            "discriminator has no say: that is the method her",
        ),
        ({"learner": "td3", "reward": "r2"}, "--reward changes nothing for the learner td3"),
        ({"method": "her", "pretrain": False}, "--no-pretrain changes nothing for the learner td3"),
        ({"learner": "td3", "standardize_reward": False}, "--no-standardize-reward changes nothing for the learner"),
        ({"learner": "td3", "method": "gasil", "p_ht": 0.5}, "--p-ht changes nothing for the method gasil"),
        ({"learner": "td3", "preset": "paper"}, "the preset paper is of the learner ppo"),
        ({"method": "her", "preset": "paper"}, "the preset paper is of the learner ppo"),
    ],
)
def test_options_that_a_method_or_a_learner_leaves_no_room_for_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        plan(TrainOptions(**{"task": "point"} | changes), "cpu")
