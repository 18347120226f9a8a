"""Measures other projects beside this one's stepping; projects that are not installed are skipped with a line."""

import contextlib
import functools
import importlib
import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import jax
import mujoco
import numpy as np

import hgail_envs
from experiments.bench.stepping import raw_rate
from experiments.bench.timing import compile_timed, seconds_per_call
from experiments.bench.workload import Workload, default_substeps
from hgail_envs.engines.c import usable_cores
from hgail_envs.fetch.arm import CONTROL_PERIOD, REFERENCE_SUBSTEPS, FetchEnv, settle
from hgail_envs.fetch.reference import make_reference
from hgail_envs.scenes import load_scene
from hgail_jax.settings.defaults import platform_name

PACKAGES = ("gymnasium", "gymnasium-robotics", "envpool", "stable-baselines3", "torch")
"""Packages of the peers, besides this project's own."""

_SECONDS, _QUICK_SECONDS = 10.0, 0.2
_SUCCESS = 0.98  # success rate that ends the training of stable-baselines3
_MOST_STEPS = 60_000
_POOLED = 64  # environments of EnvPool, and of ours beside it

_TIME_ENVPOOL = """
import json, sys, time
import envpool
import numpy as np

name, num_envs, num_threads, least_seconds = json.loads(sys.argv[1])
env = envpool.make_gymnasium(name, num_envs=num_envs, num_threads=num_threads, seed=0)
shape, rng = (num_envs, *env.action_space.shape), np.random.default_rng(0)
env.reset()
taken, started = 0, time.perf_counter()
while (seconds := time.perf_counter() - started) < least_seconds:
    env.step(rng.uniform(-1.0, 1.0, shape).astype(env.action_space.dtype))
    taken += num_envs
print(json.dumps({"version": envpool.__version__, "env_steps_per_second": taken / seconds}))
"""


def peer_rows(task: str, quick: bool, time_limit: float) -> Iterator[dict[str, Any]]:
    """Yields a row for each peer that is installed; all but JaxGCRL run on the CPU.

    Args:
      task: this project's, beside its counterparts.
      quick: take tiny sizes that show that everything runs.
      time_limit: seconds of training.

    """
    cpu_peers: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {
        "ours": lambda: own_rows(task, quick),
        "mujoco.rollout": lambda: rollout_rows(task, quick),
        "gymnasium-robotics": lambda: gymnasium_rows(task, quick),
        "envpool": lambda: envpool_rows(task, quick),
        "stable-baselines3": lambda: stable_baselines_rows(task, quick, time_limit),
    }
    for name, peer in {"jaxgcrl": lambda: jaxgcrl_rows(task, quick), **cpu_peers}.items():
        cores = {"cpu_cores": usable_cores()} if name in cpu_peers else {}
        try:
            for row in peer():
                yield {"task": task, **row, **cores}
        except ImportError as error:
            print(f"left out: {name} ({error})")


def own_rows(task: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Times this project's task on a CPU with random actions: with the peers' physics steps, and as it is trained."""
    if platform_name() != "cpu":
        return
    trained = default_substeps(task, "cpu")
    for impl, name, substeps in (
        ("c", "C MuJoCo", REFERENCE_SUBSTEPS),
        ("c", "C MuJoCo", trained),
        ("jax", "MJX-JAX", REFERENCE_SUBSTEPS),
    ):
        workload = Workload(task, impl, 4 if quick else _POOLED, substeps, quick)
        yield {
            "what": f"hgail_jax, {name}",
            "num_envs": workload.num_envs,
            "substeps": substeps,
            "env_steps_per_second": raw_rate(workload),
        }


def rollout_rows(task: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Times C MuJoCo on this project's scene, in as many threads as there are cores, with random targets."""
    threads = usable_cores()
    for substeps in (REFERENCE_SUBSTEPS, default_substeps(task, "cpu")):
        rate = _rollout_rate(task, substeps, threads, 2 if quick else 50)
        yield {"what": f"mujoco.rollout, {threads} threads", "substeps": substeps, "env_steps_per_second": rate}


def _rollout_rate(task: str, substeps: int, threads: int, actions: int) -> float:
    """Returns the environment steps per second of whole episodes, each of them one call."""
    from mujoco import rollout

    task_class = cast(type[FetchEnv], hgail_envs.find_class(task))
    model, batch = load_scene(task_class.scene), 8 * threads
    settled = settle(model, task_class.base_x, task_class.start_height)
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


def _reference(task: str) -> str:
    """Returns the name of a task's reference environment in Gymnasium."""
    name = hgail_envs.find_class(task).reference
    if name is None:
        raise ValueError(f"{task} has no counterpart in Gymnasium")
    return name


def gymnasium_rows(task: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Times Gymnasium-Robotics' environment as its users step it, with random actions."""
    import gymnasium

    cores = usable_cores()
    make = functools.partial(make_reference, _reference(task))
    sync, parallel = gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv
    for kind, count in ((sync, 1), (parallel, cores), (parallel, 8 * cores)):
        with contextlib.closing(kind([make] * count)) as vector:
            vector.reset(seed=0)
            vector.action_space.seed(0)
            taken, started = 0, time.perf_counter()
            while (seconds := time.perf_counter() - started) < (_QUICK_SECONDS if quick else _SECONDS):
                vector.step(vector.action_space.sample())
                taken += count
        what = f"{_reference(task)}, {kind.__name__} of {count}"
        yield {"what": what, "substeps": REFERENCE_SUBSTEPS, "env_steps_per_second": taken / seconds}


def envpool_rows(task: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Times EnvPool's environment with random actions, in as many threads as there are cores."""
    if importlib.util.find_spec("envpool") is None:
        raise ImportError("No module named 'envpool'")
    threads, seconds = usable_cores(), _QUICK_SECONDS if quick else _SECONDS
    asked = json.dumps([_reference(task), _POOLED, threads, seconds])
    # In a process of its own: it is linked with a MuJoCo of its own, of another version than the one loaded here.
    command = [sys.executable, "-c", _TIME_ENVPOOL, asked]
    said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    measured = json.loads(said.splitlines()[-1])
    yield {
        "what": f"EnvPool {measured['version']} {_reference(task)}, {threads} threads",
        "num_envs": _POOLED,
        "substeps": REFERENCE_SUBSTEPS,
        "env_steps_per_second": measured["env_steps_per_second"],
    }


def stable_baselines_rows(task: str, quick: bool, time_limit: float) -> Iterator[dict[str, Any]]:
    """Times stable-baselines3's SAC with HER on the reference, to a success rate of .98 in 100 episodes; reach only.

    It stops at the first test after `time_limit` seconds, tests included.
    """
    if task != "reach":
        return
    import stable_baselines3 as sb3

    env, test = make_reference(_reference(task)), make_reference(_reference(task))
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
    most_steps, deadline = step if quick else _MOST_STEPS, time.perf_counter() + time_limit
    while success < _SUCCESS and learner.num_timesteps < most_steps and time.perf_counter() < deadline:
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


def _evaluate(learner: Any, env: Any, episodes: int) -> float:
    """Returns the success rate of the mean action at the last step of episodes.

    It ends early once `_SUCCESS` is out of reach.
    """
    successes: list[float] = []
    for seed in range(episodes):
        if len(successes) - sum(successes) > episodes * (1.0 - _SUCCESS):
            break
        observation, _ = env.reset(seed=1000 + seed)
        over = False
        while not over:
            action, _ = learner.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        successes.append(info["is_success"])
    return float(np.mean(successes))


def jaxgcrl_rows(task: str, quick: bool) -> Iterator[dict[str, Any]]:
    """Times JaxGCRL's arm task that resembles ours, 25 × 2 ms an action on MJX-JAX, stepped as ours."""
    env = _make_jaxgcrl(*{"reach": ("arm_reach", "ArmReach"), "grasp": ("arm_grasp", "ArmGrasp")}[task])

    def step(states: hgail_envs.State, actions: jax.Array) -> jax.Array:
        def act(states: hgail_envs.State, actions: jax.Array) -> tuple[hgail_envs.State, None]:
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


def _make_jaxgcrl(module: str, name: str) -> Any:
    """Makes an environment of JaxGCRL."""
    package = importlib.import_module("jaxgcrl")
    environment = getattr(importlib.import_module(f"jaxgcrl.envs.manipulation.{module}"), name)
    with contextlib.chdir(Path(package.__path__[0])):  # its scenes' paths start there
        return environment()
