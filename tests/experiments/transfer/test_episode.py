"""The episode runner, on a robot simple enough to be worked out by hand."""

import numpy as np
import pytest

import hgail_envs
from experiments.transfer.conditions import Conditions, NoisyEstimate
from experiments.transfer.episode import run_episode, run_episodes
from hgail_envs.randomization import Randomization
from hgail_envs.tasks.grasp import LEAST_RISE


class Dot:
    """Moves by 0.03 m for a unit action; notes its commands. A cube that it holds rises with it."""

    offset = np.zeros(3)

    def __init__(self, task="reach", holds=True):
        self.task, self.holds, self.commands = task, holds, []
        self.position, self.goal = np.zeros(3), np.array([0.1, -0.05, 0.0])

    def reset(self, rng):
        self.position, self.goal = np.zeros(3), rng.uniform(-0.1, 0.1, 3)

    def features(self):
        hand = [] if self.task == "reach" else [0.05, float(self.holds)]
        return np.concatenate([self.position, np.zeros(3), hand])

    def target(self):
        return self.goal

    def carried(self):
        return self.position

    def reached(self):
        return np.linalg.norm(self.position - self.goal) <= 0.05

    def step(self, action):
        self.commands.append(np.array(action))
        self.position = self.position + 0.03 * action[:3]
        if self.task == "grasp" and self.holds:
            self.goal = self.goal + np.array([0.0, 0.0, 0.03 * action[2]])


def to_the_goal(observation):
    return np.append(20 * (observation[-3:] - observation[:3]), 0.7)


class Watcher:
    """Stands still, or rises with `up`; notes what it sees and what is there. It was trained with a tracked cube."""

    def __init__(self, cube, history=0, up=0.0, look=lambda: None):
        self.task_options, self.randomization = {"cube": cube}, Randomization(history=history)
        self.seen, self.places, self.up, self.look = [], [], up, look

    def __call__(self, observation):
        self.seen.append(observation)
        self.places.append(self.look())
        return np.array([0.0, 0.0, self.up, 0.5])


def run(robot, policy=to_the_goal, **conditions):
    return run_episode(robot, policy, np.random.default_rng(0), Conditions(**conditions))


def test_an_episode_has_the_task_s_steps_and_is_measured_at_its_end():
    robot = Dot()
    outcome = run(robot)
    assert len(robot.commands) == 50
    assert outcome.success == outcome.success_l1 == 1.0
    assert outcome.distance_l2 == pytest.approx(0.0, abs=1e-6)
    assert np.max(np.abs(robot.commands)) <= 1.0


@pytest.mark.parametrize("offset", [(0.04, 0.0, 0.0), (0.0, -0.06, 0.0)])
def test_it_goes_where_the_target_is_believed_and_is_judged_by_where_it_is(offset):
    robot = Dot()
    outcome = run(robot, estimate=NoisyEstimate(offset=offset))
    np.testing.assert_allclose(robot.position, robot.goal + offset, atol=1e-5)
    assert outcome.distance_l1 == pytest.approx(np.abs(offset).sum(), abs=1e-5)
    assert outcome.success == float(np.linalg.norm(offset) <= 0.05)


@pytest.mark.parametrize(("cube", "looks"), [("at-start", 1), ("tracked", 50)])
def test_the_target_is_looked_at_once_and_a_tracked_cube_at_each_step(cube, looks):
    asked = []

    def begin(rng):
        return lambda position: asked.append(position) or position + rng.normal(size=3)

    run(Dot("grasp"), Watcher(cube), estimate=begin)
    assert len(asked) == looks


def test_noise_has_the_standard_deviation_asked_for():
    estimate, rng = NoisyEstimate(noise=0.02, offset=(0.0, 0.0, 0.1)), np.random.default_rng(0)
    errors = np.stack([estimate(rng)(np.zeros(3)) for _ in range(4000)])
    np.testing.assert_allclose(errors.mean(0), [0.0, 0.0, 0.1], atol=1.5e-3)
    np.testing.assert_allclose(errors.std(0), 0.02, atol=1e-3)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_actions_come_late(delay):
    """The action that answers step t arrives at t + delay; until then nothing moves."""
    robot, decided = Dot(), []

    def count(observation):
        decided.append(len(decided) / 100)
        return np.full(4, decided[-1])

    run(robot, count, delay=delay)
    commands = np.array(robot.commands)[:, 0]
    np.testing.assert_array_equal(commands[:delay], 0.0)
    np.testing.assert_allclose(commands[delay:], decided[: 50 - delay], atol=1e-6)


def test_the_stride_changes_displacements_alone():
    robot = Dot()
    run(robot, lambda observation: np.array([2.0, 0.5, -0.5, 0.7]), stride=1.5)
    np.testing.assert_allclose(robot.commands[0], [1.5, 0.75, -0.75, 0.7])


def test_grasping_takes_a_lift():
    """The goal says to hold; the lift test goes straight up with the hand as it was."""
    robot = Dot("grasp")
    outcome = run(robot, lambda observation: np.array([0.0, 0.0, 0.0, -0.3]) * observation[-1])
    assert outcome.achieved == outcome.success == 1.0
    assert len(robot.commands) == 50 + 12
    np.testing.assert_allclose(robot.commands[-12:], np.tile([0.0, 0.0, 1.0, -0.3], (12, 1)), atol=1e-6)
    assert LEAST_RISE < 12 * 0.03
    assert run(Dot("grasp", holds=False), lambda observation: np.zeros(4)).success == 0.0
    dropped = Dot("grasp")
    dropped.step = lambda action: dropped.commands.append(action)
    outcome = run(dropped, lambda observation: np.zeros(4))
    assert (outcome.achieved, outcome.success) == (1.0, 0.0)


def test_a_cube_that_was_lifted_before_the_test_need_not_rise_in_it():
    """It is as high as the robot reaches: the test moves it no more."""
    robot = Dot("grasp")
    rise = robot.step
    robot.step = lambda action: rise(action) if len(robot.commands) < 10 else robot.commands.append(action)
    outcome = run(robot, lambda observation: np.array([0.0, 0.0, 1.0, 0.0]))
    assert outcome.achieved == outcome.success == 1.0


def observations(policy=lambda observation: np.zeros(4), task="reach", **conditions):
    """Returns what a policy is shown in an episode in which it stands still."""
    seen = []

    def watch(observation):
        seen.append(observation)
        return policy(observation)

    run(Dot(task), watch, **conditions)
    return np.array(seen)


def test_noises_are_drawn_at_each_step_and_offsets_once():
    goal = observations(goal_noise=0.02)[:, 6:] - Dot().goal
    np.testing.assert_allclose(goal.std(), 0.02, rtol=0.25)
    assert np.abs(np.diff(goal, axis=0)).min(axis=1).max() > 1e-3
    offset = observations(robot_offset=0.02)
    np.testing.assert_array_equal(offset, np.tile(offset[0], (50, 1)))
    assert np.abs(offset[0, :3]).max() > 1e-3
    noise = observations(robot_noise=0.02)
    np.testing.assert_allclose(noise[:, :3].std(), 0.02, rtol=0.25)
    np.testing.assert_allclose(np.diff(noise[:, :3], axis=0), noise[1:, 3:6], atol=1e-6)  # as moved as it seems


class Counting:
    """A policy whose actions are 0.01, 0.02 and so on; it keeps what it is shown."""

    def __init__(self, **sizes):
        self.randomization, self.seen = Randomization(**sizes), []

    def __call__(self, observation):
        self.seen.append(observation)
        return np.full(4, len(self.seen) / 100)


def test_a_policy_is_shown_the_history_that_it_was_trained_with():
    """Newest first, each the action before its delay, and what was seen when it was decided."""
    run_episode(Dot(), policy := Counting(history=2), np.random.default_rng(0), Conditions(delay=1))
    shown = np.array(policy.seen)
    assert shown.shape == (50, 2 * (4 + 6) + 6 + 3)
    now, actions = shown[:, 20:26], np.arange(1, 51)[:, None] * np.full(4, 0.01)
    start = np.append(np.zeros(4), now[0])
    np.testing.assert_allclose(shown[0, :20], np.tile(start, 2), atol=1e-6)
    np.testing.assert_allclose(shown[1:, :10], np.hstack([actions[:-1], now[:-1]]), atol=1e-6)
    np.testing.assert_allclose(shown[2:, 10:20], np.hstack([actions[:-2], now[:-2]]), atol=1e-6)
    np.testing.assert_allclose(shown[1, 10:20], start, atol=1e-6)
    assert np.ptp(now[:, 0]) > 0.1


@pytest.mark.parametrize("delay", [0, 2, 3, 5])
def test_a_policy_that_knows_its_delay_is_shown_the_actions_on_their_way(delay):
    """Of a delay that is longer than it knows, as in training, the newest."""
    run_episode(Dot(), policy := Counting(known_delay=3), np.random.default_rng(0), Conditions(delay=delay))
    shown = np.array(policy.seen)
    assert shown.shape == (50, 3 * 5 + 6 + 3)
    sent = [[1.0, *np.full(4, step / 100)] for step in (10, 9, 8)]
    expected = [row if back < delay else np.zeros(5) for back, row in enumerate(sent)]
    np.testing.assert_allclose(shown[10, :15], np.concatenate(expected), atol=1e-6)


def watched(history=0, up=0.0, **conditions):
    """Returns what a policy that tracks the cube is shown, and where gripper and cube were."""
    robot = Dot("grasp")
    policy = Watcher("tracked", history, up, lambda: (robot.position, robot.goal))
    run(robot, policy, **conditions)
    return np.array(policy.seen), *np.array(policy.places).transpose(1, 0, 2)


def test_a_policy_that_tracks_the_cube_is_shown_where_it_is_at_each_step():
    """The cube rises with the hand: features 8 to 10 are it less the gripper, 11 to 13 the goal, 14 holding."""
    seen, gripper, cube = watched(up=0.5)
    assert seen.shape == (50, 15)
    assert np.ptp(cube[:, 2]) > 0.5
    np.testing.assert_allclose(seen[:, :3], gripper, atol=1e-6)
    np.testing.assert_allclose(seen[:, 8:11], cube - gripper, atol=1e-6)
    np.testing.assert_allclose(seen[:, 11:], np.column_stack([cube, np.ones(50)]), atol=1e-6)


@pytest.mark.parametrize(("size", "changes"), [("estimate", False), ("goal_noise", True)])
def test_a_tracked_cube_has_one_error_in_goal_and_features(size, changes):
    """Once per episode or anew at each step."""
    seen, gripper, cube = watched(up=0.5, **{size: NoisyEstimate(noise=0.02) if size == "estimate" else 0.02})
    error = seen[:, 11:14] - cube
    np.testing.assert_allclose(seen[:, 8:11] + gripper - cube, error, atol=1e-6)
    assert 0.005 < np.abs(error).mean() < 0.05
    assert (np.ptp(error, axis=0) > 0.01).all() == changes
    assert changes or np.ptp(error, axis=0).max() < 1e-6


def test_a_gripper_that_is_seen_elsewhere_sees_a_tracked_cube_elsewhere():
    """Only relative to itself: the camera that sees the cube does not see the gripper."""
    seen, gripper, cube = watched(robot_offset=0.02)
    error = seen[:, :3] - gripper
    assert np.abs(error).max() > 5e-3
    np.testing.assert_allclose(seen[:, 8:11], cube - gripper - error, atol=1e-6)
    np.testing.assert_allclose(seen[:, 11:14], cube, atol=1e-6)


def test_the_history_has_where_a_tracked_cube_was():
    seen, _, _ = watched(history=2, up=0.5, goal_noise=0.02)
    assert seen.shape == (50, 2 * (4 + 11) + 11 + 4)
    now = seen[:, 30:41]
    np.testing.assert_array_equal(seen[0, :30], np.tile(np.append(np.zeros(4), now[0]), 2))
    np.testing.assert_array_equal(seen[1:, 4:15], now[:-1])
    np.testing.assert_array_equal(seen[2:, 19:30], now[:-2])


def test_starts_depend_on_seed_and_number_alone():
    robot, policies = Dot(), [to_the_goal, lambda observation: np.zeros(4)]
    both = run_episodes(robot, policies, range(4), seed=3)
    assert [outcome.success for outcome in both][::2] == [1.0, 1.0]
    later = run_episodes(robot, policies, [1, 3], seed=3, conditions=Conditions(NoisyEstimate(noise=0.1)))
    assert [outcome.distance_l1 for outcome in later] == [both[1].distance_l1, both[3].distance_l1]
    other = run_episodes(robot, policies, [1], seed=4)
    assert other[0].distance_l1 != both[1].distance_l1
    assert isinstance(both[0], hgail_envs.EpisodeMetrics)
