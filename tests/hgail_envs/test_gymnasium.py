"""The tasks behind Gymnasium's identifiers, against its checker, its vectorisation and its wrappers."""

import copy
import pickle

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import hgail_envs
from hgail_envs.registry import GYMNASIUM_IDS
from hgail_envs.single import GoalSingleEnv
from hgail_envs.vector import GoalVectorEnv

POINT, REACH = GYMNASIUM_IDS["point"], GYMNASIUM_IDS["reach"]
LENGTH = 50  # steps of the point's episodes


def test_importing_registers_each_task():
    assert GYMNASIUM_IDS["pick-and-place"] == "hgail_envs/FetchPickAndPlace-v0"
    assert GYMNASIUM_IDS.keys() == hgail_envs.TASKS.keys()
    for task, name in GYMNASIUM_IDS.items():
        assert gymnasium.spec(name).max_episode_steps == hgail_envs.find_class(task).episode_length
        assert gymnasium.spec(name).kwargs == {"task": task}


FORK = """
import gymnasium, hgail_envs, numpy as np
name, impl = {name!r}, {impl!r}
options = {{"impl": impl, "substeps": 4}} if impl else {{}}
vector = gymnasium.make_vec(
    name, num_envs=2, vectorization_mode="async", vector_kwargs={{"context": "fork"}}, **options
)
vector.reset(seed=0)
observation, reward, *_ = vector.step(np.zeros(vector.action_space.shape, np.float32))
print(observation["observation"].shape[0], *reward)
vector.close()
"""


@pytest.mark.parametrize(
    ("name", "impl"), [(POINT, None), (REACH, "auto"), pytest.param(REACH, "jax", marks=pytest.mark.slow)]
)
def test_processes_that_are_forked_have_an_environment_each(name, impl, forks):
    done = forks.run(FORK.format(name=name, impl=impl))
    assert done.stdout == "2 -1.0 -1.0\n", done.stderr


@pytest.mark.filterwarnings("ignore:.*A Box observation space (m|min|max).*")
@pytest.mark.filterwarnings("error:.*:UserWarning")
@pytest.mark.parametrize("name", [POINT, REACH, pytest.param(GYMNASIUM_IDS["push"], marks=pytest.mark.slow)])
def test_gymnasium_s_checker_is_content(name, rendering):
    options = {} if name == POINT else {"impl": "c", "substeps": 4, "render_mode": "rgb_array"}
    env = gymnasium.make(name, **options)
    check_env(env.unwrapped)
    env.close()


def test_a_single_environment_has_the_episodes_of_the_task():
    env, task = gymnasium.make(POINT), hgail_envs.make("point")
    key, rng = jax.random.key(5), np.random.default_rng(0)
    for episode in range(2):
        observation, info = env.reset(seed=5 if episode == 0 else None)
        key, episode_key = jax.random.split(key)
        state = task.reset(episode_key)
        for step in range(LENGTH):
            np.testing.assert_allclose(observation["desired_goal"], state.info["desired_goal"])
            np.testing.assert_allclose(observation["achieved_goal"], state.info["achieved_goal"], atol=1e-6)
            action = rng.uniform(-1, 1, 3).astype(np.float32)
            state = task.step(state, action)
            observation, reward, terminated, truncated, info = env.step(action)
            assert (reward, terminated, truncated) == (float(state.reward), False, step == LENGTH - 1)
            assert info["is_success"] == (reward == 0.0)
    achieved, goals = np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(env.unwrapped.compute_reward(achieved, goals, {}), [0.0, -1.0])
    assert env.unwrapped.compute_reward(achieved[1], goals[1], {}) == -1.0


@pytest.mark.parametrize(
    ("mode", "length"), [(AutoresetMode.NEXT_STEP, 7), (AutoresetMode.SAME_STEP, 7), (AutoresetMode.NEXT_STEP, None)]
)
def test_make_vec_steps_as_gymnasium_s_own_vectorisation(mode, length):
    """Observations, rewards, truncations and infos agree over more than two episodes, with the resets between them."""
    limit = {} if length is None else {"max_episode_steps": length}
    ours = gymnasium.make_vec(POINT, num_envs=2, autoreset_mode=mode.value, **limit)
    theirs = SyncVectorEnv([lambda: gymnasium.make(POINT, **limit)] * 2, autoreset_mode=mode)
    assert isinstance(ours, GoalVectorEnv)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    same(ours.reset(seed=7), theirs.reset(seed=7))
    rng, truncations = np.random.default_rng(0), 0
    for _ in range(2 * (length or LENGTH) + 5):
        actions = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
        mine, other = ours.step(actions), theirs.step(actions)
        same(mine, other)
        assert {"is_success", "_is_success"} <= mine[4].keys()
        truncations += mine[3].sum()
    assert truncations == 4


def same(left, right):
    """Asserts that two results agree, whatever they hold."""
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for name in left:
            same(left[name], right[name])
    elif isinstance(left, tuple) or (isinstance(left, np.ndarray) and left.dtype == object):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            same(one, other)
    else:
        np.testing.assert_allclose(left, right, atol=1e-6)
        assert np.asarray(left).dtype == np.asarray(right).dtype


def test_pictures_follow_the_arm_and_the_target(rendering):
    env = gymnasium.make(REACH, impl="c", substeps=4, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.reset(seed=1)
    other_target = env.render()
    for _ in range(10):
        env.step(np.ones(4, np.float32))
    moved = env.render()
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8
    changed = [np.mean(np.any(one != other, axis=-1)) for one, other in ((first, other_target), (other_target, moved))]
    assert 1e-4 < changed[0] < 0.05 < changed[1]  # a small ball; then an arm and its shadow
    env.close()
    vector = gymnasium.make_vec(REACH, num_envs=2, impl="c", substeps=4, render_mode="rgb_array")
    vector.reset(seed=0)
    pictures = vector.render()
    np.testing.assert_array_equal(pictures[0], first)
    np.testing.assert_array_equal(pictures[1], other_target)
    for copied in (pickle.loads(pickle.dumps(vector)), copy.deepcopy(vector)):  # whose renderer cannot be copied
        np.testing.assert_array_equal(copied.render()[0], first)
        copied.close()
    vector.close()


def test_record_video_writes_an_episode(rendering, tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo needs moviepy")
    env = gymnasium.make(REACH, impl="c", substeps=4, render_mode="rgb_array", max_episode_steps=5)
    env = gymnasium.wrappers.RecordVideo(env, str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    truncated = False
    while not truncated:
        *_, truncated, _ = env.step(np.zeros(4, np.float32))
    env.close()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("*.mp4")] == [True]


def test_bad_choices_are_refused():
    task = hgail_envs.make("point")
    with pytest.raises(ValueError, match="no scene"):
        GoalVectorEnv(task, 1, render_mode="rgb_array")
    with pytest.raises(ValueError, match=r"it must be None or 'rgb_array'"):
        GoalSingleEnv("reach", render_mode="human", impl="c")
    for mode in ("Disabled", AutoresetMode.DISABLED, "same"):
        with pytest.raises(ValueError, match="choose from NextStep, SameStep"):
            GoalVectorEnv(task, 1, autoreset_mode=mode)
    with pytest.raises(ValueError, match="max_episode_steps is 0; it must be at least 1"):
        GoalVectorEnv(task, 1, max_episode_steps=0)
    with pytest.raises(ValueError, match="no option 'impl'"):
        gymnasium.make(POINT, impl="c")
    vector = GoalVectorEnv(task, 1)
    assert vector.render() is None
    shown = GoalVectorEnv(hgail_envs.make("reach", impl="c"), 1, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        shown.render()


# Pictures in observations


@pytest.mark.usefixtures("rendering")
def test_a_single_environment_shows_its_first_state_and_the_one_after_an_action():
    env = gymnasium.make("hgail_envs/FetchPush-v0", cameras=["front", "wrist"], picture_size=16)
    check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=0)
    assert first["pixels"].shape == (2, 16, 16, 3) and first["pixels"].dtype == np.uint8
    assert env.observation_space.contains(first)
    after, *_ = env.step(np.array([1.0, 0.0, 0.0, 0.0]))
    assert (after["pixels"] != first["pixels"]).any()
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again["pixels"], first["pixels"])


@pytest.mark.usefixtures("rendering")
def test_rows_of_a_vector_are_its_environments_and_it_can_be_pickled():
    vector = gymnasium.make_vec("hgail_envs/FetchPush-v0", num_envs=2, cameras=["front"], picture_size=32)
    pixels = vector.reset(seed=3)[0]["pixels"]
    other = pickle.loads(pickle.dumps(vector))
    single = gymnasium.make("hgail_envs/FetchPush-v0", cameras=["front"], picture_size=32)
    for row in range(2):
        np.testing.assert_array_equal(single.reset(seed=3 + row)[0]["pixels"], pixels[row])
    assert (pixels[0] != pixels[1]).any()
    np.testing.assert_array_equal(other.reset(seed=3)[0]["pixels"], pixels)


@pytest.mark.usefixtures("rendering")
def test_other_observations_have_no_pictures_and_an_unknown_camera_is_refused():
    assert "pixels" not in gymnasium.make("hgail_envs/FetchPush-v0").observation_space.spaces
    with pytest.raises(ValueError, match="scene push has no camera 'nose'"):
        gymnasium.make("hgail_envs/FetchPush-v0", cameras=["nose"])
    with pytest.raises(ValueError, match=r"cameras is 'front'; it must be a sequence of names, such as \['front'\]"):
        gymnasium.make("hgail_envs/FetchPush-v0", cameras="front")
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(ValueError, match="picture_size is 32, and there are no cameras"):
            make("hgail_envs/FetchPush-v0", picture_size=32)
