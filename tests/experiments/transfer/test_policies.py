import dataclasses

import pytest

from experiments.transfer.policies import find_policies, load_policies, policy_paths
from hgail_envs.scenes import assets_directory
from hgail_jax import load_policy, save_policy


def test_the_repository_has_policies_of_each_task():
    assert len(load_policies("reach")) == 1
    assert len(load_policies("grasp")) == 8
    plain = find_policies(("reach", "grasp", "pick-and-place"))["plain"]
    assert {task: len(paths) for task, paths in plain.items()} == {"reach": 1, "grasp": 8, "pick-and-place": 1}


def test_policies_that_are_shipped_are_those_that_were_measured():
    for path in sorted((assets_directory() / "policies").glob("*.npz")):
        task = path.stem.removesuffix("-robust")
        measured = [run.read_bytes() for run in policy_paths(task, "plain" if task == path.stem else "robust")]
        assert path.read_bytes() in measured, path.name


def test_a_task_without_a_policy_is_refused():
    with pytest.raises(ValueError, match="no policy of 'point' comes with the repository"):
        load_policies("point")


def test_a_sweep_refuses_a_policy_of_other_task_options(shipped_policy, tmp_path):
    save_policy(tmp_path / "p.npz", dataclasses.replace(load_policy(shipped_policy), task_options={"size": 3}))
    with pytest.raises(ValueError, match="trained with task options size=3; curves are of tasks as they are alone"):
        find_policies(["reach"], [f"other={tmp_path / 'p.npz'}"])
