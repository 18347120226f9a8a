"""Policies trained in MJX, unchanged, in Gymnasium-Robotics; what they are shown there; and the registry of robots."""

import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from experiments.parity import joint_indices
from experiments.transfer.conditions import TASKS, Conditions
from experiments.transfer.episode import run_episode, run_episodes
from experiments.transfer.robots import ROBOTS, GymnasiumFetch, make_robot
from hgail_envs.scenes import assets_directory
from hgail_envs.tasks.base import CONTROL_PERIOD
from hgail_envs.tasks.grasp import Grasp
from hgail_jax.io.policy import load_policy


@pytest.fixture(scope="module")
def reach():
    return GymnasiumFetch("reach")


@pytest.fixture(scope="module")
def grasp():
    return GymnasiumFetch("grasp")


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_features(task, request):
    """Position and velocity against MuJoCo's own, the gap against the joints."""
    robot = request.getfixturevalue(task)
    robot.reset(np.random.default_rng(0))
    for _ in range(3):
        robot.step(np.array([0.5, -0.7, 0.2, 1.0]))
    features, velocity = robot.features(), np.zeros(6)
    site = robot.model.site("robot0:grip").id
    mujoco.mj_objectVelocity(robot.model, robot.data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    np.testing.assert_allclose(features[:3], robot.data.site_xpos[site])
    np.testing.assert_allclose(features[3:6], CONTROL_PERIOD * velocity[3:], rtol=0.1, atol=1e-4)  # a step apart
    if task == "grasp":
        assert features[6] == pytest.approx(0.1, abs=5e-3)
        assert features[7] == 0.0
        np.testing.assert_allclose(robot.target(), robot.data.body("object0").xpos, atol=1e-6)


def test_a_step_may_be_longer_than_the_environment_s(reach):
    moved = []
    for length in (1.0, 1.5):
        reach.reset(np.random.default_rng(0))
        before = reach.features()[0]
        reach.step(np.array([-length, 0.0, 0.0, 0.0]))
        moved.append(before - reach.features()[0])
    assert moved[1] / moved[0] == pytest.approx(1.5, rel=0.05)


def test_a_trained_policy_reaches(reach, shipped_policy):
    outcomes = run_episodes(reach, [load_policy(shipped_policy)], range(30))
    assert np.mean([outcome.success for outcome in outcomes]) >= 0.98


@pytest.mark.slow
@pytest.mark.parametrize(("task", "plain"), [("reach", 1.0), ("grasp", 0.5)])
def test_robust_policies_withstand_a_delay_that_plain_ones_of_grasp_do_not(task, plain):
    robot = GymnasiumFetch(task)
    for name, least, most in ((task, 0.0, plain), (f"{task}-robust", 0.9, 1.0)):
        policy = load_policy(assets_directory() / "policies" / f"{name}.npz")
        outcomes = run_episodes(robot, [policy], range(30), conditions=Conditions(delay=2))
        assert least <= np.mean([outcome.success for outcome in outcomes]) <= most


@pytest.mark.slow
def test_a_trained_policy_grasps(grasp, grasp_policy):
    outcomes = run_episodes(grasp, [load_policy(grasp_policy)], range(40))
    assert np.mean([outcome.success for outcome in outcomes]) >= 0.93


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [("push", 0.9), ("pick-and-place", 0.9), ("pick-and-place-robust", 0.85), ("slide", 0.5)]
)
def test_trained_policies_move_the_object_to_its_goal(name, least):
    robot = GymnasiumFetch(name.removesuffix("-robust"))
    policy = load_policy(assets_directory() / "policies" / f"{name}.npz")
    outcomes = run_episodes(robot, [policy], range(40))
    assert np.mean([outcome.success for outcome in outcomes]) >= least


def test_what_holds_and_lifts_is_judged_by_the_engine(grasp):
    """From above every cube is held; a closed hand holds none."""
    grasps = {"from above": Grasp.controllers["from-above"], "closed": Grasp.controllers["closed"]}
    for name, controller in grasps.items():
        grasp.reset(np.random.default_rng(5))
        low = grasp.target()[2]
        outcome = run_episode(
            grasp, lambda seen, act=controller: np.asarray(act(jnp.asarray(seen))), np.random.default_rng(0)
        )
        assert outcome.success == outcome.achieved == float(name == "from above")
        assert (grasp.target()[2] - low > 0.2) == bool(outcome.success)


@pytest.mark.parametrize("observation", ["compact", "official"])
@pytest.mark.parametrize("task", ["push", "pick-and-place", "slide"])
def test_features_of_tasks_with_an_object_are_ours_of_the_same_state(task, observation):
    robot = GymnasiumFetch(task, observation=observation)
    env = hgail_envs.make(task, impl="c", observation=observation)
    robot.reset(np.random.default_rng(1))
    for action in np.random.default_rng(0).uniform(-1, 1, (6, 4)):
        robot.step(action)
    mujoco.mj_forward(robot.model, robot.data)
    qpos, qvel = joint_indices(env.model, robot.model)
    ours = np.asarray(env.features(env.place(robot.data.qpos[qpos], robot.data.qvel[qvel])))
    np.testing.assert_allclose(robot.features(), ours, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "least"), [("push", 0.9), ("pick-and-place", 0.9), ("slide", 0.3)])
def test_controllers_written_for_ours_succeed_there(task, least):
    policy = jax.jit(next(iter(hgail_envs.find_class(task).controllers.values())))
    outcomes = run_episodes(GymnasiumFetch(task), [lambda seen: np.asarray(policy(seen))], range(30))
    success = np.mean([outcome.success for outcome in outcomes])
    print(f"{task}: {success:.2f}")
    assert success >= least
    for outcome in outcomes:
        assert outcome.success == (outcome.distance_l2 < 0.05)


def test_gravity_changes_nothing_as_no_body_is_compensated(reach):
    assert "gravity" in reach.unaffected_by
    assert not reach.model.body_gravcomp.any()


class NeedsMore:
    extra, tasks = "compare", ("reach",)

    def __init__(self, task):
        import no_such_module  # noqa: F401


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(ROBOTS, "new", NeedsMore)
    with pytest.raises(ValueError, match=r"new needs the package no_such_module; pip install -e .*compare"):
        make_robot("new", "reach")


def test_a_task_that_a_robot_cannot_do_is_refused():
    with pytest.raises(ValueError, match="ur5e cannot do 'push'; it does reach, grasp"):
        make_robot("ur5e", "push")


def test_a_robot_is_listed_without_its_extra(monkeypatch):
    """Only making it needs the extra, and says which; of the arms the package's own robots do."""
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(ValueError, match=r"gymnasium needs the package gymnasium_robotics; pip install -e .*compare"):
        make_robot.__wrapped__("gymnasium", "reach")


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_the_first_variant_is_the_default(robot):
    for task in TASKS:
        assert not ROBOTS[robot].variants(task)[0]
