"""Runs whose episodes are randomised, and policies of them."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs.point import Point
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_jax import (
    PPO,
    TD3,
    Config,
    Hyperparameters,
    Preset,
    Trainer,
    init_state,
    load_policy,
    phase_table,
    train_step,
)
from hgail_jax.cli import play
from hgail_jax.cli import train as run
from hgail_jax.io.policy import save_policy
from hgail_jax.settings.defaults import DEFAULTS
from tests.hgail_jax.trainer.stand_in import train_without_a_compiler
from tests.support import make_runs_tiny, refused

SMALL = Randomization(delay=(0, 3), step_size=(0.6, 1.4), goal_offset=0.02, robot_noise=0.01, history=2, ramp=0.5)
SIZES = ["--task", "point", "--method", "ppo", "--seeds", "2", "--num-envs", "4", "--rounds", "1", "--out", "run"]


@pytest.fixture(autouse=True)
def tiny(monkeypatch, tmp_path):
    make_runs_tiny(monkeypatch)
    train_without_a_compiler(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(LEVELS, "small", SMALL)  # without a model, which the point has not
    monkeypatch.setitem(LEVELS, "other", dataclasses.replace(SMALL, goal_offset=0.01))


def resume(level, capsys):
    with pytest.raises(SystemExit) as ended:
        run.main([*SIZES[:-2], "--resume", "run", "--randomize", level])
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_a_run_that_only_remembers_is_evaluated_once(capsys):
    run.main([*SIZES, "--randomize", "none-history"])
    assert "nominal" not in capsys.readouterr().out
    assert load_policy("run/policies/seed-1.npz").randomization == Randomization(history=1)


def test_a_randomised_run_says_so_and_resumes_as_such_alone(capsys):
    run.main([*SIZES, "--randomize", "small"])
    assert "nominal: success" in capsys.readouterr().out
    config, summary = (json.loads((Path("run") / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["options"]["randomize"] == "small"
    assert Randomization.from_json(config["physics"]["randomization"]) == SMALL
    assert len(summary["nominal_success_rate"]["per_seed"]) == 2
    policy = load_policy("run/policies/seed-1.npz")
    assert policy.randomization == SMALL
    assert policy.observation_size == 6 + 2 * (3 + 3)
    assert "physics.randomization is given there and absent here" in resume("none", capsys)
    assert "physics.randomization.goal_offset is 0.02 there and 0.01 here" in resume("other", capsys)
    run.main([*SIZES[:-2], "--resume", "run", "--randomize", "small"])
    assert "run is complete" in capsys.readouterr().out


def test_a_round_of_a_randomised_task_can_be_traced():
    """The runs above have rounds of another making."""
    env, config = RandomizedEnv(Point(), SMALL), Config(PPO(), num_envs=4)
    state = jax.eval_shape(functools.partial(init_state, env, config), Hyperparameters(), jax.random.key(0))
    after, metrics = jax.eval_shape(functools.partial(train_step, env, config), state, phase_table(config)[0])
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    assert metrics.evaluation.success.shape == ()


@pytest.mark.slow
def test_a_policy_of_td3_is_shown_the_actions_on_their_way(monkeypatch):
    monkeypatch.setitem(LEVELS, "known", dataclasses.replace(SMALL, history=0, known_delay=3))
    few = TD3(rollouts=1, updates=2, batch=8, buffer_episodes=8, critics=1)
    tiny = Preset(Config(learner=few, policy_hidden=(8,), discriminator_minibatches=0), TD3.hyperparameters())
    monkeypatch.setitem(DEFAULTS["point"], "td3", {"cpu": tiny})
    run.main([*SIZES, "--method", "her", "--learner", "td3", "--randomize", "known"])
    policy = load_policy("run/policies/seed-1.npz")
    assert policy.randomization == LEVELS["known"]
    assert policy.squash
    assert policy.observation_size == 6 + 3 * (1 + 3)
    assert {len(vars(policy)["mean"]), len(policy.layers[0][0])} == {policy.observation_size}


def test_another_size_is_another_run(monkeypatch, capsys):
    run.main([*SIZES, "--randomize", "small"])
    monkeypatch.setattr(Point, "vary_model", lambda self, physics, factors: physics)
    monkeypatch.setitem(LEVELS, "narrow", dataclasses.replace(SMALL, hand_width=(0.7, 1.1)))
    assert "physics.randomization.hand_width is [1.0, 1.0] there and [0.7, 1.1] here" in resume("narrow", capsys)


def test_a_plain_run_is_what_it_was():
    plain = Trainer(task="point", seeds=2, num_envs=4, rounds=1)
    assert set(plain.run.identity()["physics"]) == {"impl", "substeps"}
    assert type(plain.run.env) is Point


@pytest.mark.parametrize(("level", "expected"), [(None, LEVELS["mild-history"]), ("full", LEVELS["full-history"])])
def test_a_policy_is_played_as_it_was_trained_unless_a_level_is_given(tmp_path, shipped_policy, level, expected):
    plain, more = load_policy(shipped_policy), 3 * (4 + 6)
    layers = ((np.concatenate([np.zeros((more, 64), np.float32), plain.layers[0][0]]), plain.layers[0][1]),)
    policy = dataclasses.replace(
        plain,
        mean=np.append(np.zeros(more, np.float32), plain.mean),
        std=np.append(np.ones(more, np.float32), plain.std),
        layers=layers + plain.layers[1:],
        randomization=LEVELS["mild-history"],
    )
    save_policy(tmp_path / "reach.npz", policy)
    env, loaded = play._load("reach", tmp_path / "reach.npz", level)
    assert isinstance(env, RandomizedEnv)
    assert env.randomization == expected
    assert loaded.observation_size == env.observation_size == 9 + more


def test_an_unknown_level_is_refused_in_one_line(capsys):
    for main, arguments in ((run.main, [*SIZES, "--randomize", "wild"]), (play.main, ["--randomize", "wild"])):
        error = refused(main, arguments, "choose from none, other-arms, mild, full", capsys)
        assert "wild" in error
    assert not Path("run").exists()
