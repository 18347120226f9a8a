"""The student: a policy that sees pictures, taught by one that knows the positions.

The teacher labels every state of every roll-out with its own action, as in DAgger (Ross et al. 2011), but each
roll-out is used once. At first the teacher acts in all of the episodes, then in fewer, and after `mixed` roll-outs the
student acts alone. A second head of its network learns to predict the objects' positions. Below, `U` is the gradient
steps after a roll-out, `B` the samples in one of them, and `S` those of a roll-out, `T * N`.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from hgail_envs import GoalEnv
from hgail_envs.validation import check_not_negative
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.descent import gradient_step
from hgail_jax.devices.sharding import local_shard
from hgail_jax.learner import EVALUATE, POLICY, PRETRAIN, Learner, Phase, Update, check_sizes
from hgail_jax.rollout import Policy, Trajectory
from hgail_jax.state import TrainState
from hgail_jax.vision.augmentation import AUGMENTATIONS, Augmentation, augment
from hgail_jax.vision.network import CHANNELS, Eyes, check_channels, look
from hgail_jax.vision.training import (
    LEAST_STD,
    OBJECT_SCALE,
    act_by_seed,
    check_hidden,
    init_for_task,
    mean_positions,
    precision,
    squared_error,
    unit_range,
)

Metrics = dict[str, jax.Array]


class StudentState(struct.PyTreeNode):
    """Network, optimiser, and the normalisation of numbers, which the teacher's first roll-out decides."""

    eyes: Eyes
    optimizer: optax.OptState
    """State of Adam."""
    mean: jax.Array
    """`[numbers]`."""
    std: jax.Array
    """`[numbers]`."""
    centre: jax.Array
    """`[3 objects]`: mean positions of the objects, metres."""
    steps: jax.Array
    """`[]` integer: gradient steps so far."""


class _Lesson(NamedTuple):
    """Samples of a roll-out, `[S, ...]`."""

    pictures: jax.Array
    """`[S, cameras, H, W, colours]`, uint8."""
    numbers: jax.Array
    """`[S, numbers]`, normalised."""
    objects: jax.Array
    """`[S, 3 objects]`, in `OBJECT_SCALE` from their centre."""
    action: jax.Array
    """`[S, action_size]`: the teacher's."""
    weight: jax.Array
    """`[S]`: 0 in an episode whose simulation broke down, else 1."""


@dataclasses.dataclass(frozen=True)
class Student(Learner):
    """A student on a `CameraEnv` with a teacher.

    Raises:
      ValueError: a value is out of its range.
    """

    name: ClassVar[str] = "student"
    metrics: ClassVar[Mapping[str, str]] = {
        "action_error": "root mean square difference from the teacher's actions",
        "object_error": "root mean square error of the objects' positions along an axis, metres",
        "teacher_share": "fraction of the episodes in which the teacher acts",
    }
    hyperparameters: ClassVar[type[Hyperparameters]] = Hyperparameters
    convolves: ClassVar[bool] = True
    squashes: ClassVar[bool] = True
    ignored: ClassVar[tuple[str, ...]] = (
        *("layer_norm", "best_episodes", "final_exploration_noise"),
        *("include_current", "solved_weight", "ties_by_distance"),
        *("ppo_weight", "discount", "gae_lambda", "clip_ratio"),
    )

    mixed: int = 8
    """Roll-outs until the student acts alone."""
    updates: int = 150
    """Gradient steps after each roll-out."""
    batch: int = 1024
    """Samples in one of them."""
    channels: tuple[int, ...] = CHANNELS
    """Features of the four convolutions."""
    object_weight: float = 1.0
    """Weight of the objects' positions in the loss; with 0 the student learns the actions alone."""

    def __post_init__(self) -> None:
        check_sizes(self)
        check_channels(self.channels)
        check_not_negative("object_weight", self.object_weight)

    def validate(self, env: GoalEnv, config: Config) -> None:
        """See `Learner`; the task has pictures and a teacher."""
        if not isinstance(env, CameraEnv) or env.teacher is None:
            raise ValueError("a student needs a task with pictures and a teacher: --observe camera")
        check_hidden(config)

    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> StudentState:
        """See `Learner`."""
        seen = cast(CameraEnv, env)
        eyes = init_for_task(seen, config, self.channels, rngs[0])
        return StudentState(
            eyes=eyes,
            optimizer=optax.scale_by_adam().init(eyes),
            mean=jnp.zeros(len(seen.known)),
            std=jnp.ones(len(seen.known)),
            centre=jnp.zeros(len(seen.objects)),
            steps=jnp.zeros((), jnp.int32),
        )

    def phase_updates(self) -> Mapping[Phase, Update]:
        """See `Learner`; the first roll-out is the teacher's alone, and decides the normalisation."""
        return {PRETRAIN: self.begin, POLICY: self.update}

    def policy(
        self, env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
    ) -> Policy:
        """See `Learner`; the teacher acts, with Gaussian noise, in the first environments of a roll-out to learn from.

        Environments are alike, so that the first of them are as good as any.
        """
        seen, learner = cast(CameraEnv, env), state.learner
        teacher = seen.teacher
        assert teacher is not None  # by `validate`
        share, std = noise * self.teacher_share(learner), jnp.asarray(state.hyperparameters.exploration_noise)

        def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, Any]:
            pictures, count = seen.see(observation), len(observation) * (1 if axis is None else jax.lax.axis_size(axis))
            action = act_by_seed(learner.eyes, pictures, (observation[:, seen.known] - learner.mean) / learner.std)
            gaussian = local_shard(jax.random.normal(rng, (count, env.action_size)), axis)
            taught = jnp.clip(teacher(observation[:, : seen.task.observation_size]) + std * gaussian, -1.0, 1.0)
            led = local_shard(jnp.arange(count) < share * count, axis)
            noted = {"pictures": pictures, "objects": observation[:, seen.objects]}
            return jnp.where(led[:, None], taught, action), noted

        return policy

    def teacher_share(self, state: StudentState) -> jax.Array:
        """Returns the fraction of the episodes in which the teacher acts, `[]`, falling from 1 to 0."""
        return jnp.maximum(1.0 - state.steps / (self.updates * self.mixed), 0.0)

    def progress(self, config: Config, state: TrainState) -> jax.Array:
        """See `Learner`; from the count of gradient steps."""
        return jnp.minimum(state.learner.steps / ((config.rounds + 1) * self.updates), 1.0)

    def phase_table(self, config: Config) -> np.ndarray:
        """See `Learner`."""
        return np.array([[PRETRAIN, EVALUATE]] + [[POLICY, EVALUATE]] * config.rounds)

    def layers(self, state: TrainState) -> list[tuple[jax.Array, ...]]:
        """See `Learner`; a network of pictures has others than a `MeanPolicy`, see `camera_policy`."""
        raise NotImplementedError

    def camera_policy(self, env: GoalEnv, state: TrainState) -> dict[str, Any]:
        """See `Learner`."""
        return {name: getattr(state.learner, name) for name in ("mean", "std", "centre", "eyes")}

    def begin(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Takes the normalisation from the teacher's roll-out, then learns from it."""
        numbers = _observation(env, trajectory)[..., cast(CameraEnv, env).known]
        weight = jnp.broadcast_to(trajectory.valid[None, :, None], numbers.shape)
        mean = numbers.mean(axis=(0, 1), where=weight)
        std = jnp.maximum(numbers.std(axis=(0, 1), where=weight), LEAST_STD)
        learner = state.learner.replace(mean=mean, std=std, centre=mean_positions(trajectory))
        return self.update(env, config, state.replace(learner=learner), trajectory, rng)

    def update(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Labels a roll-out by the teacher and takes gradient steps on samples of it."""
        learner, share = state.learner, self.teacher_share(state.learner)
        lesson = self.lesson(cast(CameraEnv, env), learner, trajectory)
        lesson = jax.tree.map(lambda leaf: leaf.reshape(lesson.weight.size, *leaf.shape[2:]), lesson)
        rate = state.hyperparameters.policy_learning_rate * _cosine(self.progress(config, state))
        pictures = cast(CameraEnv, env).pictures
        augmentation = AUGMENTATIONS[pictures.kind][pictures.look]
        fit = jax.custom_batching.sequential_vmap(functools.partial(_fit, self, augmentation))
        eyes, optimizer, metrics = fit(learner.eyes, learner.optimizer, lesson, jax.random.key_data(rng), rate)
        learner = learner.replace(eyes=eyes, optimizer=optimizer, steps=learner.steps + self.updates)
        return state.replace(learner=learner), metrics | {"teacher_share": share}

    def lesson(self, env: CameraEnv, state: StudentState, trajectory: Trajectory) -> _Lesson:
        """Returns the samples of a roll-out with the teacher's labels, leaves `[T, N, ...]`."""
        observation, seen = _observation(env, trajectory), trajectory.noted
        assert env.teacher is not None
        return _Lesson(
            pictures=seen["pictures"],
            numbers=(observation[..., env.known] - state.mean) / state.std,
            objects=(seen["objects"] - state.centre) / OBJECT_SCALE,
            action=env.teacher(observation),
            weight=jnp.broadcast_to(trajectory.valid.astype(jnp.float32), observation.shape[:2]),
        )


def _observation(env: GoalEnv, trajectory: Trajectory) -> jax.Array:
    """Returns the task's own observations of the states that acted, `[T, N, observation_size]` of the task."""
    return trajectory.observation(env)[:-1]


def _cosine(progress: jax.Array) -> jax.Array:
    return 0.5 * (1.0 + jnp.cos(jnp.pi * progress))


def _fit(
    sizes: Student,
    augmentation: Augmentation,
    eyes: Eyes,
    optimizer: Any,
    lesson: _Lesson,
    rng: jax.Array,
    rate: jax.Array,
) -> tuple[Eyes, Any, Metrics]:
    """Takes gradient steps on samples of a lesson; returns network, optimiser and the metrics' means."""

    def step(carry: tuple[Eyes, Any], rng: jax.Array) -> tuple[tuple[Eyes, Any], Metrics]:
        eyes, optimizer = carry
        draw_rng, augment_rng = jax.random.split(rng)
        drawn = jax.random.randint(draw_rng, (sizes.batch,), 0, len(lesson.weight))
        sample = jax.tree.map(lambda leaf: leaf[drawn], lesson)
        pictures = augment(augmentation, augment_rng, unit_range(sample.pictures))
        gradient, metrics = jax.grad(_loss, has_aux=True)(eyes, pictures, sample, sizes.object_weight)
        return gradient_step(optax.scale_by_adam(), eyes, optimizer, gradient, rate), metrics

    (eyes, optimizer), metrics = jax.lax.scan(
        step, (eyes, optimizer), jax.random.split(jax.random.wrap_key_data(rng), sizes.updates)
    )
    return eyes, optimizer, {name: jnp.sqrt(values.mean()) for name, values in metrics.items()}


def _loss(eyes: Eyes, pictures: jax.Array, sample: _Lesson, object_weight: float) -> tuple[jax.Array, Metrics]:
    """Returns the loss, `[]`, and the squared errors of actions and positions for the metrics."""
    action, objects = look(eyes, pictures, sample.numbers, precision())
    of_action = squared_error(action, sample.action, sample.weight)
    of_objects = squared_error(objects, sample.objects, sample.weight)
    loss = of_action + object_weight * of_objects
    return loss, {"action_error": of_action, "object_error": of_objects * OBJECT_SCALE**2}
