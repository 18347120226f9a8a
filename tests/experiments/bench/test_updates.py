"""The off-policy learner's update by parts, and the bare loop beside it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.bench import __main__ as bench
from experiments.bench import speed
from experiments.bench import training as training_module
from experiments.bench.optimiser import Learnt, bare_optimiser, random_batches, step
from experiments.bench.training import Training
from experiments.bench.updates import UpdateParts, update_fractions
from experiments.bench.workload import Workload
from hgail_envs import make
from hgail_jax import TD3, Config, Hyperparameters, Phase, Preset
from hgail_jax.buffer import EpisodeBuffer
from hgail_jax.learners import td3
from hgail_jax.networks import dense_layers
from hgail_jax.seeds import init_seeds, seed_keys
from hgail_jax.trainer.options import TrainOptions, plan

HYPER = Hyperparameters(bc_weight=0.0, target_noise=0.1, policy_learning_rate=1e-3, target_rate=0.1)
CONFIG = Config(
    num_envs=4,
    learner=TD3(updates=3, batch=32, buffer_episodes=8, critics=2),
    policy_hidden=(16, 8),
    layer_norm=True,
)


def flat(layers):
    """All numbers of a network in a row."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(layers)])


def test_the_bare_loop_changes_networks_as_the_learner_does():
    env = make("point")
    state = td3.TD3().init(env, CONFIG, jax.random.split(jax.random.key(0)))
    noise = np.random.default_rng(0)  # so that no bias is 0, no scale 1, no action small and no target as its network
    state = state.replace(online=jax.tree.map(lambda leaf: leaf + 0.3 * noise.normal(size=leaf.shape), state.online))
    batches = random_batches(jax.random.key(1), (3, 32), env.observation_size, env.action_size)
    own = td3._Batch(**batches._asdict() | {"weight": jnp.ones((3, 32)), "noise": batches.noise / HYPER.target_noise})
    after, measured = jax.lax.scan(td3._make_step(env, CONFIG, HYPER), state, own)

    networks = [dense_layers(params) for params in (*state.online, *state.target)]
    loop = bare_optimiser(env.observation_size, env.action_size, CONFIG, HYPER, seeds=1)
    learnt, _ = loop.args
    moments = jax.tree.map(lambda leaf: leaf[0], learnt.moments)  # zeros
    clipped = batches._replace(noise=jnp.clip(batches.noise, -0.25, 0.25))
    bare, losses = jax.lax.scan(lambda *args: step(HYPER, *args), Learnt(*networks, moments), clipped)

    np.testing.assert_allclose(losses, measured["value_loss"], rtol=1e-4)
    for found, params, start in zip(bare[:4], (*after.online, *after.target), networks, strict=True):
        found, expected, start = (flat(layers) for layers in (found, dense_layers(params), start))
        moved = np.abs(expected - start).max()
        assert moved > 1e-4
        np.testing.assert_allclose(found, expected, atol=0.02 * moved)


def test_the_bare_loop_takes_each_seed_s_steps():
    learnt, losses = bare_optimiser(6, 3, CONFIG, HYPER, seeds=2)()
    assert losses.shape == (2, 3)
    assert np.unique(np.asarray(losses)).size == 6
    assert [layer[0].shape for layer in learnt.critics] == [(2, 2, 9, 16), (2, 2, 16, 8), (2, 2, 8, 1)]


@pytest.fixture(scope="module")
def parts():
    """An update's parts of two seeds, whose phases are not compiled."""
    env, preset = make("point"), Preset(CONFIG, HYPER)
    states = init_seeds(env, CONFIG, HYPER, seed_keys(0, 2))
    noise = np.random.default_rng(0)
    kept = {name: noise.normal(size=leaf.shape).astype(leaf.dtype) for name, leaf in vars(states.buffer).items()}
    states = states.replace(buffer=EpisodeBuffer(**kept | {"valid": np.ones((2, 8), bool), "added": np.full(2, 8)}))
    workload = SimpleNamespace(env=env, preset=preset, env_steps=4 * env.episode_length)
    training = SimpleNamespace(workload=workload, config=CONFIG, seeds=2, states=states, call=lambda *phases: phases)
    return UpdateParts(training)


def test_the_parts_are_those_of_an_update(parts):
    before = init_seeds(make("point"), CONFIG, HYPER, seed_keys(0, 2)).discriminator
    for name, trains in (("gradient_steps", False), ("all_gradient_steps", True)):
        learner, discriminator, metrics = parts.calls[name]()
        assert learner.steps.tolist() == [3, 3]
        assert ("discriminator_loss" in metrics) == trains
        assert (np.abs(flat(discriminator) - flat(before)).max() > 1e-4) == trains
    assert (parts.calls["update_phase"], parts.calls["rollout_phase"]) == ((Phase.POLICY,), (Phase.PRETRAIN,))


def test_parts_of_an_update_add_up_to_it(parts):
    stepping, policy, gradient, discriminator, rest = 1.0, 0.25, 0.5, 0.125, 0.125
    seconds = {
        "update_phase": stepping + policy + gradient + discriminator + rest,
        "rollout_phase": stepping + policy,
        "gradient_steps": gradient,
        "all_gradient_steps": gradient + discriminator,
        "bare_optimiser": 0.4,
    }
    row = parts.row(seconds)
    assert row["discriminator_seconds"] == pytest.approx(discriminator)
    assert row["gradient_steps_to_bare"] == pytest.approx(0.8)
    assert row["update_env_steps_per_second"] == 2 * 4 * make("point").episode_length / 2.0
    assert update_fractions(row, stepping) == pytest.approx(
        {
            "share_physics": 0.5,
            "share_policy_and_bookkeeping": 0.125,
            "share_gradient_steps": 0.25,
            "share_discriminator": 0.0625,
            "share_rest": 0.0625,
        }
    )
    del seconds["all_gradient_steps"]
    assert parts.row(seconds)["discriminator_seconds"] == 0.0, "there is none"


def test_a_row_steps_all_seeds_environments_in_one_batch_and_each_batch_once(monkeypatch):
    stepped, trained = [], []

    class Stepping:
        def __init__(self, workload):
            stepped.append(workload.num_envs)
            self.calls = {"raw": lambda: None}
            self.row = lambda seconds: {"raw_env_steps_per_second": workload.env_steps / seconds["raw"]}

    class Parts(UpdateParts):
        def __init__(self, training):
            self.calls = dict.fromkeys(("update_phase", "rollout_phase", "gradient_steps", "bare_optimiser"))
            self._env_steps = 1

    def training(workload, seeds):
        trained.append((workload.num_envs, workload.worlds, seeds))
        return SimpleNamespace(compile_seconds=1.0)

    taken = {"raw": 1.0, "update_phase": 8.0, "rollout_phase": 4.0, "gradient_steps": 3.0, "bare_optimiser": 2.0}
    monkeypatch.setattr(speed, "Stepping", Stepping)
    monkeypatch.setattr(speed, "UpdateParts", Parts)
    monkeypatch.setattr(speed, "Training", training)
    monkeypatch.setattr(speed, "seconds_side_by_side", lambda calls: {name: taken[name] for name in calls})
    speed._stepping_row.cache_clear()
    few, many = (Workload("push", "c", count, 8, quick=True) for count in (4, 8))
    rows = [speed.update_row(few, 1), speed.update_row(few, 2), speed.update_row(many, 1)]
    speed._stepping_row.cache_clear()
    assert stepped == [4, 8]
    assert trained == [(4, 4, 1), (4, 8, 2), (8, 8, 1)]
    assert [(row["seeds"], row["num_envs_per_seed"]) for row in rows] == [(1, 4), (2, 4), (1, 8)]
    assert [row["share_physics"] for row in rows] == [1 / 8] * 3


def test_more_seeds_have_the_task_s_environments_and_more_environments_one_seed(monkeypatch):
    measured = []
    monkeypatch.setattr(speed, "update_row", lambda workload, seeds: measured.append((seeds, workload.num_envs)) or {})
    options = bench.Options(section=("updates",), task=("push",), seeds=(1, 2), num_envs=(64, 256))
    assert [row["section"] for row, _ in bench.measure(options)] == ["updates"] * 3
    assert measured == [(1, 64), (2, 64), (1, 256)]


@pytest.mark.parametrize(
    ("task", "phases"),
    [("push", [Phase.POLICY] * 2), ("grasp", [Phase.POLICY] * 4 + [Phase.DISCRIMINATOR])],
)
def test_a_round_has_the_updates_of_the_task_s_own_learner(monkeypatch, task, phases):
    rounds = []

    def compile_step(*arguments):
        return lambda states, row: (states, rounds.append(list(row)))

    monkeypatch.setattr(training_module, "compile_train_step", compile_step)
    training = Training(Workload(task, "c", 4, 8, quick=True))
    assert training.updates() == phases
    training.call(*training.updates())()
    training.call(Phase.POLICY)()
    assert [phase for phase in rounds[0] if phase] == phases
    assert [phase for phase in rounds[1] if phase] == [Phase.POLICY]
    if task == "push":
        assert training.states.buffer.added.tolist() == [64], "the buffer is full"


def test_a_workload_is_trained_as_by_default():
    workload = Workload("slide", "c", 4, 8)
    run = plan(TrainOptions(task="slide", seeds=1, num_envs=4), "cpu")
    assert (workload.preset.config, workload.env.achieved) == (run.config, run.env.achieved)
    assert run.config.discriminator_minibatches == 0, "slide is to tell the default from the table's"
