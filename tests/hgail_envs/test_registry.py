import numpy as np
import pytest

import hgail_envs
from hgail_envs.engines import ENGINES
from hgail_envs.scenes import load_scene


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("poke", {}, "choose from point, reach"),
        (":", {}, "unknown task ':'; choose from point, reach"),
        ("hgail_envs.point:", {}, "unknown task 'hgail_envs.point:'; choose from"),
        (None, {}, "task is None; it must be a name, one of point, reach"),
        ("no.such.module:Task", {}, "cannot load task"),
        ("hgail_envs.fetch.arm:CONTROL_PERIOD", {}, "not a GoalEnv"),
        ("hgail_envs.fetch.arm:Lift", {}, "cannot load task"),
        ("point", {"substeps": 4}, "no option 'substeps'; it takes none"),
        ("reach", {"steps": 4}, "no option 'steps'; it takes impl, substeps, worlds"),
        ("reach", {"substeps": 3}, "from 4 to 20"),
        ("reach", {"substeps": 21}, "from 4 to 20"),
        ("reach", {"substeps": "4"}, "substeps is '4'; it must be an integer from 4 to 20"),
        ("reach", {"worlds": 0}, "worlds is 0; it must be an integer of at least 1"),
        ("reach", {"substeps": 4.5}, "substeps is 4.5; it must be an integer from 4 to 20"),
        ("reach", {"impl": "warp"}, "needs warp-lang and an NVIDIA GPU"),
        ("reach", {"impl": "cuda"}, f"choose from auto, {', '.join(ENGINES)}"),
    ],
)
def test_bad_tasks_are_refused(task, options, message):
    with pytest.raises(ValueError, match=message):
        hgail_envs.make(task, **options)


def test_a_task_of_one_s_own_is_found_by_its_path():
    assert hgail_envs.make("hgail_envs.point:Point").episode_length == 50


def test_every_task_that_is_listed_can_be_made_and_says_its_sizes():
    sizes = {task: (env.observation_size, env.goal_size, env.action_size) for task, env in made().items()}
    assert sizes == {
        "point": (6, 3, 3),
        "reach": (9, 3, 4),
        "grasp": (12, 4, 4),
        "grasp-position": (11, 3, 4),
        "grasp-aperture": (12, 4, 4),
        "push": (19, 4, 4),
        "pick-and-place": (21, 4, 4),
        "slide": (19, 4, 4),
    }


def made():
    return {task: hgail_envs.make(task) for task in hgail_envs.TASKS}


@pytest.mark.parametrize("scene", ["fetch/reach", "fetch/grasp"])
def test_pictures_change_no_dynamics(scene):
    physics, pictures = load_scene(scene), load_scene(scene, visual=True)
    assert pictures.ngeom > physics.ngeom
    np.testing.assert_array_equal(physics.body_mass, pictures.body_mass)
    np.testing.assert_array_equal(physics.body_inertia, pictures.body_inertia)
    assert physics.npair == pictures.npair
