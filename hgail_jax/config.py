"""What a training run is made of: static sizes, sweepable hyperparameters, and their presets."""

import dataclasses
from typing import Any

import jax
import numpy as np
from flax import struct

from envs import GoalEnv
from hgail_jax.hindsight import FINAL, FUTURE
from hgail_jax.rewards import R1, R2, R3, R4
from hgail_jax.validation import check_choice, check_count, check_not_negative, check_positive, check_share

STRATEGIES = {"future": FUTURE, "final": FINAL}
"""Hindsight strategies by name."""
REWARDS = {"r1": R1, "r2": R2, "r3": R3, "r4": R4}
"""Reward forms by name."""
EXPERT_SOURCES = ("relabelled", "frozen", "demonstrations", "best")
"""Where expert samples come from, see `hgail_jax.experts`."""
RELABELLED, FROZEN, DEMONSTRATIONS, BEST = EXPERT_SOURCES

_MAY_BE_ZERO = ("rounds", "policy_phases", "discriminator_phases", "likelihood_batch")
_MOST_SAMPLES = 2**31 - 1  # indices are 32 bits wide


@dataclasses.dataclass(frozen=True)
class Config:
    """Shapes and counts of a run: whatever decides the compiled program.

    A sample is one step of one episode; a roll-out holds `num_envs` episodes.

    Raises:
      ValueError: a value is out of its range.

    """

    num_envs: int = 64
    """Episodes in a roll-out."""
    rounds: int = 6
    """Rounds of Algorithm 2 after the pre-training."""
    pretrain: bool = True
    """Whether to pre-train policy and discriminator before the first round."""
    policy_phases: int = 3
    """Roll-outs with a PPO update in a round (the paper's g_steps)."""
    discriminator_phases: int = 3
    """Roll-outs with a discriminator update in a round (the paper's d_steps)."""
    ppo_epochs: int = 2
    """Passes over the samples of a roll-out in one PPO update."""
    ppo_minibatches: int = 4
    """Minibatches that a roll-out is cut into in one pass."""
    expert_source: str = RELABELLED
    """Where expert samples come from: one of `EXPERT_SOURCES`."""
    best_episodes: int = 1000
    """Episodes kept where the expert samples are the best so far."""
    explore: bool = True
    """Whether to learn on the task's starts and goals to learn from, or on those that it is measured by."""
    likelihood_batch: int = 0
    """Expert samples whose likelihood each minibatch of PPO raises as well; 0 leaves this to the pre-training."""
    discriminator_minibatches: int = 50
    """Gradient steps in one discriminator update."""
    discriminator_batch: int = 512
    """Expert samples, and as many of the policy's, in a gradient step of the discriminator."""
    pretrain_policy_minibatches: int = 300
    """Gradient steps of maximum likelihood in the pre-training."""
    pretrain_policy_batch: int = 512
    """Samples in one of them."""
    pretrain_discriminator_minibatches: int = 500
    """Gradient steps of the discriminator in the pre-training."""
    final_learning_rate: float = 0.0
    """What the policy's learning rate has shrunk to at the end of the last round, as a share of its start."""
    policy_hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of the policy and of the value function."""
    discriminator_hidden: tuple[int, ...] = (100, 100)
    """Widths of the hidden layers of the discriminator."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type is int:
                check_count(field.name, value, least=int(field.name not in _MAY_BE_ZERO))
            elif field.type is bool and not isinstance(value, bool):
                raise ValueError(f"{field.name} is {value!r}; it must be True or False")
        check_share("final_learning_rate", self.final_learning_rate)
        if self.expert_source not in EXPERT_SOURCES:
            raise ValueError(f"expert_source is {self.expert_source!r}; it must be one of {', '.join(EXPERT_SOURCES)}")
        for name in ("policy_hidden", "discriminator_hidden"):
            if not isinstance(getattr(self, name), tuple):
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must be a tuple of widths")
            for width in getattr(self, name):
                check_count(f"a width in {name}", width)

    def validate(self, env: GoalEnv) -> "Config":
        """Returns itself.

        Raises:
          ValueError: a roll-out on `env` has fewer samples than PPO has minibatches, or more than an index can count.

        """
        if not isinstance(env, GoalEnv):
            raise ValueError(f"{env!r} is not a GoalEnv")
        samples = self.num_envs * env.episode_length
        check_count("ppo_minibatches", self.ppo_minibatches, most=samples)
        check_count("num_envs, times the steps of an episode,", samples, most=_MOST_SAMPLES)
        return self


class Hyperparameters(struct.PyTreeNode):
    """Scalars of the algorithm. They are leaves of the training state, so that `jax.vmap` can sweep any of them."""

    p_ht: jax.Array | float = 1.0
    """Probability that a step's goal is replaced in hindsight."""
    strategy: jax.Array | int = FUTURE
    """Where a replaced goal comes from: a value of `STRATEGIES`."""
    include_current: jax.Array | bool = False
    """Whether "future" may also pick the position achieved before the step's own action."""
    trivial_weight: jax.Array | float = 1.0
    """Weight of relabelled samples under whose goal nothing is left to do, see `GoalEnv.is_trivial`."""
    ties_by_distance: jax.Array | bool = False
    """Whether, of equally good episodes, those that end nearer to their goal are kept; see `keep_best`."""
    reward: jax.Array | int = R1
    """How the discriminator's logit becomes a reward: a value of `REWARDS`."""
    environment_reward: jax.Array | float = 0.0
    """Weight of the environment's reward (-1, 0 on success); the discriminator's has the rest up to 1."""
    standardize_reward: jax.Array | bool = True
    """Whether PPO's reward is shifted and scaled to mean 0 and standard deviation 1 over a roll-out. That removes what
    tells r1 to r4 apart in scale, and makes a rare success large: one among 51,200 steps is worth +226."""
    reward_scale: jax.Array | float = 1.0
    """Factor on PPO's reward, which is first divided by the steps of an episode."""
    standardize_advantage: jax.Array | bool = True
    """Whether PPO's advantages are shifted and scaled to mean 0 and standard deviation 1 over a roll-out."""
    standardize_observation: jax.Array | bool = True
    """Whether observations are shifted and scaled by their statistics so far. They are clipped to ±5 either way."""
    ppo_weight: jax.Array | float = 1.0
    """Weight of PPO's loss for the policy; 0 leaves it to the likelihood."""
    likelihood_weight: jax.Array | float = 1.0
    """Weight of the likelihood of expert samples beside PPO's loss, where the config has a `likelihood_batch`."""
    action_std: Any = 0.3
    """Standard deviation of the policy, in units of action: one number, or `[action_size]`, one for each of them."""
    final_action_std: jax.Array | float = 1.0
    """What that deviation has shrunk to at the end of the last round, as a share of its start: wide to explore, narrow
    where a place must be met exactly."""
    discount: jax.Array | float = 0.98
    gae_lambda: jax.Array | float = 0.95
    clip_ratio: jax.Array | float = 0.2
    """PPO's bound on the change of an action's probability."""
    policy_learning_rate: jax.Array | float = 3e-4
    """Adam's step size for the policy and the value function."""
    discriminator_learning_rate: jax.Array | float = 1e-3
    """Adam's step size for the discriminator."""

    def validate(self, action_size: int | None = None) -> "Hyperparameters":
        """Returns itself.

        Args:
          action_size: numbers in an action of the task, if it is known.

        Raises:
          ValueError: a value is out of its range. Values that are being traced pass unseen.

        """
        for name in ("p_ht", "environment_reward", "discount", "gae_lambda"):
            check_share(name, getattr(self, name))
        for name in ("include_current", "ties_by_distance"):
            check_share(name, getattr(self, name))
        for name in ("standardize_reward", "standardize_advantage", "standardize_observation"):
            check_share(name, getattr(self, name))
        for name in (
            "action_std",
            "final_action_std",
            "clip_ratio",
            "reward_scale",
            "policy_learning_rate",
            "discriminator_learning_rate",
        ):
            check_positive(name, getattr(self, name))
        for name in ("ppo_weight", "likelihood_weight", "trivial_weight"):
            check_not_negative(name, getattr(self, name))
        std = self.action_std
        shape = (len(std),) if isinstance(std, tuple | list) else np.shape(std)  # of tracers too
        if action_size is not None and shape not in ((), (action_size,)):
            raise ValueError(f"action_std is {self.action_std}; it must be one number or {action_size}")
        check_choice("strategy", self.strategy, STRATEGIES)
        check_choice("reward", self.reward, REWARDS)
        return self
