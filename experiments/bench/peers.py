"""Measures other projects on the same machine; each that is not installed is left out with one line."""

import contextlib
import functools
import importlib
import importlib.util
import os
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

import envs
from envs.fetch.arm import ACCURATE_SUBSTEPS, CONTROL_PERIOD, settle
from envs.scenes import load_scene
from experiments.bench.timing import compile_timed, seconds_per_call
from hgail_jax.presets import defaults

_SECONDS, _QUICK_SECONDS = 10.0, 0.2
_LEARNT = 0.98  # success rate at which stable-baselines3 is stopped
_MOST_STEPS = 60_000


def peer_rows(task: str, quick: bool) -> Iterator[dict]:
    """Yields a row for each peer that is installed; but for JaxGCRL they run on the CPU, on any machine."""
    cpu_peers: list[Callable[[str, bool], Iterator[dict]]] = [rollout_rows, gymnasium_rows, stable_baselines_rows]
    for peer in (jaxgcrl_rows, *cpu_peers):
        cores = {"cpu_cores": os.cpu_count()} if peer in cpu_peers else {}
        try:
            for row in peer(task, quick):
                yield {"task": task, **row, **cores}
        except ImportError as error:
            print(f"left out: {peer.__name__.removesuffix('_rows')} ({error})")


def rollout_rows(task: str, quick: bool) -> Iterator[dict]:
    """Times C MuJoCo on this project's scene, in as many threads as there are cores, with random targets."""
    threads = os.cpu_count() or 1
    for substeps in (ACCURATE_SUBSTEPS, defaults(envs.find_class(task), "cpu").substeps):
        rate = _rollout_rate(task, substeps, threads, 2 if quick else 50)
        yield {"what": f"mujoco.rollout, {threads} threads", "substeps": substeps, "env_steps_per_second": rate}


def _rollout_rate(task: str, substeps: int, threads: int, actions: int) -> float:
    from mujoco import rollout

    model, batch = load_scene(f"fetch/{task}"), 8 * threads
    settled = settle(model)
    model.opt.timestep = CONTROL_PERIOD / substeps
    start = np.zeros(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    mujoco.mj_getState(model, settled, start, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
    targets = np.random.default_rng(0).uniform(-0.15, 0.15, (batch, actions, 3)) + settled.mocap_pos[0]
    pose = np.concatenate([targets, np.broadcast_to(settled.mocap_quat[0], (batch, actions, 4))], axis=-1)
    controls, starts = np.repeat(pose, substeps, axis=1), np.tile(start, (batch, 1))
    datas = [mujoco.MjData(model) for _ in range(threads)]
    spec = int(mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT)
    with rollout.Rollout(nthread=threads) as pool:
        seconds = seconds_per_call(lambda: pool.rollout(model, datas, starts, controls, control_spec=spec)[0])
    return batch * actions / seconds


def gymnasium_rows(task: str, quick: bool) -> Iterator[dict]:
    """Times Gymnasium-Robotics' environment as its users step it, with random actions."""
    import gymnasium
    import gymnasium_robotics

    from experiments.transfer.robots.reference import ENVIRONMENTS

    gymnasium.register_envs(gymnasium_robotics)
    cores = os.cpu_count() or 1
    make = functools.partial(gymnasium.make, ENVIRONMENTS[task])
    sync, parallel = gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv
    for kind, count in ((sync, 1), (parallel, cores), (parallel, 8 * cores)):
        with contextlib.closing(kind([make] * count)) as vector:
            vector.reset(seed=0)
            vector.action_space.seed(0)
            taken, started = 0, time.perf_counter()
            while (seconds := time.perf_counter() - started) < (_QUICK_SECONDS if quick else _SECONDS):
                vector.step(vector.action_space.sample())
                taken += count
        what = f"{ENVIRONMENTS[task]}, {kind.__name__} of {count}"
        yield {"what": what, "substeps": ACCURATE_SUBSTEPS, "env_steps_per_second": taken / seconds}


def stable_baselines_rows(task: str, quick: bool) -> Iterator[dict]:
    """Times stable-baselines3's SAC with HER on the reference, to a success rate of .98 in 100 episodes; reach only."""
    if task != "reach":
        return
    import gymnasium
    import gymnasium_robotics
    import stable_baselines3 as sb3

    from experiments.transfer.robots.reference import ENVIRONMENTS

    gymnasium.register_envs(gymnasium_robotics)
    env, test = gymnasium.make(ENVIRONMENTS[task]), gymnasium.make(ENVIRONMENTS[task])
    learner = sb3.SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [64, 64]},
        gamma=0.95,
        learning_starts=100 if quick else 1000,
        seed=0,
        device="cpu",
    )
    step, seconds, success = 150 if quick else 1000, 0.0, 0.0
    while success < _LEARNT and learner.num_timesteps < (step if quick else _MOST_STEPS):
        started = time.perf_counter()
        learner.learn(step, reset_num_timesteps=False)
        seconds += time.perf_counter() - started
        success = _evaluate(learner, test, 1 if quick else 100)
    yield {
        "what": f"stable-baselines3 {sb3.__version__}, SAC and HER, one seed",
        "success": success,
        "env_steps": learner.num_timesteps,
        "train_seconds": seconds,
        "env_steps_per_second": learner.num_timesteps / seconds,
    }


def _evaluate(learner, env, episodes: int) -> float:
    """Returns the share of episodes whose last step is a success, with the mean action."""
    successes = []
    for seed in range(episodes):
        observation, _ = env.reset(seed=1000 + seed)
        over = False
        while not over:
            action, _ = learner.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        successes.append(info["is_success"])
    return float(np.mean(successes))


def jaxgcrl_rows(task: str, quick: bool) -> Iterator[dict]:
    """Times JaxGCRL's arm task that resembles ours, 25 × 2 ms an action on MJX-JAX, stepped as ours is."""
    env = _load_jaxgcrl(*{"reach": ("arm_reach", "ArmReach"), "grasp": ("arm_grasp", "ArmGrasp")}[task])

    def step(states, actions):
        def act(states, actions):
            return jax.vmap(env.step)(states, actions), None

        return jax.lax.scan(act, states, actions)[0].obs

    counts = (1024, 8192) if jax.default_backend() == "gpu" else (64,)
    for num_envs in (4,) if quick else counts:
        states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
        actions = jax.random.uniform(jax.random.key(1), (2 if quick else 50, num_envs, env.action_size), minval=-1.0)
        compiled, _ = compile_timed(step, states, actions)
        rate = len(actions) * num_envs / seconds_per_call(functools.partial(compiled, states, actions))
        what = f"JaxGCRL {type(env).__name__}"
        yield {"what": what, "num_envs": num_envs, "substeps": env.n_frames, "env_steps_per_second": rate}


def _load_jaxgcrl(module: str, name: str) -> Any:
    spec = importlib.util.find_spec("jaxgcrl")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError("No module named 'jaxgcrl'")
    folder = Path(spec.submodule_search_locations[0])
    for package in ("jaxgcrl", "jaxgcrl.envs", "jaxgcrl.envs.manipulation"):  # without what these import to train
        sys.modules[package] = types.ModuleType(package)
        sys.modules[package].__path__ = [str(folder.joinpath(*package.split(".")[1:]))]
    with contextlib.chdir(folder):  # where the paths of its assets start
        return getattr(importlib.import_module(f"jaxgcrl.envs.manipulation.{module}"), name)()
