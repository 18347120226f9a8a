import jax
import mujoco
import numpy as np
import pytest

from envs.kinematics import Chain
from envs.scenes import load_scene

MODEL = load_scene("fetch/grasp")


def by_c_mujoco(qpos, qvel):
    data = mujoco.MjData(MODEL)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_forward(MODEL, data)
    site, velocity = MODEL.site("grip").id, np.zeros(6)
    mujoco.mj_objectVelocity(MODEL, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    body = MODEL.site_bodyid[site]
    return data.site_xpos[site], velocity[3:], data.xpos[body], data.xquat[body]


def test_the_chain_agrees_with_c_mujoco_in_any_configuration():
    rng = np.random.default_rng(0)
    pose = jax.jit(Chain(MODEL, "grip").pose)
    for _ in range(20):
        qpos = MODEL.qpos0 + rng.normal(size=MODEL.nq)
        qpos[-4:] /= np.linalg.norm(qpos[-4:])  # the cube's orientation
        qvel = rng.normal(size=MODEL.nv)
        found = pose(qpos.astype(np.float32), qvel.astype(np.float32))
        for ours, expected in zip(found, by_c_mujoco(qpos, qvel), strict=True):
            np.testing.assert_allclose(ours, expected, atol=2e-5)


def test_a_chain_with_a_free_joint_is_refused():
    xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/><site name='s'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="neither a hinge nor a slide"):
        Chain(mujoco.MjModel.from_xml_string(xml), "s")


def test_joints_off_their_body_s_origin_turn_about_their_anchor():
    xml = """<mujoco><worldbody><body pos="1 2 3" quat=".6 .8 0 0"><joint name="a" axis="0 0 1" pos=".1 .2 .3"/>
      <geom size=".1"/><body pos=".5 0 0"><joint name="b" type="slide" axis="0 1 0"/><geom size=".1"/>
      <site name="grip" pos=".1 .1 .1"/></body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos = [0.7, -0.4]
    mujoco.mj_forward(model, data)
    found = Chain(model, "grip").pose(np.float32(data.qpos), np.zeros(2, np.float32))
    np.testing.assert_allclose(found.site_position, data.site("grip").xpos, atol=1e-6)
    np.testing.assert_allclose(found.body_quaternion, data.xquat[2], atol=1e-6)
