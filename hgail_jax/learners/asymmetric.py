"""TD3 whose actor sees pictures while its critics see the state: an asymmetric actor-critic (Pinto et al. 2018).

The actor is a student's network: pictures, the robot's own numbers and the goal's to an action and, as an auxiliary
loss, to the objects' positions. Hindsight changes goals in numbers alone, so that a picture in the replay buffer stays
true. Below, `U` is the gradient steps after a roll-out and `B` the samples in one of them.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from hgail_envs import GoalEnv
from hgail_envs.validation import check_not_negative
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.buffer import EpisodeBuffer, Transitions, init_buffer
from hgail_jax.config import Config
from hgail_jax.learners.td3 import TD3, TD3Hyperparameters
from hgail_jax.learners.td3_step import Batch, GradientStep, Metrics, TD3State
from hgail_jax.rollout import Trajectory
from hgail_jax.state import TrainState
from hgail_jax.vision.augmentation import AUGMENTATIONS, augment
from hgail_jax.vision.network import CHANNELS, Eyes, check_channels, look_before_tanh
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


class AsymmetricState(TD3State):
    """TD3's, with `Eyes` for actors."""

    centre: jax.Array
    """`[3 objects]`: mean positions of the objects in the first roll-out, metres."""


class PictureInput(NamedTuple):
    """Inputs of the actor for `B` samples, and the labels of its second head."""

    pictures: jax.Array
    """`[B, cameras, H, W, colours]` in [0, 1]."""
    numbers: jax.Array
    """`[B, numbers]`, normalised."""
    objects: jax.Array
    """`[B, 3 objects]`, in `OBJECT_SCALE` from their centre."""


@dataclasses.dataclass(frozen=True)
class AsymmetricTD3(TD3):
    """TD3 on a `CameraEnv`; a value out of its range is a ValueError."""

    name: ClassVar[str] = "asymmetric-td3"
    metrics: ClassVar[Mapping[str, str]] = {
        **TD3.metrics,
        "object_error": "root mean square error of the objects' positions along an axis, metres",
    }
    without_effect: ClassVar[tuple[str, ...]] = (*TD3.without_effect, "teacher", "randomize", "checkpoint_every")
    convolves: ClassVar[bool] = True
    resumes: ClassVar[bool] = False

    channels: tuple[int, ...] = CHANNELS
    """Features of the actor's four convolutions."""
    object_weight: float = 1.0
    """Weight of the objects' positions in the actor's loss; with 0 it learns from the critics alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_channels(self.channels)
        check_not_negative("object_weight", self.object_weight)

    def validate(self, env: GoalEnv, config: Config) -> None:
        """See `Learner`; the task has pictures, its goals are numbers."""
        super().validate(env, config)
        if not isinstance(env, CameraEnv):
            raise ValueError(f"the learner {self.name} needs a task with pictures: --observe camera")
        if env.pictures.target == "seen":
            raise ValueError("--target seen needs a teacher: hindsight cannot change a target that is in the pictures")
        if self.achieved_first:
            raise ValueError(f"achieved_first is {self.achieved_first}; with pictures it must be 0")
        check_hidden(config)

    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> AsymmetricState:
        """See `Learner`."""
        seen, usual = cast(CameraEnv, env), super().init(env, config, rngs)
        eyes = init_for_task(seen, config, self.channels, rngs[0])
        networks = usual.online._replace(actor=eyes)
        return AsymmetricState(
            online=networks,
            target=networks,
            optimizer=usual.optimizer._replace(actor=optax.scale_by_adam().init(eyes)),
            steps=usual.steps,
            centre=jnp.zeros(len(seen.objects)),
        )

    def init_buffer(self, env: GoalEnv) -> EpisodeBuffer:
        """See `Learner`; each state's pictures are kept once, but for the last of an episode, which none are of."""
        seen = cast(CameraEnv, env)
        noted = {
            "pictures": jax.ShapeDtypeStruct((math.prod(seen.pictures.shape),), jnp.uint8),
            "objects": jax.ShapeDtypeStruct((len(seen.objects),), jnp.float32),
        }
        return init_buffer(env, self.buffer_episodes, noted)

    def begin(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """See `TD3`; the first roll-out also decides what objects' positions are measured from."""
        state, metrics = super().begin(env, config, state, trajectory, rng)
        return state.replace(learner=state.learner.replace(centre=mean_positions(trajectory))), metrics

    def act(self, env: GoalEnv, config: Config, state: TrainState, observation: jax.Array) -> tuple[jax.Array, Any]:
        """See `TD3`; what the actor sees, and where the objects are, is noted."""
        seen = cast(CameraEnv, env)
        noted = _note(seen, observation)
        numbers = _normal(seen, state, observation)
        return act_by_seed(state.learner.target.actor, _pictures(seen, noted), numbers), noted

    def camera_policy(self, env: GoalEnv, state: TrainState) -> dict[str, Any]:
        """See `Learner`."""
        mean, std = _normalisation(cast(CameraEnv, env), state)
        return {"mean": mean, "std": std, "centre": state.learner.centre, "eyes": state.learner.target.actor}

    def actor_inputs(self, env: GoalEnv, state: TrainState, drawn: Transitions) -> tuple[Any, Any]:
        """See `TD3`: normalised numbers, and where in the buffer the pictures are, which `fit` looks up."""
        seen, place = cast(CameraEnv, env), (drawn.episode, drawn.step)
        return (_normal(seen, state, drawn.observation), place), _normal(seen, state, drawn.next_observation)

    def fit(
        self, env: GoalEnv, config: Config, state: TrainState, minibatches: Batch, rng: jax.Array
    ) -> tuple[TD3State, Metrics]:
        """See `TD3`; one seed after another, as their convolutions are fast only so."""
        rngs = jax.random.key_data(jax.random.split(jax.random.fold_in(rng, 2), self.updates))
        fit = jax.custom_batching.sequential_vmap(functools.partial(_fit, config, cast(CameraEnv, env)))
        learner, metrics = fit(state.learner, state.hyperparameters, state.buffer.noted, minibatches, rngs)
        return cast(TD3State, learner), metrics


def _note(env: CameraEnv, observation: jax.Array) -> dict[str, jax.Array]:
    """Returns what the buffer keeps of observations, `[N, ...]`; pictures are one axis, so that nothing transposes."""
    return {"pictures": env.see(observation).reshape(len(observation), -1), "objects": observation[:, env.objects]}


def _pictures(env: CameraEnv, noted: Mapping[str, jax.Array]) -> jax.Array:
    return noted["pictures"].reshape(-1, *env.pictures.shape)


def _normalisation(env: CameraEnv, state: TrainState) -> tuple[jax.Array, jax.Array]:
    """Returns mean and standard deviation of the numbers that the actor observes, `[numbers]` each."""
    return state.statistics.mean[env.known], jnp.maximum(state.statistics.std[env.known], LEAST_STD)


def _normal(env: CameraEnv, state: TrainState, observation: jax.Array) -> jax.Array:
    """Returns the numbers that the actor observes of observations, `[B, numbers]`."""
    mean, std = _normalisation(env, state)
    return (observation[:, env.known] - mean) / std


def _fit(
    config: Config,
    env: CameraEnv,
    learner: AsymmetricState,
    hyper: TD3Hyperparameters,
    noted: Any,
    minibatches: Batch,
    rngs: jax.Array,
) -> tuple[TD3State, Metrics]:
    """Takes a gradient step for each minibatch, leaves `[U, B, ...]`, on what is noted in the buffer."""
    step = PictureStep(config, hyper)

    def on_pictures(state: TD3State, inputs: tuple[Batch, jax.Array]) -> tuple[TD3State, Metrics]:
        return step(state, with_pictures(env, noted, learner.centre, *inputs))

    return jax.lax.scan(on_pictures, learner, (minibatches, rngs))


def with_pictures(env: CameraEnv, noted: Any, centre: jax.Array, batch: Batch, rng: jax.Array) -> Batch:
    """Returns a minibatch of `AsymmetricTD3.actor_inputs` with the pictures that are noted in the buffer.

    The actor's input is a `PictureInput`; in the next state it is pictures, which are not varied, and numbers. `rng`
    is a key's data. No picture was taken after the last step of an episode, so that its sample weighs nothing.
    """
    numbers, (episode, time) = batch.actor_input
    last = env.episode_length - 1
    now = jax.tree.map(lambda leaf: leaf[episode, time], noted)
    then = jax.tree.map(lambda leaf: leaf[episode, jnp.minimum(time + 1, last)], noted)
    pictures, following = (unit_range(_pictures(env, each)) for each in (now, then))
    varied = augment(AUGMENTATIONS[env.pictures.kind][env.pictures.look], jax.random.wrap_key_data(rng), pictures)
    return batch._replace(
        actor_input=PictureInput(varied, numbers, (now["objects"] - centre) / OBJECT_SCALE),
        next_actor_input=(following, batch.next_actor_input),
        weight=jnp.where(time < last, batch.weight, 0.0),
    )


class PictureStep(GradientStep):
    """A gradient step whose samples have pictures, see `PictureInput`."""

    def act(self, actor: Eyes, batch: Batch) -> tuple[jax.Array, jax.Array | float, Metrics]:
        """See `GradientStep`; the auxiliary loss is that of the objects' positions, as a student has it."""
        pictures, numbers, positions = batch.actor_input
        preactivation, objects = look_before_tanh(actor, pictures, numbers, precision())
        error = squared_error(objects, positions, batch.weight)
        weight = cast(AsymmetricTD3, self.config.learner).object_weight
        return preactivation, weight * error, {"object_error": OBJECT_SCALE * jnp.sqrt(error)}

    def act_next(self, actor: Eyes, batch: Batch) -> jax.Array:
        """See `GradientStep`."""
        pictures, numbers = batch.next_actor_input
        return look_before_tanh(actor, pictures, numbers, precision())[0]
