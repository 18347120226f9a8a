"""This package's Fetch: many episodes at once against roll-outs alone, and its scene against FetchPickAndPlace-v4."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

import hgail_envs
from experiments.transfer.episode import run_episode
from experiments.transfer.parallel_fetch import ParallelFetch
from experiments.transfer.robots import GymnasiumFetch
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_jax.io.policy import load_policy
from hgail_jax.play.recording import run_controller
from hgail_jax.policy import MeanPolicy
from hgail_jax.rollout import rollout


def test_points_are_measured_as_each_alone_and_policies_take_turns(shipped_policy):
    """One program for all points, against programs with the sizes built in; the second policy stands still."""
    policy = load_policy(shipped_policy)
    still = dataclasses.replace(
        policy, layers=tuple((np.zeros_like(weights), np.zeros_like(biases)) for weights, biases in policy.layers)
    )
    fetch = ParallelFetch("reach", [policy, still], episodes=6, seed=3)
    plain = fetch.outcomes()
    assert list(np.asarray(plain.success)[::2]) == [1.0, 1.0, 1.0]
    assert np.asarray(plain.distance_l1)[1::2].min() > 0.02
    randomised = fetch.outcomes(delay=(3, 3), goal_offset=0.05)
    assert np.asarray(randomised.distance_l1)[::2].mean() > 2 * np.asarray(plain.distance_l1)[::2].mean()
    np.testing.assert_array_equal(fetch.outcomes().distance_l1, plain.distance_l1)

    # the same sizes, drawn by a task that has no others; what may differ in length is as long as the program's
    sizes = Randomization(goal_offset=0.05, robot_noise=1e-9, hand_opening=1e-9, friction=(1.0, 1.0 + 1e-9))
    env = RandomizedEnv(hgail_envs.make("reach", impl="c"), sizes)

    def act(seen, rng):
        return policy(seen, jax.numpy), jax.numpy.zeros(len(seen))

    alone = jax.jit(lambda rng: rollout(env, act, rng, 6, lift_test=True).outcome)(jax.random.key(3))
    point = fetch.outcomes(goal_offset=0.05)
    np.testing.assert_allclose(np.asarray(alone.distance_l1)[::2], np.asarray(point.distance_l1)[::2], atol=2e-3)


@pytest.mark.slow
def test_a_grasp_is_a_success_by_its_lift_test(grasp_policy):
    plain = ParallelFetch("grasp", [load_policy(grasp_policy)], episodes=4, seed=0).outcomes()
    assert plain.success.mean() >= 0.75  # a cube that is not lifted is none


def linear(task, weights, **more):
    """Returns a policy whose action is a linear function of the observation."""
    size = len(weights)
    layers = ((np.asarray(weights, np.float32), np.zeros(4, np.float32)),)
    return MeanPolicy(task, 4, np.zeros(size, np.float32), np.ones(size, np.float32), layers, **more)


@pytest.mark.slow
def test_a_tracked_cube_is_seen_with_the_goal_s_error():
    """The hand moves by what the cube in the features is away from the goal, which no error must part."""
    weights = np.zeros((15, 4))
    weights[[8, 9, 10, 0, 1, 2, 11, 12, 13], [0, 1, 2] * 3] = np.repeat([20.0, 20.0, -20.0], 3)
    fetch = ParallelFetch("grasp", [linear("grasp", weights, task_options={"cube": "tracked"})], episodes=3, seed=0)
    still = fetch.outcomes()
    assert still.distance_l2.min() > 0.1
    for sizes in ({"goal_offset": 0.05}, {"goal_noise": 0.05}):
        np.testing.assert_allclose(fetch.outcomes(**sizes).distance_l2, still.distance_l2, atol=2e-3)


@pytest.mark.slow
def test_a_policy_that_knows_its_delay_is_given_it():
    """The hand moves if an action is on its way, which the first number says."""
    weights = np.zeros((5 + 12, 4))
    weights[0, 0] = 1.0
    policy = linear("grasp", weights, randomization=Randomization(known_delay=1))
    fetch = ParallelFetch("grasp", [policy], episodes=3, seed=0)
    still, moved = fetch.outcomes(), fetch.outcomes(delay=(1, 1))
    assert np.abs(moved.distance_l1 - still.distance_l1).min() > 0.05


@pytest.mark.slow
def test_a_posture_moves_the_start():
    """By as much as it says and no further: a hand that stands still is then elsewhere, beside the same cube."""
    fetch = ParallelFetch("grasp", [linear("grasp", np.zeros((12, 4)))], episodes=8, seed=0)
    nominal, moved = fetch.outcomes(), fetch.outcomes(posture=0.04)
    apart = np.abs(moved.distance_l1 - nominal.distance_l1)
    assert apart.mean() > 0.005
    assert apart.max() < 3 * 0.04 + 5e-3
    np.testing.assert_array_equal(fetch.outcomes().distance_l1, nominal.distance_l1)


def test_a_size_that_the_program_is_not_made_for_is_refused(shipped_policy):
    fetch = ParallelFetch("reach", [load_policy(shipped_policy)], episodes=1, seed=0)
    for name in ("history", "known_delay", "ramp"):
        with pytest.raises(ValueError, match=f"a point cannot have '{name}'; it may have delay, step_size"):
            fetch.outcomes(**{name: 1})


EPISODES = 12


@pytest.fixture(scope="module")
def robot():
    return GymnasiumFetch("grasp")


def in_reference(robot, controller, cube):
    """Returns whether a controller lifts, in the reference, the cube that starts at `cube`."""
    robot.reset(np.random.default_rng(0))
    robot.data.joint("object0:joint").qpos[:3] = cube
    mujoco.mj_forward(robot.model, robot.data)
    return run_episode(robot, lambda seen: np.asarray(controller(seen)), np.random.default_rng(0)).success


# A straight line knocks some of the cubes away, and which ones hangs on details of the collision.
@pytest.mark.parametrize(
    ("name", "least_agreement"),
    [("from-above", 1.0), ("closed", 1.0), ("straight", 0.9)],
)
@pytest.mark.slow
def test_a_controller_lifts_the_cubes_that_it_lifts_in_the_reference(robot, name, least_agreement):
    env = hgail_envs.make("grasp")
    episodes = run_controller(env, name, EPISODES, seed=0)
    starts = np.asarray(episodes.desired[0, :, :3])  # where the cube lies
    controller = jax.jit(env.controllers[name])
    theirs = np.array([in_reference(robot, controller, cube) for cube in starts])
    assert np.mean(theirs == np.asarray(episodes.outcome.success)) >= least_agreement
