"""Names of the numbers of an observation, against C MuJoCo's own quantities of the same state."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.layout import FRAMES
from hgail_envs.quantities import describe
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import randomize

OBSERVATIONS = [(task, "compact") for task in hgail_envs.TASKS if task not in ("point", "push")]
OBSERVATIONS += [("push", "official")]
OBSERVATIONS += [
    pytest.param(*row, marks=pytest.mark.slow)
    for row in [("push", "compact"), ("pick-and-place", "official"), ("slide", "official")]
]
OBSERVATIONS += [("grasp", "tracked")]

THINGS = {"cube": "cube", "puck": "puck", "cube_a": "cube A", "cube_b": "cube B"}
ROLES = ("top", "middle", "base")
TURNED = ("target's cube", "cube below it", "third cube")


def vector(name, values):
    return dict(zip([f"{name} {axis}" for axis in "xyz"], values, strict=True))


def measured(env, state, target):
    """Returns what C MuJoCo measures, by the names of the quantities; times are in actions."""
    physics = state.pipeline_state
    model, data = env.model, mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
    mujoco.mj_forward(model, data)
    twist = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site("grip").id, twist, 0)
    grip, motion = data.site("grip").xpos, twist[3:] * 0.04
    fingers = [data.joint(f"{side}_finger") for side in ("right", "left")]
    found = vector("gripper position", grip) | vector("gripper velocity", motion) | vector("target position", target)
    found["gap between the fingers"] = sum(float(finger.qpos[0]) for finger in fingers)
    for side, finger in zip(("right", "left"), fingers, strict=True):
        found |= {f"position of the {side} finger": finger.qpos[0]}
        found |= {f"velocity of the {side} finger": finger.qvel[0] * 0.04}
    bodies, things = {model.body(index).name for index in range(model.nbody)}, THINGS
    if "cube_c" in bodies:  # which of the tower's cubes has which role differs
        first = int(np.argmax(state.info["desired_goal"][3:6]))
        turned = np.roll(physics.order, -first)
        things = {f"cube_{'abc'[cube]}": name for name, cube in zip(TURNED, turned, strict=True)}
    for body, thing in things.items():
        if body not in bodies:
            continue
        centre, joint = data.body(body).xpos, data.joint(body)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, twist, 0)
        found |= vector(f"{thing} position", centre) | vector(f"{thing} position less gripper position", centre - grip)
        found |= vector(f"{thing} velocity", joint.qvel[:3] * 0.04)
        found |= vector(f"{thing} velocity less gripper velocity", joint.qvel[:3] * 0.04 - motion)
        found |= vector(f"{thing} angular velocity", twist[:3] * 0.04)
    return found


@pytest.mark.parametrize(("task", "observation"), OBSERVATIONS)
def test_each_number_is_what_its_name_says(task, observation):
    options = {"compact": {}, "tracked": {"cube": "tracked"}}.get(observation, {"observation": observation})
    env = hgail_envs.make(task, impl="c", substeps=4, **options)
    described = describe(task, **options)
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(1))
    for action in ([0.9, -0.5, -1.0, 0.3], [0.2, 0.7, -0.4, 0.6], [-1.0, 0.1, 0.8, -0.2]):
        state = step(state, np.float32(action))
    physics = state.pipeline_state
    if env._scene_model.has_object:  # thrown, so that no two of its quantities are equal
        velocity = np.array([0.3, -0.7, 1.1, 2.0, -3.0, 5.0])
        objects = env._scene_model.object_qvel[:, :1]
        thrown = np.array(physics.qvel)
        thrown[objects + np.arange(6)] = velocity + np.arange(len(objects))[:, None]
        physics = physics.replace(qvel=thrown)
        state = state.replace(pipeline_state=physics)
    look = jax.jit(lambda physics, goal: env.goal_observation(env.features(physics), goal))
    seen = np.asarray(look(physics, state.info["desired_goal"]))
    names = [number.name for number in described.observation.numbers]
    assert len(names) == len(set(names)) == env.observation_size
    known = measured(env, state, np.asarray(state.info["desired_goal"])[:3])
    compared = [index for index, name in enumerate(names) if name in known]
    np.testing.assert_allclose(seen[compared], [known[names[index]] for index in compared], atol=2e-5)
    others = {name for name in names if name not in known and "Euler" not in name}
    assert others <= {
        "hand holds the cube",
        "to hold the cube at the target",
        "target is the object's, not the gripper's",
        "hand holds cube A",
        "target is cube A's",
        "target is cube B's",
        "cube A is to be left at the target",
        "hand holds a cube",
        *(f"target is the {role} cube's" for role in ROLES),
        "the cube is to be left at the target",
    }
    assert described.action.size == env.action_size
    assert all(quantity.frame in (*FRAMES, "") for layout in described for quantity in layout)


def test_actions_on_their_way_are_named_in_their_order():
    env = randomize(hgail_envs.make("point"), Randomization(delay=(2, 2), known_delay=3, history=1))
    named = [number.title for number in describe("point", history=1, known_delay=3).features.numbers]
    assert len(named) == len(set(named)) == env.feature_size
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for action in ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6]):
        state = step(state, np.float32(action))
    seen = dict(zip(named, np.asarray(state.info["features"]), strict=True))
    for back, (there, x) in {"1 step": (1, 0.4), "2 steps": (1, 0.1), "3 steps": (0, 0)}.items():
        assert seen[f"whether there is an action, sent {back} ago and on its way"] == there
        assert seen[f"displacement x, sent {back} ago and on its way"] == pytest.approx(x)


def test_a_history_is_named_in_its_order():
    env = randomize(hgail_envs.make("point"), Randomization(history=2))
    named = [number.title for number in describe("point", history=2).features.numbers]
    assert named == [number.title for number in env.features_layout.numbers]
    assert len(named) == env.feature_size
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for action in ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6]):
        state = step(state, np.float32(action))
    seen = dict(zip(named, np.asarray(state.info["features"]), strict=True))
    assert [seen[f"displacement {axis}, 1 step earlier"] for axis in "xyz"] == pytest.approx([0.4, 0.5, 0.6])
    assert [seen[f"displacement {axis}, 2 steps earlier"] for axis in "xyz"] == pytest.approx([0.1, 0.2, 0.3])
    assert seen["position x, 1 step earlier"] == pytest.approx(0.003)
    assert seen["position x, 2 steps earlier"] == 0.0
    assert seen["position x"] == pytest.approx(0.03 * 0.5)


def test_the_command_of_the_hand_opens_it_where_the_table_says_so():
    for task in ("grasp", "push"):
        env = hgail_envs.make(task, impl="c", substeps=4)
        state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
        for _ in range(3):
            state = step(state, jnp.array([0.0, 0.0, 1.0, 1.0]))
        blocked = "no effect" in describe(task).action.numbers[3].name
        assert blocked == (float(env.gap(state.pipeline_state)) == 0.0)


def test_the_numbers_of_a_task_that_is_not_imported_are_counted():
    described = describe("elsewhere:Task", sizes=(2, 1, 1))
    numbers = [number.name for layout in described for number in layout.numbers]
    assert numbers == ["feature 0", "feature 1", "goal 0", "action 0"]
    assert describe("hgail_envs.point:Point").goal.numbers[2].name == "target position z"
