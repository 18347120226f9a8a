import pytest

from experiments.transfer.policies import find_policies, load_policies


def test_the_repository_has_policies_of_each_task():
    assert len(load_policies("reach")) == 1
    assert len(load_policies("grasp")) == 8
    plain = find_policies(("reach", "grasp", "pick-and-place"))["plain"]
    assert {task: len(paths) for task, paths in plain.items()} == {"reach": 1, "grasp": 8, "pick-and-place": 1}


def test_a_task_without_a_policy_is_refused():
    with pytest.raises(ValueError, match="no policy of 'point' comes with the repository"):
        load_policies("point")
