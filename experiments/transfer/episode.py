"""Runs a policy on a robot that it was not trained on, with errors of sensors and model, and measures it."""

import collections
import contextlib
from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.robots.base import Robot
from hgail_envs import EpisodeMetrics, find_class
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.tasks import numpy_episode


def run_episode(
    robot: Robot,
    policy: MeanAction,
    rng: np.random.Generator,
    conditions: Conditions | None = None,
) -> EpisodeMetrics:
    """Runs one episode from the robot's present state, and the lift test if the task has one.

    Args:
      robot: already reset.
      policy: decides the actions.
      rng: for the estimate of the target's position.
      conditions: of the episode; None is nominal.

    Returns:
      Metrics of the last step, as `GoalEnv.outcome` of the robot's task defines them, as plain numbers.
    """
    conditions = conditions or Conditions()
    with changed(robot, conditions.friction, conditions.object_mass, conditions.gravity):
        return _run(robot, policy, rng, conditions)


def _run(robot: Robot, policy: MeanAction, rng: np.random.Generator, conditions: Conditions) -> EpisodeMetrics:
    """Runs the episode in the robot's present model; see `run_episode`."""
    action_size = find_class(robot.task).action_size
    pending = collections.deque([np.zeros(action_size, np.float32)] * conditions.delay)
    factors = np.append(np.full(3, conditions.stride), 1.0)  # the hand's command is not a displacement
    sensors = Sensors(robot, policy, rng, conditions)
    trained = trained_under(policy)
    past = Past(trained, min(conditions.delay, trained.known_delay))  # of a longer delay it knows the newest actions

    def act() -> np.ndarray:
        seen, goal = sensors.observe()
        action = np.clip(policy(np.concatenate([past.before(seen), seen, goal]).astype(np.float32)), -1.0, 1.0)
        past.add(action, seen)
        pending.append(action * factors)
        return pending.popleft()

    return numpy_episode.run_episode(robot, act)


def run_episodes(
    robot: Robot,
    policies: Sequence[MeanAction],
    indices: Iterable[int],
    seed: int = 0,
    conditions: Conditions | None = None,
) -> list[EpisodeMetrics]:
    """Runs the episodes with these indices, the policies taking turns.

    An episode's start depends on the seed and its index alone, so all conditions are compared on the same starts.
    """
    outcomes = []
    for index in indices:
        start_rng, estimate_rng = np.random.default_rng((seed, index)).spawn(2)
        robot.reset(start_rng)
        outcomes.append(run_episode(robot, policies[index % len(policies)], estimate_rng, conditions))
    return outcomes


@contextlib.contextmanager
def changed(robot: Robot, friction: float, object_mass: float, gravity: float) -> Iterator[None]:
    """Changes the robot's model, and undoes it in the end.

    Args:
      robot: the robot with the model.
      friction: factor on the friction of all contacts.
      object_mass: factor on the mass of the cube, if there is one.
      gravity: fraction of the arm's weight that is not compensated, in a model that compensates it.
    """
    if (friction, object_mass, gravity) == (1.0, 1.0, 0.0):
        yield
        return
    model = robot.model
    names = ("geom_friction", "pair_friction", "body_mass", "body_inertia", "body_gravcomp")
    before = {name: getattr(model, name).copy() for name in names}
    cube = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, robot.cube)
    try:
        model.geom_friction *= friction
        model.pair_friction *= friction
        model.body_gravcomp *= 1.0 - gravity
        if cube >= 0:
            body = model.geom_bodyid[cube]
            model.body_mass[body] *= object_mass
            model.body_inertia[body] *= object_mass
        _derive(model, object_mass)
        yield
    finally:
        for name, values in before.items():
            getattr(model, name)[...] = values
        _derive(model, object_mass)


def _derive(model: mujoco.MjModel, object_mass: float) -> None:
    """Recomputes the model's constants that derive from masses, if these have changed."""
    if object_mass != 1.0:
        mujoco.mj_setConst(model, mujoco.MjData(model))


def tracks_cube(policy: MeanAction) -> bool:
    """Returns whether a policy observes the cube at each step; see `hgail_envs.tasks.grasp.Grasp`."""
    return getattr(policy, "task_options", {}).get("cube") == "tracked"


def trained_under(policy: MeanAction) -> Randomization:
    """Returns the randomisation of a policy's training; a script had none."""
    return getattr(policy, "randomization", Randomization())


class Sensors:
    """The sensors of an episode, with their errors.

    Args:
      robot: at the start of the episode.
      policy: with `task_options`, if it has any.
      rng: source of the errors; exact sensors draw none.
      conditions: with the errors' sizes.
    """

    def __init__(self, robot: Robot, policy: MeanAction, rng: np.random.Generator, conditions: Conditions) -> None:
        self._robot, self._rng, self._conditions = robot, rng, conditions
        self._look = conditions.estimate(rng)
        self._tracks = tracks_cube(policy)
        self._target = None if self._tracks else self._look(robot.target())
        self._goal_size = find_class(robot.task).goal_size
        options = getattr(policy, "task_options", {}) | {"cube": "at-start"}  # the sensors add a tracked cube
        self._layout = find_class(robot.task).features_with(**options)
        self._offset = self._draw(conditions.robot_offset)
        self._noise: np.ndarray | None = None

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns features and goal at a step, `[feature_size]` and `[goal_size]`.

        The errors of the gripper enter its position, its velocity, which is the displacement in the last action, and,
        in a task with an object, the object's position relative to the gripper. A tracked cube is the goal, and is seen
        there and in the features with the same error.
        """
        features, noise = self._robot.features().copy(), self._draw(self._conditions.robot_noise)
        features[self._layout["gripper position"]] += self._offset + noise
        features[self._layout["gripper velocity"]] += 0.0 if self._noise is None else noise - self._noise
        for quantity in self._layout:
            if quantity.name.endswith("position less gripper position"):
                features[self._layout[quantity.name]] -= self._offset + noise
        self._noise = noise
        target = self._look(self._robot.target()) if self._target is None else self._target
        target = target + self._draw(self._conditions.goal_noise)
        if self._tracks:
            features = np.append(features, target - features[:3])
        return features, np.append(target, np.ones(self._goal_size - 3))  # 1: the cube is to be held there

    def _draw(self, deviation: float) -> np.ndarray:
        return deviation * self._rng.standard_normal(3) if deviation else np.zeros(3)
