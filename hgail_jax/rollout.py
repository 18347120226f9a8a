"""Runs a policy for one episode in many environments at once.

Below, `T` is the steps of an episode and `N` the episodes of a roll-out.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs import EpisodeMetrics, GoalEnv, State
from hgail_envs.validation import check_count
from hgail_jax.devices.sharding import gather, local_shard

Policy = Callable[[jax.Array, jax.Array], tuple[jax.Array, Any]]
"""Observations `[N, observation_size]` and a PRNG key to actions `[N, action_size]` and what its learner wants to know
of them later, leaves `[N, ...]`: PPO their log-probabilities, a student of pictures what it saw, others nothing."""


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
    noted: Any
    """`[T, N, ...]`: what the policy returned beside each action, see `Policy`."""
    reward: jax.Array
    """`[T, N]`: the environment's reward."""
    valid: jax.Array
    """`[N]` booleans: whether the simulation stayed finite; where not, all of the above are 0."""
    overflow: jax.Array
    """`[N]` booleans: whether the simulation ran out of room for contacts."""
    outcome: EpisodeMetrics
    """`[N]`: how the episodes ended; all 0 where not valid."""

    def observation(self, env: GoalEnv) -> jax.Array:
        """Returns the observations under the goals pursued, `[T + 1, N, observation_size]`."""
        return env.goal_observation(self.features, self.desired)


class Detour(NamedTuple):
    """Goals that `N` episodes pursue before their own."""

    goal: jax.Array
    """`[N, goal_size]`."""
    until: jax.Array
    """`[N]` integers: the steps for which they do; 0 is no detour."""


def rollout(
    env: GoalEnv,
    policy: Policy,
    rng: jax.Array,
    num_envs: int,
    training_goals: jax.Array | bool = False,
    lift_test: jax.Array | bool = False,
    axis: str | None = None,
    detour: Detour | None = None,
) -> Trajectory:
    """Resets `num_envs` environments and runs `policy` in each for `env.episode_length` steps.

    The goals are those to learn from if `training_goals` is set, see `GoalEnv`. With a `lift_test` the outcome includes
    the task's, `env.lift_test_steps` further steps that are no part of the trajectory; without one the outcome is that
    of a test that changed nothing. Both may be traced. With a `detour` episodes pursue other goals first; they are
    measured by their own.

    Within a `jax.shard_map`, `axis` is the mesh axis that the environments are split along. Each device steps its part
    of them, asks `policy` for their actions alone, and returns the trajectory of all of them.

    Raises:
      ValueError: `num_envs` is no count from 1, or a device would step more environments than `env.max_worlds`.
    """
    check_count("num_envs", num_envs)
    reset_rng, act_rng = jax.random.split(rng)
    reset_rngs = local_shard(jax.random.split(reset_rng, num_envs), axis)
    if env.max_worlds is not None:
        check_count("the number of environments on a device", len(reset_rngs), most=env.max_worlds)
    start = _depend_on(reset_rng, jax.vmap(env.reset, in_axes=(0, None))(reset_rngs, training_goals))
    move = jax.jit(jax.vmap(env.step))  # which the lift test does not trace again
    detour = jax.tree.map(lambda leaf: local_shard(leaf, axis), detour)
    end, seen, done = _run(env, move, policy, start, act_rng, detour)
    lifted = _lift_test(env, move, end, done["action"][-1], lift_test)
    outcome = jax.vmap(env.outcome)(end, lifted)
    valid = _is_bounded(seen, env.observation_limit) & _is_finite(
        (done["action"].swapaxes(0, 1), end.pipeline_state, lifted.pipeline_state, outcome), len(reset_rngs)
    )
    overflow = jax.vmap(env.overflow)(lifted.pipeline_state)
    steps = gather(_blank(seen | done, valid, env_axis=1), axis, along=1)
    valid, overflow, outcome = gather((valid, overflow, _blank(outcome, valid, env_axis=0)), axis, along=0)
    return Trajectory(**steps, valid=valid, overflow=overflow, outcome=outcome)


def _run(
    env: GoalEnv, move: Callable[..., State], policy: Policy, start: State, rng: jax.Array, detour: Detour | None
) -> tuple[State, dict[str, jax.Array], dict[str, Any]]:
    """Returns the last states, `[N, ...]`, what was seen, `[T + 1, N, ...]`, and what was done, `[T, N, ...]`."""

    def step(state: State, drawn: tuple[jax.Array, jax.Array]) -> tuple[State, Any]:
        rng, time = drawn
        present = _on_detour(env, state, detour, time)
        action, noted = policy(present.obs, rng)
        following = move(state, action)
        reward = _on_detour(env, following, detour, time + 1).reward
        return following, (_seen(present), {"action": action, "noted": noted, "reward": reward})

    length = env.episode_length
    end, (seen, done) = jax.lax.scan(step, start, (jax.random.split(rng, length), jnp.arange(length)))
    last = _seen(_on_detour(env, end, detour, length))
    return end, jax.tree.map(lambda values, last: jnp.concatenate([values, last[None]]), seen, last), done


def _on_detour(env: GoalEnv, state: State, detour: Detour | None, time: jax.Array | int) -> State:
    """Returns states, `[N, ...]`, as they are under the goals of a detour where those are pursued at this time."""
    if detour is None:
        return state
    features, achieved = state.info["features"], state.info["achieved_goal"]
    desired = jnp.where((time < detour.until)[:, None], detour.goal, state.info["desired_goal"])
    return state.replace(
        obs=env.goal_observation(features, desired),
        reward=env.goal_test(features, achieved, desired).astype(jnp.float32) - 1.0,
        info=state.info | {"desired_goal": desired},
    )


def _seen(state: State) -> dict[str, jax.Array]:
    info = state.info
    return {"features": info["features"], "achieved": info["achieved_goal"], "desired": info["desired_goal"]}


def _lift_test(
    env: GoalEnv, move: Callable[..., State], end: State, action: jax.Array, wanted: jax.Array | bool
) -> State:
    """Returns the states that the lift test leads to where `wanted`, else `end`, the last states, `[N, ...]`.

    `move` takes a step in all environments; `action`, `[N, action_size]`, are the last actions.
    """

    def step(_: jax.Array, carry: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
        return lift_test_step(env, move, *carry)

    if not env.lift_test_steps or wanted is False:  # so that nothing is compiled for it
        return end
    return jax.lax.cond(
        wanted,
        lambda *start: jax.lax.fori_loop(0, env.lift_test_steps, step, start)[0],
        lambda end, _: end,
        end,
        action,
    )


def lift_test_step(
    env: GoalEnv, move: Callable[..., State], state: State, action: jax.Array
) -> tuple[State, jax.Array]:
    """Returns the state after a step of the lift test, and its action, from the last action, `[..., action_size]`.

    `move` takes the step: `env.step`, or that of a batch.
    """
    action = jnp.vectorize(env.lift_test_action, signature="(n)->(n)")(action)
    return move(state, action), action


def _is_bounded(seen: dict[str, jax.Array], limit: float) -> jax.Array:
    """Returns whether all of an episode, leaves `[T + 1, N, ...]`, is finite and within `limit`: `[N]`."""
    return jnp.stack([(jnp.abs(values) <= limit).all(axis=(0, 2)) for values in seen.values()]).all(axis=0)


def _is_finite(tree: Any, num_envs: int) -> jax.Array:
    """Returns whether all numbers of a tree with a leading axis over environments are finite, `[N]`."""
    leaves = [leaf.reshape(num_envs, -1) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(leaf).all(axis=1) for leaf in leaves]).all(axis=0)


def _blank(tree: Any, valid: jax.Array, env_axis: int) -> Any:
    """Returns a tree with 0 for all of the episodes, along axis `env_axis`, that are not `valid`, `[N]`."""

    def blank(values: jax.Array) -> jax.Array:
        keep = jnp.expand_dims(valid, [axis for axis in range(values.ndim) if axis != env_axis])
        return jnp.where(keep, values, jnp.zeros_like(values))

    return jax.tree.map(blank, tree)


def _depend_on(rng: jax.Array, tree: Any) -> Any:
    """Returns `tree` as it is, made to depend on `rng`.

    Physics that starts the same for every seed carries no seed axis under an outer vmap, but has one after a step. JAX
    finds that out by tracing the step again for every loop around it; starting with the axis keeps compilation short.
    """
    always = jnp.all(jax.random.key_data(rng) >= 0)
    return jax.tree.map(lambda leaf: jnp.where(always, leaf, leaf), tree)
