"""The page of `make demo`: its tasks and policies are Python's, and a visitor's browser runs them."""

import functools
import gzip
import http.server
import json
import shutil
import subprocess
import threading

import jax
import numpy as np
import pytest

import hgail_envs
from docs._generate import demo
from hgail_envs.randomized import randomize
from hgail_jax.io.policy import load_policy
from tests.support import ROOT

POLICIES = sorted(path.stem for path in (ROOT / "assets" / "policies").glob("*.npz"))
# The seed of the starts. From many of slide's a ten-millionth of a radian more grows to a millimetre at the hit, in
# Python's engine too.
SEED = 5
# Targets that a visitor chooses, and the task's own for a cube that is at the other end of the table.
TARGETS = {
    "reach": [1.42, 0.85, 0.62],
    "grasp": [1.3, 0.65, 0.425],
    "push": [1.42, 0.85, 0.425],
    "pick-and-place": [1.4, 0.85, 0.65],
    "slide": [0.95, 0.75, 0.42],
}

_BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_PATIENCE = 120_000  # milliseconds: a browser without a GPU draws slowly


def task_of(policy):
    return policy.removesuffix("-robust")


def path_of(policy):
    return str(ROOT / "assets" / "policies" / f"{policy}.npz")


@functools.cache
def opened(policy):
    """Returns a policy and its task, nominal, with the observations that the policy was trained on."""
    read = load_policy(path_of(policy))
    env = hgail_envs.make(task_of(policy), impl="c")
    return read, env, randomize(env, read.randomization.nominal())


def start_of(state):
    physics = getattr(state.pipeline_state, "true", state.pipeline_state)
    numbers = {"qpos": physics.qpos, "qvel": physics.qvel, "goal": state.info["desired_goal"]}
    return {name: np.asarray(value, float).tolist() for name, value in numbers.items()}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The page, built; skips where it cannot be."""
    try:
        return demo.build(tmp_path_factory.mktemp("demo") / "site")
    except demo.UnavailableError as error:
        pytest.skip(str(error))


def in_node(site, command, given):
    done = subprocess.run(
        ["node", str(site / "headless.js"), command], input=json.dumps(given), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def episode(policy):
    """Returns Python's episode: its start, observations, actions, and outcome."""
    act, _, env = opened(policy)
    state, step = jax.jit(env.reset)(jax.random.key(SEED)), jax.jit(env.step)
    start, observations, actions = start_of(state), [np.asarray(state.obs)], []
    for _ in range(env.episode_length):
        actions.append(act(observations[-1]))
        state = step(state, actions[-1])
        observations.append(np.asarray(state.obs))
    return start, np.array(observations), np.array(actions), env.outcome(state, state)


@pytest.fixture(scope="module")
def episodes(site):
    """Python's episode of each policy, and the same starts and actions in Node."""
    pythons = {policy: episode(policy) for policy in POLICIES}
    given = [
        {
            "task": task_of(policy),
            "policy": path_of(policy),
            "start": start,
            "actions": actions.tolist(),
            "asked": observations[:-1].tolist(),
        }
        for policy, (start, observations, actions, _) in pythons.items()
    ]
    return {
        policy: (pythons[policy], found)
        for policy, found in zip(POLICIES, in_node(site, "replay", given), strict=True)
    }


@pytest.mark.parametrize("policy", POLICIES)
def test_an_episode_is_that_of_python(episodes, policy):
    (_, observations, actions, outcome), found = episodes[policy]
    np.testing.assert_allclose(found["observations"], observations, atol=1e-4)
    np.testing.assert_allclose(found["answers"], actions, atol=1e-5)
    assert found["achieved"] == bool(outcome.achieved)
    assert found["distance"] == pytest.approx(float(outcome.distance_l2), abs=1e-4)


@pytest.mark.parametrize("policy", POLICIES)
def test_the_arm_starts_where_python_s_does(episodes, policy):
    _, env, _ = opened(policy)
    found = episodes[policy][1]
    np.testing.assert_allclose(found["gripper"], env.initial_gripper_position, atol=1e-6)
    np.testing.assert_allclose(found["qpos"], env._initial_physics.qpos, atol=1e-6)


@pytest.mark.parametrize("policy", POLICIES)
def test_targets_are_in_the_bounds_of_the_page(episodes, policy):
    _, env, _ = opened(policy)
    goals = np.asarray(jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 256)).info["desired_goal"])[:, :3]
    low, high = np.array(episodes[policy][1]["bounds"])
    assert (goals >= low - 1e-6).all()
    assert (goals <= high + 1e-6).all()
    np.testing.assert_allclose(goals.min(0), low, atol=0.02)
    np.testing.assert_allclose(goals.max(0), high, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("policy", POLICIES)
def test_as_many_episodes_succeed_as_in_python(site, policy):
    act, _, env = opened(policy)

    def step(carry, _):
        action = act(carry[0].obs, jax.numpy)
        return (env.step(carry[0], action), action), None

    def lift(carry, _):
        action = env.lift_test_action(carry[1])
        return (env.step(carry[0], action), action), None

    def succeeds(state):
        end, _ = jax.lax.scan(step, (state, jax.numpy.zeros(env.action_size)), length=env.episode_length)
        lifted, _ = jax.lax.scan(lift, end, length=env.lift_test_steps)
        return env.outcome(end[0], lifted[0]).success

    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))
    there = np.asarray(jax.jit(jax.vmap(succeeds))(states))
    starts = [start_of(jax.tree.map(lambda leaf, i=i: leaf[i], states)) for i in range(len(there))]
    (here,) = in_node(site, "evaluate", [{"task": task_of(policy), "policy": path_of(policy), "starts": starts}])
    print(f"{policy}: {np.mean(here):.3f} in Node, {there.mean():.3f} in Python")
    assert abs(np.mean(here) - there.mean()) <= 0.02
