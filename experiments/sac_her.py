"""Soft actor-critic with hindsight in one file, in JAX, on a task's Gymnasium vector environment.

Run as `python -m experiments.other_trainers sac-her`; it is the example of docs/other-trainers.md.
"""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax

import hgail_envs  # noqa: F401  (registers the tasks)

TASK, ENVS, STEPS = "hgail_envs/FetchReach-v0", 16, 50  # steps of an episode
UPDATES, BATCH, GAMMA, POLYAK, ALPHA, RELABELLED = 600, 256, 0.95, 0.95, 0.02, 0.8
THRESHOLD = 0.05  # metres from the goal that are a success


class Mlp(nn.Module):
    """A network with two hidden layers."""

    outputs: int

    @nn.compact
    def __call__(self, *inputs: jax.Array) -> jax.Array:  # noqa: D102
        x = jnp.concatenate(inputs, -1)
        for _ in range(2):
            x = nn.relu(nn.Dense(128)(x))
        return nn.Dense(self.outputs)(x)


TwoMlps = nn.vmap(Mlp, in_axes=None, axis_size=2, variable_axes={"params": 0}, split_rngs={"params": True})
actor: Any = Mlp(8)  # flax's types say that it may return more than an array
critic: Any = TwoMlps(1)
adam = optax.adam(1e-3)


def act(params: Any, seen: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns an action and its log-likelihood."""
    mean, log_std = jnp.split(actor.apply(params, seen), 2, -1)
    log_std = jnp.clip(log_std, -5.0, 1.0)
    noise = jax.random.normal(rng, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    density = -0.5 * noise**2 - log_std - 2.0 * (jnp.log(2.0) - raw - nn.softplus(-2.0 * raw))
    return jnp.tanh(raw), density.sum(-1)


def sample(buffer: dict[str, jax.Array], episodes: jax.Array, rng: jax.Array) -> tuple[jax.Array, ...]:
    """Draws a batch; a part of it gets goals that the same episode achieves later."""
    keys = jax.random.split(rng, 4)
    episode = jax.random.randint(keys[0], (BATCH,), 0, episodes)
    step = jax.random.randint(keys[1], (BATCH,), 0, STEPS)
    later = jax.random.randint(keys[2], (BATCH,), step + 1, STEPS + 1)
    relabel = jax.random.bernoulli(keys[3], RELABELLED, (BATCH, 1))
    goal = jnp.where(relabel, buffer["achieved_goal"][episode, later], buffer["desired_goal"][episode, step])
    reached = jnp.linalg.norm(buffer["achieved_goal"][episode, step + 1] - goal, axis=-1) <= THRESHOLD
    seen, following = (jnp.concatenate([buffer["observation"][episode, at], goal], -1) for at in (step, step + 1))
    return seen, buffer["action"][episode, step], reached.astype(jnp.float32) - 1.0, following


def update(state: Any, rng: jax.Array, buffer: dict[str, jax.Array], episodes: jax.Array) -> tuple[Any, None]:
    """Takes a gradient step of critics and actor."""
    params, target, moments = state
    rng_batch, rng_next, rng_now = jax.random.split(rng, 3)
    seen, action, reward, following = sample(buffer, episodes, rng_batch)
    next_action, density = act(params["actor"], following, rng_next)
    value = critic.apply(target, following, next_action).min(0)[..., 0] - ALPHA * density
    wanted = jnp.clip(reward + GAMMA * value, -1.0 / (1.0 - GAMMA), None)

    def loss(params: Any) -> jax.Array:
        critics = jnp.mean((critic.apply(params["critic"], seen, action)[..., 0] - wanted) ** 2)
        chosen, density = act(params["actor"], seen, rng_now)
        worth = critic.apply(jax.lax.stop_gradient(params["critic"]), seen, chosen).min(0)[..., 0]
        return critics + jnp.mean(ALPHA * density - worth)

    changes, moments = adam.update(jax.grad(loss)(params), moments)
    params = optax.apply_updates(params, changes)
    target = jax.tree.map(lambda old, new: POLYAK * old + (1.0 - POLYAK) * new, target, params["critic"])
    return (params, target, moments), None


@jax.jit
def updates(state: Any, buffer: dict[str, jax.Array], episodes: jax.Array, rng: jax.Array) -> Any:
    """Takes `UPDATES` gradient steps on the first `episodes` of the buffer."""
    keys = jax.random.split(rng, UPDATES)
    return jax.lax.scan(lambda state, key: update(state, key, buffer, episodes), state, keys)[0]


def joined(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Returns what the networks see: the observation, then the goal."""
    return np.concatenate([observation["observation"], observation["desired_goal"]], -1)


def train(tested: Callable[[int, Callable[[dict], np.ndarray]], bool], most_steps: int, seed: int = 0) -> None:
    """Trains until `tested`, called with the environment steps and the policy after each round, returns true."""
    env = gymnasium.make_vec(TASK, num_envs=ENVS, autoreset_mode="SameStep")
    observation, _ = env.reset(seed=seed)
    rng, seen, rounds = jax.random.key(seed), joined(observation)[:1], most_steps // (ENVS * STEPS)
    params = {"actor": actor.init(rng, seen), "critic": critic.init(rng, seen, np.zeros((1, 4)))}
    state = (params, params["critic"], adam.init(params))
    sizes = {name: value.shape[-1] for name, value in observation.items()} | {"action": 4}
    buffer = {name: np.zeros((rounds * ENVS, STEPS + 1, size), np.float32) for name, size in sizes.items()}
    draw, mean = jax.jit(act), jax.jit(lambda params, seen: jnp.tanh(actor.apply(params, seen)[..., :4]))
    for index in range(rounds):
        episodes = slice(index * ENVS, (index + 1) * ENVS)
        for step in range(STEPS):
            rng, key = jax.random.split(rng)
            action = np.asarray(draw(state[0]["actor"], joined(observation), key)[0])
            for name, value in (observation | {"action": action}).items():
                buffer[name][episodes, step] = value
            observation, _, _, _, info = env.step(action)
        for name in observation:
            buffer[name][episodes, STEPS] = np.stack([final[name] for final in info["final_obs"]])
        rng, key = jax.random.split(rng)
        state = updates(state, buffer, episodes.stop, key)

        def policy(seen: dict[str, np.ndarray], params: Any = state[0]["actor"]) -> np.ndarray:
            return np.asarray(mean(params, joined(seen)))

        if tested(episodes.stop * STEPS, policy):
            return
