import jax
import mujoco
import numpy as np
import pytest

from hgail_envs.robots.fetch import Fetch
from hgail_envs.robots.kinematics import Chain
from hgail_envs.robots.servo_arm import ServoArm

MODEL = Fetch("grasp").model


def by_c_mujoco(model, qpos, qvel):
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_forward(model, data)
    site, velocity = model.site("grip").id, np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    body = model.site_bodyid[site]
    return data.site_xpos[site], velocity[3:], data.xpos[body], data.xquat[body]


# Whatever the Fetch has not: oblique axes, anchors off the body's origin, references, several joints on a body.
OBLIQUE = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body pos="1 2 3" quat=".6 .8 0 0">
      <joint name="a" axis="1 2 3" pos=".1 .2 .3" ref="20"/><joint name="b" type="slide" axis="3 0 -4" ref=".2"/>
      <joint name="c" axis="0 -1 0"/><geom size=".1"/><body pos=".5 0 -.2" quat=".5 .5 -.5 .5">
      <joint name="d" type="slide" axis="0 1 0"/><joint name="e" axis="2 -1 0" pos="0 0 .4"/><geom size=".1"/>
      <site name="grip" pos=".1 .2 -.3"/></body></body></worldbody></mujoco>"""
)


@pytest.mark.parametrize("model", [MODEL, OBLIQUE], ids=["fetch", "oblique"])
def test_the_chain_agrees_with_c_mujoco_in_any_configuration(model):
    rng = np.random.default_rng(0)
    pose = jax.jit(Chain(model, "grip").pose)
    for _ in range(20):
        qpos = model.qpos0 + rng.normal(size=model.nq)
        if model is MODEL:
            qpos[-4:] /= np.linalg.norm(qpos[-4:])  # the cube's orientation
        qvel = rng.normal(size=model.nv)
        found = pose(qpos.astype(np.float32), qvel.astype(np.float32))
        for ours, expected in zip(found, by_c_mujoco(model, qpos, qvel), strict=True):
            np.testing.assert_allclose(ours, expected, atol=2e-5)


@pytest.mark.parametrize("base", ["world", "arm/panda0_link2"])
def test_the_jacobian_is_that_of_c_mujoco(base):
    """From a base on the way, in its frame, without the joints before it."""
    pytest.importorskip("gymnasium_robotics")
    model, rng = ServoArm("franka", "reach").model, np.random.default_rng(0)
    found = np.zeros((6, model.nv))
    chain, data, skipped = Chain(model, "grip", base), mujoco.MjData(model), 0 if base == "world" else 2
    jacobian, follow = jax.jit(chain.jacobian), jax.jit(chain.follow)
    for _ in range(20):
        data.qpos[:9] = rng.uniform(*model.jnt_range[:9].T)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, found[:3], found[3:], model.site("grip").id)
        frame, origin = data.body(base).xmat.reshape(3, 3), data.body(base).xpos
        expected = np.concatenate([frame.T @ found[:3], frame.T @ found[3:]])[:, skipped:7]
        np.testing.assert_allclose(jacobian(np.float32(data.qpos))[1], expected, atol=2e-5)
        place = frame.T @ (data.site("grip").xpos - origin)
        np.testing.assert_allclose(follow(np.float32(data.qpos))[0], place, atol=2e-5)


def test_a_chain_with_a_free_joint_is_refused():
    xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/><site name='s'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="neither a hinge nor a slide"):
        Chain(mujoco.MjModel.from_xml_string(xml), "s")
