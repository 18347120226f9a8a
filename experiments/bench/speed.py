"""Measures stepping: this task's step, and the engine's own bare loop on the same scene under the same controls."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

import envs
from envs.fetch.arm import FetchEnv
from experiments.bench.native import measure_native
from experiments.bench.timing import compile_timed, seconds_per_call


@dataclasses.dataclass(frozen=True)
class Size:
    """What is stepped."""

    task: str
    impl: str
    num_envs: int
    substeps: int
    quick: bool = False
    """Takes short episodes and few updates, to show that everything runs."""
    worlds: int | None = None
    """Environments that a device steps at once, where that is not `num_envs`."""

    @functools.cached_property
    def env(self) -> FetchEnv:
        """The task."""
        env = envs.make(self.task, impl=self.impl, substeps=self.substeps, worlds=self.worlds or self.num_envs)
        assert isinstance(env, FetchEnv)
        if self.quick:
            env.episode_length = 4
        return env

    @property
    def env_steps(self) -> int:
        """Of one episode in every environment."""
        return self.num_envs * self.env.episode_length

    def grip(self, action: jax.Array) -> jax.Array | None:
        """Returns the part of an action that moves the fingers."""
        return action[3] if self.env.model.nu else None

    def actions(self) -> jax.Array:
        """Returns random actions, `[T, N, action_size]`."""
        shape = (self.env.episode_length, self.num_envs, self.env.action_size)
        return jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)

    def reset(self) -> envs.State:
        """Returns the states at the start of an episode, `[N, ...]`."""
        return jax.jit(jax.vmap(self.env.reset))(jax.random.split(jax.random.key(0), self.num_envs))


def measure_physics(size: Size) -> dict[str, float]:
    """Times the task's step under a scan with random actions, and the engine's own step on the same controls."""
    states, actions = size.reset(), size.actions()
    step, compile_seconds = compile_timed(functools.partial(_step_task, size), states, actions)
    raw = seconds_per_call(lambda: step(states, actions))
    _, controls = step(states, actions)
    bare, _ = compile_timed(functools.partial(_step_engine, size), states.pipeline_state, controls)
    measured = {
        "raw_env_steps_per_second": size.env_steps / raw,
        "raw_compile_seconds": compile_seconds,
        "bare_mjx_env_steps_per_second": size.env_steps
        / seconds_per_call(lambda: bare(states.pipeline_state, controls)),
    }
    if size.env.impl == "warp":
        measured |= measure_native(size.env, states.pipeline_state, controls)
    best = max(value for name, value in measured.items() if name.startswith("bare"))
    return measured | {"raw_to_bare": measured["raw_env_steps_per_second"] / best}


def _step_task(size: Size, states: envs.State, actions: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the last observations, and what each action set the engine's controls to, `[T, N, ...]`."""

    def control(state, action):
        data = size.env.engine_data(state.pipeline_state, action[:3], size.grip(action))
        return {"mocap_pos": data.mocap_pos, "mocap_quat": data.mocap_quat, "ctrl": data.ctrl}

    def step(states, actions):
        return jax.vmap(size.env.step)(states, actions), jax.vmap(control)(states, actions)

    states, controls = jax.lax.scan(step, states, actions)
    return states.obs, controls


def _step_engine(size: Size, physics: Any, controls: dict[str, jax.Array]) -> jax.Array:
    """Steps the engine alone, from the same starts under the same controls; returns the last positions."""

    def one(physics, controls):
        data = size.env.engine_data(physics, jnp.zeros(3))

        def act(data, control):
            data = data.replace(**control)
            return jax.lax.fori_loop(
                0, size.substeps, lambda _, data: mjx.step(size.env.engine_model, data), data
            ), None

        return jax.lax.scan(act, data, controls)[0].qpos

    return jax.vmap(one, in_axes=(0, 1))(physics, controls)
