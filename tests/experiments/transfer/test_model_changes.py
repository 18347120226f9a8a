"""A robot's model in an episode, against the numbers of the model itself."""

import types

import mujoco
import numpy as np

from experiments.transfer.model_changes import changed

XML = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <body name="arm" gravcomp="1" pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="3"/></body>
  <body name="cube" pos="1 0 1"><freejoint/><geom name="cube" type="box" size=".1 .1 .1" mass="2"/></body>
  </worldbody></mujoco>"""


def fields(model):
    return {name: getattr(model, name).copy() for name in dir(model) if isinstance(getattr(model, name), np.ndarray)}


def test_it_changes_what_it_says_and_undoes_it():
    model = mujoco.MjModel.from_xml_string(XML)
    robot, before = types.SimpleNamespace(model=model, cube="cube"), fields(model)
    with changed(robot, friction=0.5, object_mass=3.0, gravity=0.2):
        np.testing.assert_allclose(model.geom_friction, 0.5 * before["geom_friction"])
        np.testing.assert_allclose(model.body("cube").mass, 6.0)
        np.testing.assert_allclose(model.body("cube").inertia, 3.0 * before["body_inertia"][2])
        np.testing.assert_allclose(model.body("cube").invweight0, before["body_invweight0"][2] / 3.0)
        assert model.body("arm").mass == 3.0
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc[0], -0.2 * 9.81)  # the arm falls with what is left of its weight
    for name, values in fields(model).items():
        np.testing.assert_allclose(values, before[name], err_msg=name)


def test_nothing_is_changed_by_default():
    with changed(None, friction=1.0, object_mass=1.0, gravity=0.0):  # it asks for no model
        pass
