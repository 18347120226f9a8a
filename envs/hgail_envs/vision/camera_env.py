"""A task whose observation says what its cameras see."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.base import Controller, GoalEnv, State
from hgail_envs.vision.look import LOOKS
from hgail_envs.vision.pictures import Pictures
from hgail_envs.wrapper import Wrapper

KNOWN = (
    *("gripper position", "gripper velocity", "gap between the fingers"),
    *("position of the right finger", "position of the left finger"),
)
"""Quantities of a task's features that a robot measures in itself; the others are seen."""

_OWN = (
    *("feature_size", "features_layout"),
    *("reset_physics", "training_start", "step_physics", "features", "achieved_goal", "sample_goal", "plan_goals"),
    *("current_goal", "goal_observation", "success", "goal_kind", "goal_test", "goal_tolerance", "reached"),
    *("already_solved", "aim", "lift_test_action", "outcome", "overflow", "prepare"),
)
"""More attributes and methods that are the task's."""


class CameraEnv(Wrapper):
    """A task, the `pictures` of it, and a `teacher` that knows more than they show: it reads the task's observations.

    Everything is the task's but `State.obs`: after the task's observation come the joint positions, the target's if its
    marker is in the pictures, and the draws of the episode's look, from which `see` renders. Rendering a whole batch at
    once is left to the policy, for a task is one environment. The draws are uniform, drawn with the episode's key at
    the reset. Where a look has late episodes, half of them for instance, the joint positions are those before the last
    action, while the task's observation is of the present.
    """

    def __init__(self, task: GoalEnv, pictures: Pictures, teacher: Controller | None = None) -> None:
        super().__init__(task, _OWN)
        self.pictures, self.teacher = pictures, teacher
        model, self._late = pictures.model, LOOKS[pictures.look].late
        self.known = known_numbers(task, pictures.target)
        """Places in an observation of the numbers that a policy with pictures has; see `known_numbers`."""
        free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        seen = [*free, pictures.joints - 3] if pictures.marker else free
        self.objects = task.observation_size + np.add.outer(seen, np.arange(3)).astype(int).ravel()
        """Places in an observation of the positions of the objects and of the marker, metres."""

    # The task's methods, which `__init__` sets; without these lines the class would count as abstract.
    reset_physics = step_physics = features = achieved_goal = sample_goal = None  # type: ignore[assignment]

    @property
    def observation_size(self) -> int:
        return self.task.observation_size + self.pictures.joints + self.pictures.draws

    @property
    def goal_observation_size(self) -> int:
        return self.task.observation_size

    def see(self, observation: jax.Array) -> jax.Array:
        """Returns what the cameras see in a batch of states, `[..., *pictures.shape]`, uint8."""
        first = self.task.observation_size
        qpos, draws = jnp.split(observation[..., first:], [self.pictures.joints], axis=-1)
        return self.pictures(qpos, draws)

    def reset(self, rng: jax.Array, training_goals: jax.Array | bool = False) -> State:
        state = self.task.reset(rng, training_goals)
        # the task takes the key apart by `split`, and by `fold_in` of 2
        draws = jax.random.uniform(jax.random.fold_in(rng, 3), (self.pictures.draws,), minval=-1.0)
        info = {"look": draws}
        if self._late:
            late = jax.random.bernoulli(jax.random.fold_in(rng, 4), self._late)
            info |= {"late": late, "shown": self._shown(state)}
        return self._seen(state.replace(info=state.info | info))

    def step(self, state: State, action: jax.Array) -> State:
        return self._seen(self.task.step(state, action))

    def move_target(self, state: State, position: jax.Array) -> State:
        return self._seen(self.task.move_target(state, position))

    def _seen(self, state: State) -> State:
        shown = self._shown(state)
        if self._late:
            before, state = state.info["shown"], state.replace(info=state.info | {"shown": shown})
            shown = jnp.where(state.info["late"], before, shown)
        return state.replace(obs=jnp.concatenate([state.obs, shown, state.info["look"]]))

    def _shown(self, state: State) -> jax.Array:
        """Returns joint positions, and the target's if its marker is in the pictures, `[pictures.joints]`."""
        target = [state.info["desired_goal"][:3]] if self.pictures.marker else []
        return jnp.concatenate([state.pipeline_state.qpos, *target])

    def curriculum(self, progress: jax.Array | float) -> "CameraEnv":
        return CameraEnv(self.task.curriculum(progress), self.pictures, self.teacher)

    def reference_physics(self) -> "CameraEnv":
        return CameraEnv(self.task.reference_physics(), self.pictures, self.teacher)


def known_numbers(task: GoalEnv, target: str) -> np.ndarray:
    """Returns indices of the numbers in a task's observation that a policy with pictures observes: the robot's own.

    The goal's follow them, unless the `target` is `"seen"` instead.
    """
    names = [quantity.title for quantity in task.features_layout if quantity.title in KNOWN]
    own = [np.arange(task.feature_size)[task.features_layout[name]].ravel() for name in names]
    goal = np.arange(task.observation_size - task.goal_size, task.observation_size)
    return np.concatenate([*own, goal] if target == "given" else own)
