import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.tasks.controllers import push
from hgail_envs.tasks.grasp import Grasp
from hgail_envs.tasks.reach import Reach
from hgail_jax.play.recording import run_controller

grasp, straight, closed = Grasp.controllers.values()
(reach,) = Reach.controllers.values()
CUBE = np.array([1.3, 0.7, 0.425])


def seen(x, y, z):
    """An observation of grasp with the gripper at this offset from the cube, which is the goal."""
    return jnp.array([*np.add(CUBE, [x, y, z]), 0, 0, 0, 0.1, 0, *CUBE, 1.0], jnp.float32)


def test_grasp_lags_behind_in_height_and_closes_when_near():
    np.testing.assert_allclose(grasp(seen(-0.02, 0.01, 0.1)), [0.4, -0.2, -0.4, 1.0], rtol=1e-3)
    np.testing.assert_allclose(grasp(seen(0.5, 0.0, 0.5)), [-1.0, 0.0, -1.0, 1.0], atol=1e-4)
    assert grasp(seen(0.0, 0.014, 0.0))[3] == -1.0
    assert grasp(seen(0.0, 0.016, 0.0))[3] == 1.0


def test_lines_are_straight_and_at_full_speed_until_one_stride_away():
    far, near = seen(-0.2, 0.1, -0.05), seen(-0.0165, 0.0, 0.0)
    np.testing.assert_allclose(straight(far), [1.0, -0.5, 0.25, 1.0], rtol=1e-3)
    np.testing.assert_allclose(straight(near), [0.5, 0.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(closed(far), [1.0, -0.5, 0.25, -1.0], rtol=1e-3)


@pytest.mark.parametrize(
    ("height", "falling", "pushes"), [(0.425, 0.01, True), (0.44, 0.002, False), (0.44, 0.0, True), (0.46, 0.0, False)]
)
def test_push_begins_where_the_hand_is_low_or_comes_no_lower(height, falling, pushes):
    hand = jnp.array([1.24, 0.7, height])
    state = {
        "gripper position": hand,
        "gripper velocity": jnp.array([0.0, 0.0, -falling]),
        "cube position": jnp.array(CUBE),
        "cube position less gripper position": CUBE - hand,
        "target position": jnp.array([1.4, 0.7, 0.425]),
    }
    assert float(push(state)[0]) == pytest.approx(0.6 if pushes else 0.0)


def test_controllers_take_batches():
    batch = jnp.stack([seen(0.0, 0.0, 0.0), seen(0.1, 0.1, 0.1)])
    for controller in hgail_envs.find_class("grasp").controllers.values():
        np.testing.assert_array_equal(controller(batch), jnp.stack([controller(row) for row in batch]))
    assert reach(jnp.zeros((2, 5, 9))).shape == (2, 5, 4)


@pytest.mark.parametrize(
    ("task", "name", "least", "most"),
    [
        ("point", "proportional", 1.0, 1.0),
        ("reach", "proportional", 1.0, 1.0),
        ("grasp", "straight", 0.5, 0.9),  # Gymnasium-Robotics: 0.69 to 0.74
        # as an arm does, in test_servo_arm
        pytest.param("push", "from-behind", 0.95, 1.0, marks=pytest.mark.slow),
        ("pick-and-place", "from-above", 0.95, 1.0),
        ("slide", "from-above", 0.15, 0.45),  # Gymnasium-Robotics: 0.29 of 128
    ],
)
def test_controllers_do_in_the_scene_what_they_do_in_the_reference(task, name, least, most):
    success = float(run_controller(hgail_envs.make(task), name, 32, seed=0).outcome.success.mean())
    assert least <= success <= most


def test_the_first_controller_is_the_one_that_demonstrates():
    first = {task: next(iter(hgail_envs.find_class(task).controllers)) for task in ("point", "reach", "grasp")}
    assert first == {"point": "proportional", "reach": "proportional", "grasp": "from-above"}


def test_an_unknown_controller_is_refused():
    with pytest.raises(ValueError, match="controller is 'magic'; choose from proportional"):
        run_controller(hgail_envs.make("point"), "magic", 1, seed=0)
