"""Runs a policy for one episode in many environments at once."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs import EpisodeMetrics, GoalEnv, State
from hgail_jax.distributed.sharding import gather, own_part
from hgail_jax.validation import check_count

Policy = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""Observations `[N, observation_size]` and a PRNG key to actions `[N, action_size]` and log-probabilities `[N]`."""


class Trajectory(struct.PyTreeNode):
    """`N` whole episodes of `T` steps; time comes first. Step `t` acts in state `t` and leads to state `t + 1`."""

    features: jax.Array
    """`[T + 1, N, feature_size]`: the observations without the goal."""
    achieved: jax.Array
    """`[T + 1, N, goal_size]`: achieved goals."""
    desired: jax.Array
    """`[T + 1, N, goal_size]`: the goals pursued; constant in time unless the task moves them."""
    action: jax.Array
    """`[T, N, action_size]`: as drawn, not clipped."""
    log_prob: jax.Array
    """`[T, N]`: log-probability of `action` under the policy that drew it."""
    reward: jax.Array
    """`[T, N]`: the environment's reward."""
    sound: jax.Array
    """`[N]` booleans: whether the simulation stayed finite; where not, all of the above are 0."""
    overflow: jax.Array
    """`[N]` booleans: whether the simulation ran out of room for contacts."""
    outcome: EpisodeMetrics
    """`[N]`: how the episodes ended; all 0 where not sound."""

    def observation(self, env: GoalEnv) -> jax.Array:
        """Returns the observations under the goals pursued, `[T + 1, N, observation_size]`."""
        return env.goal_observation(self.features, self.desired)


def rollout(
    env: GoalEnv,
    policy: Policy,
    rng: jax.Array,
    num_envs: int,
    probe: jax.Array | bool = False,
    axis: str | None = None,
) -> Trajectory:
    """Resets `num_envs` environments and runs `policy` in each for `env.episode_length` steps.

    Where `probe`, which may be traced, the episodes' outcome takes the task's probe into account: `env.probe_length`
    further steps, which are no part of the trajectory. Without it the outcome is that of a probe that changed nothing.

    Within a `jax.shard_map` whose mesh axis `axis` names, each device steps its part of the environments, asks `policy`
    for their actions alone, and returns the trajectory of all of them.

    Raises:
      ValueError: `num_envs` is no count from 1.

    """
    check_count("num_envs", num_envs)
    reset_rng, act_rng = jax.random.split(rng)
    reset_rngs = own_part(jax.random.split(reset_rng, num_envs), axis)
    num_envs = len(reset_rngs)
    start = _depend_on(reset_rng, jax.vmap(env.reset)(reset_rngs))
    move = jax.jit(jax.vmap(env.step))  # which the probe does not trace again

    def step(state, rng):
        action, log_prob = policy(state.obs, rng)
        following = move(state, action)
        return following, (state.info, action, log_prob, following.reward)

    end, (info, action, log_prob, reward) = jax.lax.scan(step, start, jax.random.split(act_rng, env.episode_length))
    info = jax.tree.map(lambda values, last: jnp.concatenate([values, last[None]]), info, end.info)
    probed = end
    if env.probe_length and probe is not False:
        probed = jax.lax.cond(probe, functools.partial(_probe, env, move), lambda end, _: end, end, action[-1])
    outcome = jax.vmap(env.outcome)(end, probed)
    of_episodes = (action.swapaxes(0, 1), end.pipeline_state, probed.pipeline_state, outcome)
    sound = _is_sound(env, info) & _is_finite(of_episodes, num_envs)
    seen = Trajectory(
        features=info["observation"],
        achieved=info["achieved_goal"],
        desired=info["desired_goal"],
        action=action,
        log_prob=log_prob,
        reward=reward,
        sound=sound,
        overflow=jax.vmap(env.overflow)(probed.pipeline_state),
        outcome=outcome,
    )
    without_time = ("sound", "overflow", "outcome")
    whole = seen.replace(
        **{name: gather(values, axis, along=int(name not in without_time)) for name, values in vars(seen).items()}
    )
    return _blank(whole, ~whole.sound)


def _probe(env: GoalEnv, move: Callable, end: State, action: jax.Array) -> State:
    """Returns the states that the task's probe leads to, from the last states and actions of episodes, `[N, ...]`."""

    def step(_, carry):
        state, action = carry
        action = jax.vmap(env.probe_action)(action)
        return move(state, action), action

    return jax.lax.fori_loop(0, env.probe_length, step, (end, action))[0]


def _is_sound(env: GoalEnv, info: dict[str, jax.Array]) -> jax.Array:
    """Returns whether all that was observed in an episode is finite and within bounds, `[N]`."""
    return jnp.stack([(jnp.abs(values) <= env.observation_limit).all(axis=(0, 2)) for values in info.values()]).all(
        axis=0
    )


def _is_finite(tree: Any, num_envs: int) -> jax.Array:
    """Returns whether all numbers of a tree with a leading axis over environments are finite, `[N]`."""
    leaves = [leaf.reshape(num_envs, -1) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(leaf).all(axis=1) for leaf in leaves]).all(axis=0)


def _blank(trajectory: Trajectory, where: jax.Array) -> Trajectory:
    """Returns the trajectory with zeros for all that the episodes `where`, `[N]`, hold; no NaN can spread from it."""

    def blank(values: jax.Array) -> jax.Array:
        mask = where if values.ndim == 1 else where[None, :].reshape(1, -1, *[1] * (values.ndim - 2))
        return jnp.where(mask, jnp.zeros_like(values), values)

    blanked = jax.tree.map(blank, trajectory)
    return blanked.replace(overflow=trajectory.overflow)


def _depend_on(rng: jax.Array, tree: Any) -> Any:
    """Returns `tree` as it is, made to depend on `rng`.

    Physics that starts the same for every seed carries no seed axis under an outer vmap, but has one after a step. JAX
    finds that out by tracing the step again for every loop around it; starting with the axis keeps compilation short.
    """
    always = jnp.all(jax.random.key_data(rng) >= 0)
    return jax.tree.map(lambda leaf: jnp.where(always, leaf, leaf), tree)
