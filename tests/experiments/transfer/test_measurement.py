from experiments.localisation.localiser import TargetNotSeenError
from experiments.transfer.conditions import Conditions
from experiments.transfer.measurement import load_policies, measure
from experiments.transfer.robots import make_robot


def test_a_target_that_is_never_seen_has_no_distance():
    def blind(position, rng):
        raise TargetNotSeenError

    robot, finished = make_robot("gymnasium", "reach"), []
    measured = measure(robot, load_policies("reach"), 2, 0, Conditions(blind), lambda: finished.append(1))
    assert (measured["success_rate"], measured["not_seen"], measured["distance_l1"]) == (0.0, 1.0, None)
    assert len(finished) == 2


def test_the_repository_has_policies_of_each_task():
    assert len(load_policies("reach")) == 1
    assert len(load_policies("grasp")) == 8
