import dataclasses
import hashlib
import json
import shutil
import types
from pathlib import Path

import mujoco
import numpy as np
import pytest

from experiments.paths import RESULTS
from experiments.transfer.conditions import Conditions
from experiments.transfer.measurement import measure
from experiments.transfer.model_changes import changed
from experiments.transfer.policies import SCRIPT, Script, find_policies, load_policies, policy_paths
from experiments.transfer.robots import make_robot
from hgail_envs.randomization import LEVELS
from hgail_envs.scenes import assets_directory
from hgail_jax import load_policy, save_policy


def test_the_repository_has_policies_of_each_task():
    assert len(load_policies("reach")) == 1
    assert len(load_policies("grasp")) == 8
    found = find_policies(("reach", "grasp", "pick-and-place"))
    assert {task: len(paths) for task, paths in found["plain"].items()} == {"reach": 1, "grasp": 8, "pick-and-place": 1}
    for label, level in {"other arms": "other-arms", "known delay": "full-known-delay"}.items():
        (grasp,), (picking,) = found[label]["grasp"], found[label]["pick-and-place"]
        assert (load_policy(grasp).task_options, load_policy(picking).task_options) == ({"cube": "tracked"}, {})
        for path in (grasp, picking):  # a ramp is of the training alone
            sizes = load_policy(path).randomization
            assert dataclasses.replace(sizes, ramp=LEVELS[level].ramp) == LEVELS[level]


def test_policies_that_are_shipped_are_those_that_were_published():
    published = {row["file"]: row["sha256"] for row in json.loads((RESULTS / "policies.json").read_text())}
    found = {
        path.name: path for path in (*(assets_directory() / "policies").glob("*"), *(RESULTS / "policies").glob("*"))
    }
    assert {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()} == published


def test_a_run_s_folder_stands_for_its_policies(tmp_path):
    (tmp_path / "policies").mkdir()
    file = shutil.copy(policy_paths("grasp", "other arms")[0], tmp_path / "policies" / "seed-1.npz")
    (policy,) = load_policies("grasp", tmp_path)
    assert policy.randomization == LEVELS["other-arms"]
    assert find_policies([], [f"mine={tmp_path}"]) == {"mine": {"grasp": [file]}}


def test_the_script_is_one_beside_a_folder_of_its_name(tmp_path, monkeypatch):
    (tmp_path / SCRIPT).mkdir()
    monkeypatch.chdir(tmp_path)
    (script,) = load_policies("grasp", Path(SCRIPT))
    assert isinstance(script, Script)


def test_a_task_without_a_policy_is_refused():
    with pytest.raises(ValueError, match="no policy of 'point' comes with the repository"):
        load_policies("point")


@pytest.mark.parametrize("options", [{"cube": "tracked"}, {"achieved": "passed"}])
def test_a_sweep_takes_a_policy_whose_robot_needs_to_know_no_option(options, grasp_policy, tmp_path):
    save_policy(tmp_path / "p.npz", dataclasses.replace(load_policy(grasp_policy), task_options=options))
    assert find_policies([], [f"other={tmp_path / 'p.npz'}"]) == {"other": {"grasp": [tmp_path / "p.npz"]}}


def test_a_sweep_refuses_a_policy_of_other_task_options(shipped_policy, tmp_path):
    save_policy(tmp_path / "p.npz", dataclasses.replace(load_policy(shipped_policy), task_options={"size": 3}))
    with pytest.raises(ValueError, match="trained with task options size=3; curves are of tasks as they are alone"):
        find_policies(["reach"], [f"other={tmp_path / 'p.npz'}"])


@pytest.mark.parametrize("task", ["grasp", "pick-and-place"])
def test_a_script_does_the_task_as_a_policy(task):
    outcomes = measure(make_robot("gymnasium", task), load_policies(task, Path(SCRIPT)), range(4), 0, Conditions())
    assert outcomes.success.tolist() == [1.0] * 4


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
