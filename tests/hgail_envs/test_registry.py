import copy
import functools
import pickle

import jax
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.engines import ENGINES
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import randomize
from hgail_envs.robots.fetch import Fetch
from hgail_envs.tasks.push import Push


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("poke", {}, "choose from point, reach"),
        (":", {}, "unknown task ':'; choose from point, reach"),
        ("hgail_envs.point:", {}, "unknown task 'hgail_envs.point:'; choose from"),
        (None, {}, "task is None; it must be a name, one of point, reach"),
        ("no.such.module:Task", {}, "cannot load task"),
        ("hgail_envs.tasks.base:CONTROL_PERIOD", {}, "not a GoalEnv"),
        ("hgail_envs.tasks.base:Lift", {}, "cannot load task"),
        ("point", {"substeps": 4}, "no option 'substeps'; it takes none"),
        ("reach", {"steps": 4}, "no option 'steps'; it takes impl, substeps, worlds"),
        ("reach", {"substeps": 3}, "substeps is 3; it must be at least 4"),
        ("reach", {"substeps": 21}, "substeps is 21; it must be at most 20"),
        ("reach", {"substeps": "4"}, "substeps is '4'; it must be an integer"),
        ("reach", {"worlds": 0}, "worlds is 0; it must be at least 1"),
        ("reach", {"substeps": 4.5}, "substeps is 4.5; it must be an integer"),
        ("reach", {"impl": "warp"}, "needs warp-lang and an NVIDIA GPU"),
        ("reach", {"impl": "cuda"}, f"choose from auto, {', '.join(ENGINES)}"),
    ],
)
def test_bad_tasks_are_refused(task, options, message):
    jax.devices()  # where JAX has not started, an engine that is missing is refused later
    with pytest.raises(ValueError, match=message):
        hgail_envs.make(task, **options)


def test_a_user_s_task_is_found_by_its_path():
    assert hgail_envs.make("hgail_envs.point:Point").episode_length == 50


class Forwarding(Push):
    def __init__(self, shift=0.0, **kwargs):
        super().__init__(**kwargs)
        self.shift = shift


class Closed(Forwarding):
    def __init__(self, substeps=5):
        super().__init__(substeps=substeps, shift=1.0)


def test_options_pass_through_a_constructor_that_hands_them_on():
    forwarding, closed = f"{__name__}:Forwarding", f"{__name__}:Closed"
    assert hgail_envs.accepted_options(forwarding) == ("impl", "substeps", "worlds", "robot", "observation", "shift")
    env = hgail_envs.make(forwarding, substeps=7, observation="official", shift=2.0)
    assert (env.substeps, env.feature_size, env.shift) == (7, 25, 2.0)
    assert hgail_envs.accepted_options(closed) == ("substeps",)
    with pytest.raises(ValueError, match="no option 'worlds'; it takes substeps"):
        hgail_envs.make(closed, worlds=3)
    assert hgail_envs.accepted_options("point") == ()


def test_every_task_that_is_listed_can_be_made_and_says_its_sizes():
    sizes = {task: (env.observation_size, env.goal_size, env.action_size) for task, env in made().items()}
    assert sizes == {
        "point": (6, 3, 3),
        "reach": (9, 3, 4),
        "grasp": (12, 4, 4),
        "push": (19, 4, 4),
        "pick-and-place": (21, 4, 4),
        "slide": (19, 4, 4),
        "stack": (32, 6, 4),
        "tower": (42, 7, 4),
    }


def made():
    return {task: hgail_envs.make(task) for task in hgail_envs.TASKS}


@pytest.mark.parametrize("scene", ["reach", "grasp"])
def test_pictures_change_no_dynamics(scene):
    physics, pictures = Fetch(scene).load(), Fetch(scene).load(visual=True)
    assert pictures.ngeom > physics.ngeom
    np.testing.assert_array_equal(physics.body_mass, pictures.body_mass)
    np.testing.assert_array_equal(physics.body_inertia, pictures.body_inertia)
    assert physics.npair == pictures.npair


@functools.cache
def tasks_on_all_engines():
    """Returns each task, and reach on each engine that there is here, plain and randomised."""
    return list(_tasks_on_all_engines())


def _tasks_on_all_engines():
    jax.devices()  # once JAX has started a task makes its engine at once
    for task in hgail_envs.TASKS:
        for impl in ENGINES if task == "reach" else ("c",) if hgail_envs.accepted_options(task) else (None,):
            try:
                env = hgail_envs.make(task, **({} if impl is None else {"impl": impl, "substeps": 5, "worlds": 7}))
            except ValueError:  # no Warp here
                continue
            yield env
            yield env.reference_physics()
            yield randomize(env, Randomization(delay=(0, 2), robot_noise=0.001, history=2))


def pickled(value):
    return pickle.loads(pickle.dumps(value))


def content(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


@pytest.mark.parametrize("duplicate", [pickled, copy.deepcopy])
def test_every_task_can_be_pickled_and_copied_and_one_on_every_engine(duplicate):
    names = []
    for env in tasks_on_all_engines():
        env.success_threshold = 0.123
        same = duplicate(env)
        assert same is not env and type(same) is type(env)
        for name in ("impl", "substeps", "max_worlds", "success_threshold", "observation_size", "randomization"):
            assert getattr(same, name, None) == getattr(env, name, None)
        assert list(same.controllers) == list(env.controllers)
        one, other = (getattr(getattr(env, "task", env), "engine", None) for env in (env, same))
        if one is not None:
            assert one is not other and one.model is not other.model
            assert content(one.model) == content(other.model)
        names.append(f"{type(env).__name__} {getattr(env, 'impl', None)}")
    assert {"Point None", "Reach c", "Reach jax", "Slide c", "RandomizedEnv c", "RandomizedEnv None"} <= set(names)


def test_a_copy_of_a_task_goes_the_same_way():
    env = hgail_envs.make("reach", impl="c", substeps=5)
    state = env.reset(jax.random.key(0))
    expected = jax.jit(env.step)(state, np.ones(4))
    again = jax.jit(pickled(env).step)(pickled(state), np.ones(4))
    jax.tree.map(np.testing.assert_array_equal, expected, again)
