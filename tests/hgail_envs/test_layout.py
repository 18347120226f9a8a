"""Layouts, and tasks that declare them, against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.layout import Layout, Quantity, flag, past, position
from hgail_envs.point import Point
from hgail_envs.quantities import describe

FEATURES = Layout(flag("held"), position("hand"), Quantity("gap", 1, "m"), Quantity("joint angle", 7, "rad"))
GOAL = Layout(flag("hold"), position("target"), flag("leave"))


class Flagged(Point):
    """A point whose goals have flags around the position."""

    goal_layout = GOAL
    success_threshold = 0.5

    def achieved_goal(self, physics):
        return jnp.concatenate([jnp.zeros(1), physics, jnp.ones(1)])

    def sample_goal(self, rng, physics):
        return jnp.array([1.0, 0.3, 0.0, 0.4, 1.0])


def test_quantities_are_read_and_joined_by_name():
    vector = np.arange(24.0).reshape(2, 12)
    parts = FEATURES.split(vector)
    assert FEATURES.size == 12
    np.testing.assert_array_equal(parts["held"], [0, 12])
    np.testing.assert_array_equal(parts["hand"], [[1, 2, 3], [13, 14, 15]])
    np.testing.assert_array_equal(vector[:, FEATURES["gap"]], [4, 16])
    np.testing.assert_array_equal(vector[0, FEATURES.span("hand", "gap")], [1, 2, 3, 4])
    np.testing.assert_array_equal(vector[0, FEATURES.span("gap", "joint angle")], np.arange(4, 12))
    row = FEATURES.split(vector[1])
    for xp in (np, jnp):
        np.testing.assert_array_equal(FEATURES.join(dict(reversed(row.items())), xp), vector[1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"held": None}, "'held' is in the layout but not given"),
        ({"speed": 1.0}, "'speed' is given but not in the layout"),
        ({"hand": np.zeros(2)}, "'hand' has 2 numbers; its layout says 3"),
    ],
)
def test_values_that_do_not_fit_are_refused(changes, message):
    values = {"held": 1.0, "hand": np.zeros(3), "gap": 0.1, "joint angle": np.zeros(7)} | changes
    with pytest.raises(ValueError, match=message):
        FEATURES.join({name: value for name, value in values.items() if value is not None})


def test_numbers_have_names_of_their_own():
    names = [number.name for number in FEATURES.numbers]
    assert names[:6] == ["held", "hand x", "hand y", "hand z", "gap", "joint angle 0"]
    assert len(set(names)) == len(names) == 12
    with pytest.raises(ValueError, match="a layout has 'hand' twice"):
        FEATURES + Layout(position("hand"))


def test_flags_are_equal_and_distances_are_of_metres():
    goal = jnp.array([1.0, 0.3, 0.0, 0.4, 1.0])
    np.testing.assert_allclose(GOAL.metres(goal), goal[1:4])
    np.testing.assert_array_equal(GOAL.metres(goal[1:4]), goal[1:4])
    lid = Layout(Quantity("angle of the lid", 1, "rad"), flag("locked"))
    np.testing.assert_array_equal(lid.metres(goal[1:3]), goal[1:2])  # a flag is no distance there either
    np.testing.assert_array_equal(Layout(flag("locked")).metres(goal[:1]), goal[:1])
    others = goal + jnp.array([[0, 0.05, 0, 0.05, 0], [0, 0.2, 0, 0, 0], [-1, 0, 0, 0, 0], [0, 0, 0, 0, -1]])
    np.testing.assert_array_equal(GOAL.is_near(goal, others, 0.1), [True, False, False, False])


def test_sizes_follow_from_layouts_and_layouts_from_sizes():
    class Sized(Flagged):
        feature_size = 2

    assert (Flagged.goal_size, Flagged().observation_size, Sized.feature_size, Sized.goal_size) == (5, 8, 2, 5)
    assert [number.name for number in Sized.features_layout.numbers] == ["feature 0", "feature 1"]
    with pytest.raises(ValueError, match=r"Torn\.goal_size is 3; its goal_layout has 5 numbers"):

        class Torn(Point):
            goal_size, goal_layout = 3, GOAL


def test_a_user_s_task_names_its_numbers():
    hgail_envs.check_task(Flagged())
    described = describe(f"{__name__}:Flagged")
    assert [number.name for number in described.goal.numbers] == ["hold", "target x", "target y", "target z", "leave"]


def test_flags_are_equal_at_the_goal_and_no_distance():
    env, rng = Flagged(), np.random.default_rng(0)
    flags = rng.integers(2, size=(2, 400, 2))
    positions = rng.uniform(-0.4, 0.4, (2, 400, 3))
    achieved, desired = np.float32(np.concatenate([flags[..., :1], positions, flags[..., 1:]], axis=-1))
    near = np.linalg.norm(positions[0] - positions[1], axis=1) <= 0.5
    expected = near & (flags[0] == flags[1]).all(axis=1)
    np.testing.assert_array_equal(env.success(achieved, desired), expected)
    assert 10 < expected.sum() < near.sum() < 390
    state = env.reset(jax.random.key(0))
    outcome = env.outcome(state, state)
    np.testing.assert_allclose((outcome.distance_l1, outcome.distance_l2), (0.7, 0.5), rtol=1e-5)
    assert (outcome.success, outcome.success_l1) == (0.0, 0.0)


def test_the_past_is_actions_on_their_way_then_actions_and_observations_before():
    features, action = Layout(position("hand position")), Layout(flag("grip"))
    shown = past(features, action, history=1, known_delay=2)
    assert [(quantity.name, quantity.size, quantity.when) for quantity in shown] == [
        ("whether there is an action", 1, "sent 1 step ago and on its way"),
        ("grip", 1, "sent 1 step ago and on its way"),
        ("whether there is an action", 1, "sent 2 steps ago and on its way"),
        ("grip", 1, "sent 2 steps ago and on its way"),
        ("grip", 1, "1 step earlier"),
        ("hand position", 3, "1 step earlier"),
    ]
