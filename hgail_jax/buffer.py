"""A replay buffer of whole episodes, whose samples get a new goal each time they are drawn.

Below, `K` is the episodes that the buffer holds, `T` the steps of an episode and `B` the samples drawn.
"""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hgail_envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.hindsight import count_kinds, draw_source
from hgail_jax.rollout import Detour, Trajectory
from hgail_jax.samples import Samples, jitter_goals, kind_share, shuffle_goals

_CANDIDATES = 4096  # steps from which goals are drawn
_STEPS_AHEAD = 2**30  # more than any episode has


class EpisodeBuffer(struct.PyTreeNode):
    """A ring of the last `K` episodes; the oldest is overwritten. Episodes come first, unlike in a trajectory."""

    features: jax.Array
    """`[K, T + 1, feature_size]`."""
    achieved: jax.Array
    """`[K, T + 1, goal_size]`: achieved goals."""
    desired: jax.Array
    """`[K, T + 1, goal_size]`: the goals pursued."""
    action: jax.Array
    """`[K, T, action_size]`: clipped to [-1, 1], as the environment took them."""
    valid: jax.Array
    """`[K]` booleans: whether the place holds an episode whose simulation stayed finite."""
    added: jax.Array
    """`[]` integer: episodes added so far; the next goes to place `added` modulo `K`."""
    noted: Any = None
    """`[K, T, ...]`: what policies noted of their steps, for a learner that wants it; else None."""


class ReplayHyperparameters(Hyperparameters):
    """Hyperparameters of a learner whose discriminator's samples are drawn from a buffer."""

    fractions: ClassVar[tuple[str, ...]] = (*Hyperparameters.fractions, "negative_p_ht")

    discriminator_horizon: jax.Array | int = 2**30
    """Most steps from an expert sample to the one that its hindsight goal is taken from. At 1 the discriminator learns
    which actions reach a goal at once; a large number leaves the choice to Algorithm 1."""
    negative_p_ht: jax.Array | float = 0.0
    """Probability that a policy sample's goal, before it is shuffled, is one that its episode achieved later."""

    def validate(self, action_size: int | None = None, config: Config | None = None) -> Self:
        """See `Hyperparameters`."""
        horizon = self.discriminator_horizon
        if not isinstance(horizon, jax.core.Tracer) and np.any(np.asarray(horizon) < 1):
            raise ValueError(f"discriminator_horizon is {horizon}; it must be at least 1")
        return super().validate(action_size, config)


class Transitions(struct.PyTreeNode):
    """Samples of a buffer under the goals drawn for them."""

    observation: jax.Array
    """`[B, observation_size]`, not normalised."""
    action: jax.Array
    """`[B, action_size]`."""
    next_observation: jax.Array
    """`[B, observation_size]`: under the same goal."""
    reached: jax.Array
    """`[B]` booleans: whether the next state is at the goal."""
    weight: jax.Array
    """`[B]`: in a loss; 0 for episodes whose simulation broke down."""
    features: jax.Array
    """`[B, feature_size]`: the observations without their goals."""
    goal: jax.Array
    """`[B, goal_size]`."""
    episode: jax.Array
    """`[B]` integers: the samples' episodes in the buffer."""
    step: jax.Array
    """`[B]` integers below `T`: their steps in the episodes."""


def init_buffer(env: GoalEnv, episodes: int, noted: Any = None) -> EpisodeBuffer:
    """Returns an empty buffer for `episodes` episodes, and for what is `noted` of a step, arrays of its shapes."""
    states, steps = (episodes, env.episode_length + 1), (episodes, env.episode_length)
    return EpisodeBuffer(
        features=jnp.zeros((*states, env.feature_size)),
        achieved=jnp.zeros((*states, env.goal_size)),
        desired=jnp.zeros((*states, env.goal_size)),
        action=jnp.zeros((*steps, env.action_size)),
        valid=jnp.zeros(episodes, bool),
        added=jnp.zeros((), jnp.int32),
        noted=jax.tree.map(lambda leaf: jnp.zeros((*steps, *leaf.shape), leaf.dtype), noted),
    )


def add_episodes(buffer: EpisodeBuffer, trajectory: Trajectory) -> EpisodeBuffer:
    """Returns the buffer with the episodes of a trajectory in the place of its oldest ones.

    Raises:
      ValueError: the trajectory has more episodes than the buffer holds.
    """
    held, count = buffer.valid.shape[0], trajectory.valid.shape[0]
    if count > held:
        raise ValueError(f"a roll-out of {count} episodes does not fit into a buffer of {held}")
    place = (buffer.added + jnp.arange(count)) % held

    def put(kept: jax.Array, new: jax.Array) -> jax.Array:
        return kept.at[place].set(jnp.moveaxis(new, 0, 1), unique_indices=True)

    return EpisodeBuffer(
        features=put(buffer.features, trajectory.features),
        achieved=put(buffer.achieved, trajectory.achieved),
        desired=put(buffer.desired, trajectory.desired),
        action=put(buffer.action, jnp.clip(trajectory.action, -1.0, 1.0)),
        valid=buffer.valid.at[place].set(trajectory.valid, unique_indices=True),
        added=buffer.added + count,
        noted=None if buffer.noted is None else jax.tree.map(put, buffer.noted, trajectory.noted),
    )


def draw(
    env: GoalEnv,
    hyper: Hyperparameters,
    buffer: EpisodeBuffer,
    rng: jax.Array,
    count: int,
    p_ht: jax.Array | float,
    most_ahead: jax.Array | int = _STEPS_AHEAD,
) -> Transitions:
    """Draws steps of the episodes so far, each uniformly and with replacement, and a goal for each of them.

    With probability `p_ht` a step's goal is replaced in hindsight by one that its episode achieved later, by Algorithm
    1; see `hgail_jax.hindsight.relabel`. Kinds of goals are drawn as often as the episodes pursue them.

    Args:
      env: the task.
      hyper: the strategy, and the weight of samples whose goal is already solved.
      buffer: at least one episode must have been added.
      rng: a PRNG key.
      count: `B`.
      p_ht: probability that a goal is replaced.
      most_ahead: most steps from a sample's own state to the one that its replaced goal is taken from.
    """
    episode_rng, step_rng, chosen_rng, source_rng = jax.random.split(rng, 4)
    held, length = buffer.action.shape[:2]
    episode = jax.random.randint(episode_rng, (count,), 0, jnp.minimum(buffer.added, held))
    step = jax.random.randint(step_rng, (count,), 0, length)
    pursued = buffer.desired[episode, step]
    valid = buffer.valid.astype(jnp.float32)
    share = kind_share(env, buffer.desired[:, :-1], jnp.broadcast_to(valid[:, None], (held, length)))
    counts = count_kinds(env.goal_kind(buffer.achieved), env.goal_kinds)
    last = jnp.minimum(step + most_ahead, length)
    first = step + jnp.where(hyper.include_current, 0, 1)
    source = draw_source(source_rng, counts, episode, first, last, share, hyper.strategy)
    chosen = jax.random.bernoulli(chosen_rng, p_ht, (count,))
    goal = jnp.where(chosen[:, None], buffer.achieved[episode, source], pursued)
    features, following = buffer.features[episode, step], buffer.features[episode, step + 1]
    solved = env.already_solved(features, goal)
    return Transitions(
        observation=env.goal_observation(features, goal),
        action=buffer.action[episode, step],
        next_observation=env.goal_observation(following, goal),
        reached=env.goal_test(following, buffer.achieved[episode, step + 1], goal),
        weight=valid[episode] * jnp.where(chosen & solved, hyper.solved_weight, 1.0),
        features=features,
        goal=goal,
        episode=episode,
        step=step,
    )


def draw_future(buffer: EpisodeBuffer, drawn: Transitions, discount: jax.Array | float, rng: jax.Array) -> jax.Array:
    """Draws goals, `[B, goal_size]`, that the episodes of samples achieve later: n steps ahead as often as discount^n.

    The distribution ends with the episode; a discount of 0 takes the next state's. It must be below 1.
    """
    uniform = jax.random.uniform(rng, drawn.step.shape)
    ahead = buffer.action.shape[1] - drawn.step  # steps to the last state
    beyond = jnp.log1p(-uniform * (1.0 - discount**ahead)) / jnp.log(discount)
    return buffer.achieved[drawn.episode, drawn.step + jnp.minimum(1 + beyond.astype(jnp.int32), ahead)]


def draw_achieved(env: GoalEnv, buffer: EpisodeBuffer, rng: jax.Array, count: int) -> jax.Array:
    """Draws goals, `[count, goal_size]`, that steps of sound episodes achieved, each kind of goal as often.

    They are drawn from a few thousand steps, in which a very rare kind may be missing.
    """
    episode_rng, step_rng, goal_rng = jax.random.split(rng, 3)
    held, length = buffer.action.shape[:2]
    filled = jnp.maximum(jnp.minimum(buffer.added, held), 1)
    episode = jax.random.randint(episode_rng, (_CANDIDATES,), 0, filled)
    step = jax.random.randint(step_rng, (_CANDIDATES,), 1, length + 1)
    goals = buffer.achieved[episode, step]
    kind, sound = env.goal_kind(goals), buffer.valid[episode]
    counts = jnp.sum(jax.nn.one_hot(kind, env.goal_kinds), axis=0, where=sound[:, None])
    weight = jnp.where(sound, 1.0 / counts[kind], 0.0)
    return goals[jax.random.categorical(goal_rng, jnp.log(weight), shape=(count,))]


def draw_detour(env: GoalEnv, buffer: EpisodeBuffer, rng: jax.Array, count: int, share: float) -> Detour:
    """Draws goals that earlier episodes achieved, for a random number of steps of a `share` of `count` episodes.

    It is a curriculum for tasks without training goals. An empty buffer gives none.
    """
    goal_rng, chosen_rng, until_rng = jax.random.split(rng, 3)
    chosen = jax.random.bernoulli(chosen_rng, jnp.where(buffer.added > 0, share, 0.0), (count,))
    until = jax.random.randint(until_rng, (count,), 1, env.episode_length + 1)
    return Detour(draw_achieved(env, buffer, goal_rng, count), jnp.where(chosen, until, 0))


def draw_positives(
    env: GoalEnv, hyper: ReplayHyperparameters, buffer: EpisodeBuffer, count: int, rng: jax.Array, jitter_rng: jax.Array
) -> Samples:
    """Draws the discriminator's expert samples, whose goals are achieved within `discriminator_horizon` steps.

    With a `goal_jitter` a goal is anywhere in a box around that, within what counts as reached.
    """
    # without hindsight at all (p_ht 0) nothing distinguishes them from the policy's
    drawn = draw(env, hyper, buffer, rng, count, jnp.where(hyper.p_ht > 0, 1.0, 0.0), hyper.discriminator_horizon)
    goal = jitter_goals(env, drawn.goal, hyper.goal_jitter, jitter_rng)
    return Samples(env.goal_observation(drawn.features, goal), drawn.action, drawn.weight)


def draw_negatives(
    env: GoalEnv,
    hyper: ReplayHyperparameters,
    buffer: EpisodeBuffer,
    count: int,
    rng: jax.Array,
    shuffle_rng: jax.Array,
) -> Samples:
    """Draws the discriminator's policy samples, under goals pursued or, by `negative_p_ht`, achieved later.

    A fraction of them, `shuffled_goals`, then get the goals of others.
    """
    drawn = draw(env, hyper, buffer, rng, count, hyper.negative_p_ht)
    goal = shuffle_goals(drawn.goal, hyper.shuffled_goals, shuffle_rng)
    return Samples(env.goal_observation(drawn.features, goal), drawn.action, drawn.weight)
