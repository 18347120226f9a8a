"""Another project's learner on this project's tasks."""

import sys
from types import ModuleType, SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State

from experiments.bench import contrastive
from experiments.bench.contrastive import JaxGcrlTask, success_rate, train_contrastive
from hgail_envs.fetch.reach import Reach


@pytest.mark.parametrize("task", ["reach", "push"])
def test_the_goal_is_about_what_the_indices_name(task):
    learnt = JaxGcrlTask(task, "c", substeps=8, worlds=1)
    state = jax.jit(learnt.reset)(jax.random.key(0))
    assert state.obs.shape == (learnt.observation_size,) == (learnt.state_dim + 3,)
    np.testing.assert_array_equal(state.obs[learnt.state_dim :], state.info["desired_goal"][:3])
    for _ in range(3):
        state = jax.jit(learnt.step)(state, jnp.ones(learnt.action_size))
    physics = state.pipeline_state
    position = physics.gripper_position if task == "reach" else learnt.env.object_position(physics)
    np.testing.assert_array_equal(state.obs[learnt.goal_indices], position)
    assert state.metrics["dist"] == pytest.approx(np.linalg.norm(position - state.obs[learnt.state_dim :]), rel=1e-6)
    assert state.metrics["success"] == (state.metrics["dist"] <= 0.05)


def test_a_goal_that_is_more_than_a_position_is_refused():
    with pytest.raises(ValueError, match="task is 'grasp'; choose from reach, push"):
        JaxGcrlTask("grasp", "c", 8, 1)


def test_a_policy_is_tested_for_whole_episodes(monkeypatch):
    monkeypatch.setattr(contrastive, "EPISODES", 8)
    learnt = JaxGcrlTask("reach", "c", substeps=4, worlds=8)
    assert success_rate(learnt, Reach.controllers["proportional"]) == 1.0
    learnt.env.episode_length = 1  # nothing is in reach of one step
    assert success_rate(learnt, Reach.controllers["proportional"]) < 0.5


@pytest.mark.parametrize(("success_at", "rate"), [(3, 1.0), (1, 0.0), (4, 0.0)])
def test_success_is_that_of_the_last_step(success_at, rate):
    """In a task that only counts its steps, of which an episode has three."""

    def state(steps):
        metrics = {"success": (steps == success_at).astype(jnp.float32)}
        return State(None, steps[None], jnp.zeros(()), jnp.zeros(()), metrics)

    counting = SimpleNamespace(
        env=SimpleNamespace(episode_length=3),
        reset=lambda rng: state(jnp.zeros(())),
        step=lambda before, action: state(before.obs[0] + action[0]),
    )
    assert success_rate(counting, jnp.ones_like) == rate


class Learner:
    """As much of JaxGCRL's learner as is used: it knows how to reach, and is tested on and on."""

    def __init__(self, unroll_length, min_replay_size):
        self.unroll_length, self.min_replay_size = unroll_length, min_replay_size

    def train_fn(self, run, task, eval_task, progress_fn):
        assert (run.num_envs, run.seed, run.episode_length, self.unroll_length) == (2, 3, 50, 50)
        epoch = (run.total_env_steps - self.min_replay_size * run.num_envs) // run.num_evals
        assert epoch == 2 * 50 * 4
        for index in range(1, 100):
            make_policy = lambda gain: lambda seen, _: (gain * Reach.controllers["proportional"](seen), None)  # noqa: E731
            gain = 0.0 if index == 1 else 3.0
            progress_fn(epoch * index, {"training/walltime": 10.0 * index}, make_policy, gain, task, do_render=False)
        pytest.fail("nothing ended it")


@pytest.fixture
def jaxgcrl(monkeypatch):
    agents = ModuleType("jaxgcrl.agents")
    agents.CRL = Learner
    monkeypatch.setitem(sys.modules, "jaxgcrl", ModuleType("jaxgcrl"))
    monkeypatch.setitem(sys.modules, "jaxgcrl.agents", agents)
    for name in contrastive._ABSENT:
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(contrastive, "EPISODES", 8)


def test_training_goes_on_until_its_tests_are_enough(jaxgcrl):
    tests = []
    train_contrastive(JaxGcrlTask("reach", "c", 4, 8), 2, 3, lambda *test: tests.append(test) or len(tests) == 3)
    assert tests == [(400, 10.0, pytest.approx(0.0, abs=0.3)), (800, 20.0, 1.0), (1200, 30.0, 1.0)]


def test_what_jaxgcrl_imports_and_does_not_need_may_be_absent(tmp_path, monkeypatch):
    for name in ("jaxgcrl", "jaxgcrl.agents", *contrastive._ABSENT):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))  # so that it is put back
        del sys.modules[name]
    (tmp_path / "jaxgcrl").mkdir()
    (tmp_path / "jaxgcrl" / "agents.py").write_text(
        "from brax.v1 import envs\n"
        "from wandb_osh.hooks import TriggerWandbSyncHook\n"
        "class CRL:\n"
        "    annotated = envs.Env, envs.State, envs.Wrapper\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert contrastive._import_learner().annotated[1] is State
