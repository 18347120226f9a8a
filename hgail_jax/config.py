"""Settings of a training: static sizes in `Config`, sweepable scalars in `Hyperparameters`."""

import dataclasses
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hgail_envs import GoalEnv
from hgail_envs.validation import check_choice, check_count, check_fraction, check_not_negative, check_positive
from hgail_jax.hindsight import FINAL, FUTURE
from hgail_jax.learner import Learner, check_sizes

STRATEGIES = {"future": FUTURE, "final": FINAL}
"""Hindsight strategies by name."""
REWARDS = {"r1": 0, "r2": 1, "r3": 2, "r4": 3}
"""Reward forms by name, see `hgail_jax.discriminator`."""
EXPERT_SOURCES = ("relabelled", "frozen", "demonstrations", "best")
"""Sources of expert samples, see `hgail_jax.experts`."""
RELABELLED, FROZEN, DEMONSTRATIONS, BEST = EXPERT_SOURCES

_MOST_SAMPLES = 2**31 - 1  # indices are 32 bits wide


@dataclasses.dataclass(frozen=True)
class Config:
    """Shapes and counts of a training: all that decides the compiled program.

    A sample is one step of one episode; a roll-out holds `num_envs` episodes. A value out of its range is a ValueError.
    """

    learner: Learner
    """Learner, with its own sizes: an object of a class in `hgail_jax.learners`."""
    num_envs: int = 64
    """Episodes in a roll-out."""
    rounds: int = 6
    """Rounds of Algorithm 2 after the pre-training."""
    expert_source: str = RELABELLED
    """Source of the expert samples: one of `EXPERT_SOURCES`."""
    best_episodes: int = 1000
    """Episodes kept where the expert samples are the best so far."""
    training_goals: bool = True
    """Whether to learn on the task's training goals (waypoints, relays, random places); else on the evaluation's."""
    discriminator_minibatches: int = 50
    """Gradient steps in one discriminator update; 0, off-policy alone, is HER: the goal test is the whole reward."""
    discriminator_batch: int = 512
    """Expert samples, and as many of the policy's, in a gradient step of the discriminator."""
    policy_hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of the policy and of the value functions."""
    discriminator_hidden: tuple[int, ...] = (100, 100)
    """Widths of the hidden layers of the discriminator."""
    layer_norm: bool = False
    """Whether hidden layers are ReLU after layer normalisation, in all networks; else tanh."""

    def __post_init__(self) -> None:
        if not isinstance(self.learner, Learner):
            raise ValueError(f"learner is {self.learner!r}; it must be a learner with its sizes, e.g. PPO()")
        check_sizes(self, may_be_zero=("rounds", "discriminator_minibatches"))
        if self.expert_source not in EXPERT_SOURCES:
            raise ValueError(f"expert_source is {self.expert_source!r}; it must be one of {', '.join(EXPERT_SOURCES)}")
        for name in ("policy_hidden", "discriminator_hidden"):
            if not isinstance(getattr(self, name), tuple):
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must be a tuple of widths")
            for width in getattr(self, name):
                check_count(f"a width in {name}", width)

    def replace(self, **changes: Any) -> "Config":
        """Returns a copy with some fields changed, the learner's own sizes among them; unknown ones are a ValueError.

        >>> from hgail_jax.learners import PPO
        >>> config = Config(PPO()).replace(num_envs=8, minibatches=2)
        >>> config.num_envs, config.learner.minibatches
        (8, 2)
        """
        own = {field.name for field in dataclasses.fields(self)}
        sizes = set(vars(self.learner))
        for name in changes:
            if name not in own | sizes:
                raise ValueError(f"Config has no field {name!r}, nor has the learner {self.learner.name}")
        changed = {name: value for name, value in changes.items() if name in own}
        learner = changed.pop("learner", self.learner)
        learner = dataclasses.replace(learner, **{name: changes[name] for name in changes if name in sizes - own})
        return dataclasses.replace(self, learner=learner, **changed)

    def as_dict(self) -> dict[str, Any]:
        """Returns the fields as JSON has them, the learner's with its name."""
        learner = {"name": self.learner.name} | vars(self.learner)
        return vars(self) | {"learner": learner}

    def validate(self, env: GoalEnv) -> "Config":
        """Returns itself; a ValueError if a roll-out on `env` does not fit the learner or has too many samples."""
        if not isinstance(env, GoalEnv):
            raise ValueError(f"{env!r} is not a GoalEnv")
        samples = self.num_envs * env.episode_length
        self.learner.validate(env, self)
        check_count("num_envs, times the steps of an episode,", samples, most=_MOST_SAMPLES)
        return self


class Hyperparameters(struct.PyTreeNode):
    """Scalars of the algorithm. They are leaves of the training state, so that `jax.vmap` can sweep any of them.

    A learner that has more of them is given a subclass, see `Learner.hyperparameters`.
    """

    fractions: ClassVar[tuple[str, ...]] = (
        *("p_ht", "environment_reward", "discount", "gae_lambda", "include_current", "ties_by_distance"),
        *("standardize_reward", "goal_jitter", "shuffled_goals"),
    )
    """Fields that are 0 to 1."""
    positive: ClassVar[tuple[str, ...]] = (
        *("exploration_noise", "final_exploration_noise", "clip_ratio", "negative_weight"),
        *("policy_learning_rate", "discriminator_learning_rate"),
    )
    """Fields above 0."""
    not_negative: ClassVar[tuple[str, ...]] = ("ppo_weight", "bc_weight", "solved_weight")
    """Fields that are 0 or more."""

    p_ht: jax.Array | float = 1.0
    """Probability that a step's goal is replaced in hindsight."""
    strategy: jax.Array | int = FUTURE
    """Hindsight strategy: a value of `STRATEGIES`."""
    include_current: jax.Array | bool = False
    """Whether "future" may also pick the position achieved before the step's own action."""
    solved_weight: jax.Array | float = 1.0
    """Weight of relabelled samples whose goal is already solved, see `GoalEnv.already_solved`."""
    ties_by_distance: jax.Array | bool = False
    """Whether, of equally good episodes, those that end nearer to their goal are kept; see `keep_best`."""
    reward: jax.Array | int = REWARDS["r1"]
    """Reward form, a function of the discriminator's logit: a value of `REWARDS`."""
    environment_reward: jax.Array | float = 0.0
    """Weight of the environment's reward (-1, 0 on success); the discriminator's has the rest up to 1."""
    standardize_reward: jax.Array | bool = True
    """Whether PPO's reward is shifted and scaled to mean 0 and standard deviation 1 over a roll-out. That removes the
    scale that distinguishes r1 to r4, and makes a rare success large: one among 51,200 steps is worth +226."""
    ppo_weight: jax.Array | float = 1.0
    """Weight of PPO's loss for the policy; 0 leaves it to behaviour cloning."""
    bc_weight: jax.Array | float = 1.0
    """Weight of the behaviour-cloning (BC) loss: with PPO the negative log-likelihood of expert samples, where the
    config has a `bc_batch`; with TD3 the squared distance from actions of the buffer that the critics prefer."""
    exploration_noise: Any = 0.3
    """Standard deviation of the policy, in units of action: one number, or `[action_size]`, one for each of them."""
    final_exploration_noise: jax.Array | float = 1.0
    """Standard deviation at the end of the last round, as a fraction of its start: wide to explore, narrow where a
    place must be met exactly."""
    discount: jax.Array | float = 0.98
    gae_lambda: jax.Array | float = 0.95
    clip_ratio: jax.Array | float = 0.2
    """PPO's bound on the change of an action's probability."""
    policy_learning_rate: jax.Array | float = 3e-4
    """Adam's step size for the policy and the value functions."""
    discriminator_learning_rate: jax.Array | float = 1e-3
    """Adam's step size for the discriminator."""
    goal_jitter: jax.Array | float = 0.0
    """Edge of the box from which the discriminator's expert samples draw their goals, as a fraction of the task's
    `GoalEnv.goal_tolerance`; 0 is the paper's, the very position that is achieved."""
    shuffled_goals: jax.Array | float = 0.0
    """Fraction of the discriminator's policy samples that have the goal of another one; 0 is the paper's, the goals
    that were pursued. With 1 the best logit is log p(goal achieved next | s, a) - log p(goal), as in contrastive RL."""
    negative_weight: jax.Array | float = 1.0
    """Weight of the policy samples in the discriminator's loss, beside 1 of the expert's."""

    def as_arrays(self) -> Self:
        """Returns itself with arrays for leaves; whole numbers in fields of floats become floats."""

        def array(field: dataclasses.Field) -> jax.Array:
            value = jnp.asarray(getattr(self, field.name))
            whole = jnp.issubdtype(value.dtype, jnp.integer) and isinstance(field.default, float)
            return value.astype(float) if whole else value

        return type(self)(**{field.name: array(field) for field in dataclasses.fields(self)})

    def as_dict(self) -> dict[str, Any]:
        """Returns the fields as JSON has them."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def validate(self, action_size: int | None = None, config: Config | None = None) -> Self:
        """Returns itself, checked against the sizes of an action and of the training, where they are known.

        A value out of its range, or that contradicts the sizes, is a ValueError; none that is being traced is checked.
        """
        for name in self.fractions:
            check_fraction(name, getattr(self, name))
        for name in self.positive:
            check_positive(name, getattr(self, name))
        for name in self.not_negative:
            check_not_negative(name, getattr(self, name))
        std = self.exploration_noise
        shape = (len(std),) if isinstance(std, tuple | list) else np.shape(std)  # of tracers too
        if action_size is not None and shape not in ((), (action_size,)):
            raise ValueError(f"exploration_noise is {self.exploration_noise}; it must be one number or {action_size}")
        check_choice("strategy", self.strategy, STRATEGIES)
        check_choice("reward", self.reward, REWARDS)
        if config is not None and type(self) is not config.learner.hyperparameters:
            own = config.learner.hyperparameters.__name__
            raise ValueError(f"the learner {config.learner.name} takes {own}, not {type(self).__name__}")
        if config is not None and not any(isinstance(value, jax.core.Tracer) for value in jax.tree.leaves(self)):
            config.learner.check_hyperparameters(config, self)
        return self
