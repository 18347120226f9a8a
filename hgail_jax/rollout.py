"""Runs a policy for one episode in many environments at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs import GoalEnv
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
    """`[N, goal_size]`: the goals pursued."""
    action: jax.Array
    """`[T, N, action_size]`: as drawn, not clipped."""
    log_prob: jax.Array
    """`[T, N]`: log-probability of `action` under the policy that drew it."""
    reward: jax.Array
    """`[T, N]`: the environment's reward."""

    def observation(self, env: GoalEnv) -> jax.Array:
        """Returns the observations under the goals pursued, `[T + 1, N, observation_size]`."""
        return env.goal_observation(self.features, jnp.broadcast_to(self.desired, self.achieved.shape))


def rollout(env: GoalEnv, policy: Policy, rng: jax.Array, num_envs: int) -> Trajectory:
    """Resets `num_envs` environments and runs `policy` in each for `env.episode_length` steps.

    Raises:
      ValueError: `num_envs` is no count from 1.

    """
    check_count("num_envs", num_envs)
    reset_rng, act_rng = jax.random.split(rng)
    state = _depend_on(reset_rng, jax.vmap(env.reset)(jax.random.split(reset_rng, num_envs)))

    def step(state, rng):
        action, log_prob = policy(state.obs, rng)
        following = jax.vmap(env.step)(state, action)
        seen = (state.info["observation"], state.info["achieved_goal"], action, log_prob, following.reward)
        return following, seen

    final, (features, achieved, action, log_prob, reward) = jax.lax.scan(
        step, state, jax.random.split(act_rng, env.episode_length)
    )
    return Trajectory(
        features=jnp.concatenate([features, final.info["observation"][None]]),
        achieved=jnp.concatenate([achieved, final.info["achieved_goal"][None]]),
        desired=final.info["desired_goal"],
        action=action,
        log_prob=log_prob,
        reward=reward,
    )


def _depend_on(rng: jax.Array, tree: Any) -> Any:
    """Returns `tree` as it is, made to depend on `rng`.

    Physics that starts the same for every seed carries no seed axis under an outer vmap, but has one after a step. JAX
    finds that out by tracing the step again for every loop around it; starting with the axis keeps compilation short.
    """
    always = jnp.all(jax.random.key_data(rng) >= 0)
    return jax.tree.map(lambda leaf: jnp.where(always, leaf, leaf), tree)
