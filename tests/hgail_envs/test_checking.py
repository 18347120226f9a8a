"""Tasks with one mistake each, and what is said of it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.point import Point


class Wrong(Point):
    """A `Point` with other attributes and methods, given to the constructor."""

    def __init__(self, **changes):
        for name, value in changes.items():
            setattr(self, name, value)


def leaking():
    """A task that keeps an array of one call for another."""

    class Leaking(Point):
        def reset_physics(self, rng):
            self.start = jax.random.normal(rng, (3,))
            return self.start

        def step_physics(self, physics, action):
            return self.start + action

    return Leaking()


def noisy():
    """A task whose observation hindsight cannot rebuild."""

    class Noisy(Point):
        def reset(self, rng, training_goals=False):
            state = super().reset(rng, training_goals)
            return state.replace(obs=state.obs + 0.01)

    return Noisy()


def silent():
    """A task whose states lack what hindsight reads."""

    class Silent(Point):
        def reset(self, rng, training_goals=False):
            state = super().reset(rng, training_goals)
            return state.replace(info={name: state.info[name] for name in ("features", "desired_goal")})

    return Silent()


def on_host(physics, action):
    return jax.pure_callback(lambda x: x, jax.ShapeDtypeStruct((3,), jnp.float32), physics + action)


MISTAKES = [
    (
        Wrong(feature_size=4),
        r"Wrong.features gives float32 \[3\]; it must give float32 \[4\], that is \[feature_size\]",
    ),
    (Wrong(goal_size=2), r"Wrong.achieved_goal gives float32 \[3\]; it must give float32 \[2\], that is"),
    (Wrong(action_size=2), r"Wrong.step_physics fails: TypeError: .*\(3,\), \(2,\)"),
    (Wrong(episode_length=2.5), "Wrong.episode_length is 2.5; it must be an integer"),
    (Wrong(goal_size=0), "Wrong.goal_size is 0; it must be at least 1"),
    (Wrong(lift_test_steps=-1), "Wrong.lift_test_steps is -1; it must be at least 0"),
    (Wrong(success_threshold=None), "Wrong.success_threshold is missing; set it in the class"),
    (Wrong(success_threshold=float("nan")), "Wrong.success_threshold is nan; it must be positive and finite"),
    (Wrong(features=lambda physics: None), "Wrong.features gives None; it must give float32"),
    (Wrong(features=lambda physics: physics.astype(int)), r"Wrong.features gives int32 \[3\]; it must give float32"),
    (Wrong(features=lambda physics: physics / 0), r"Wrong.reset gives a State whose info\['features'\] is not finite"),
    (Wrong(sample_goal=lambda rng, physics: jnp.zeros(2)), r"Wrong.sample_goal gives float32 \[2\]; it must give"),
    (
        Wrong(plan_goals=lambda rng, physics, training_goals: jnp.zeros(())),
        r"Wrong.current_goal gives float32 \[\]; it must give float32 \[3\]",
    ),
    (
        Wrong(current_goal=lambda plan, physics, step: plan[:1]),
        r"Wrong.current_goal gives float32 \[1\]; it must give float32 \[3\]",
    ),
    (
        Wrong(already_solved=lambda features, goal: False),
        r"Wrong.already_solved gives bool \[\]; it must give bool \[2, 3\]",
    ),
    (Wrong(lift_test_action=lambda action: action[None]), r"Wrong.lift_test_action gives float32 \[1, 3\]"),
    (Wrong(overflow=lambda physics: physics > 1), r"Wrong.overflow gives bool \[3\]; it must give bool \[\]"),
    (Wrong(goal_kind=lambda goal: jnp.int32(0)), r"Wrong.goal_kind gives int32 \[\]; it must give int32 \[2, 3\]"),
    (
        Wrong(goal_observation=lambda features, goal: jnp.concatenate([features, goal])),
        r"Wrong.goal_observation gives float32 \[4, 3, 3\]; it must give float32 \[2, 3, 6\]",
    ),
    (
        Wrong(success=lambda achieved, desired: jnp.linalg.norm(achieved - desired) < 1.0),
        r"Wrong.success gives bool \[\]; it must give bool \[2, 3\]",
    ),
    (
        Wrong(goal_test=lambda features, achieved, goal: jnp.linalg.norm(achieved - goal) < 1.0),
        r"Wrong.goal_test gives bool \[\]; it must give bool \[2, 3\]",
    ),
    (
        Wrong(step_physics=lambda physics, action: physics.astype(jnp.float16)),
        r"Wrong.step_physics gives float16 \[3\]; it must give what reset_physics does, float32 \[3\]",
    ),
    (
        Wrong(step_physics=lambda physics, action: {"position": physics}),
        r"Wrong.step_physics gives {'position': 'float32 \[3\]'}; it must give what reset_physics does",
    ),
    (
        Wrong(step_physics=lambda physics, action: physics + np.asarray(action)),
        r"Wrong.step_physics fails \(.*test_checking.py:\d+\): it uses NumPy, .* use jax.numpy, jnp.where",
    ),
    (
        Wrong(step_physics=lambda physics, action: physics if action[0] > 0 else action),
        r"Wrong.step_physics fails \(.*test_checking.py:\d+\): it uses NumPy, or Python's if",
    ),
    (Wrong(step_physics=on_host), "Wrong.step fails .*vmap_method"),  # which shows in a batch alone
    (Wrong(outcome=lambda end, lifted: end.reward), "Wrong.outcome gives float32"),
    (leaking(), "Leaking.*fails.*an array that another call kept"),
    (noisy(), r"Noisy.reset gives a State whose obs is not goal_observation\(info\['features'\]"),
    (silent(), r"Silent.reset gives a State without info\['achieved_goal'\]"),
    (Point, "Point'> is not a GoalEnv"),
]


@pytest.mark.parametrize(("env", "message"), MISTAKES)
def test_a_mistake_is_named(env, message):
    with pytest.raises(ValueError, match=message) as raised:
        hgail_envs.check_task(env)
    assert re.fullmatch(".+", str(raised.value))  # one line


@pytest.mark.parametrize("task", ["point", "grasp", pytest.param("tower", marks=pytest.mark.slow)])
def test_tasks_of_the_package_have_no_mistake(task):
    hgail_envs.check_task(hgail_envs.make(task))


@pytest.mark.parametrize(("room", "batch"), [(None, 2), (1, 1)])
def test_no_more_environments_are_stepped_than_a_task_has_room_for(room, batch):
    seen = set()

    def move(physics, action):
        seen.add(physics.shape)
        return physics

    def step(physics, action):
        shape = jax.ShapeDtypeStruct((3,), jnp.float32)
        return jax.pure_callback(move, shape, physics, action, vmap_method="broadcast_all")

    hgail_envs.check_task(Wrong(max_worlds=room, step_physics=step))
    assert seen == {(batch, 3)}
