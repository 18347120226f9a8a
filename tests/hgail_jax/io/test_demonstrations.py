import json

import numpy as np
import pytest

import hgail_envs
from hgail_jax import Demonstrations, load_demonstrations, save_demonstrations

ENV = hgail_envs.make("point")
EPISODES, LENGTH = 4, 5


def arrays(**changes):
    rng = np.random.default_rng(0)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    steps = {name: draw(EPISODES, LENGTH, 3) for name in ("features", "goal", "action")}
    return steps | {name: draw(EPISODES) for name in ("success", "returns", "distance_l1")} | changes


DEMONSTRATIONS = Demonstrations("point", **arrays(), made_by={"controller": "somebody", "seed": 3})


@pytest.fixture
def path(tmp_path):
    save_demonstrations(tmp_path / "d.npz", DEMONSTRATIONS)
    return tmp_path / "d.npz"


def rewrite(path, said=None, save=np.savez, **changes):
    """Saves the file anew with other entries in its header, or other arrays."""
    with np.load(path) as file:
        content = {name: file[name] for name in file.files}
    header = json.loads(str(content["header"])) | (said or {})
    save(path, **(content | {"header": np.array(json.dumps(header))} | changes))


def test_what_is_saved_is_loaded(path):
    loaded = load_demonstrations(path, "point")
    for name, array in arrays().items():
        np.testing.assert_array_equal(getattr(loaded, name), array)
    assert (loaded.task, loaded.made_by) == ("point", DEMONSTRATIONS.made_by)
    assert loaded.sha256 == DEMONSTRATIONS.sha256
    assert [entry.name for entry in path.parent.iterdir()] == ["d.npz"]


def test_samples_are_the_steps_under_their_goals():
    samples = DEMONSTRATIONS.first(3).samples(ENV)
    assert samples.observation.shape == (3 * LENGTH, 6)
    for episode in range(3):
        for step in range(LENGTH):
            row = episode * LENGTH + step
            np.testing.assert_array_equal(samples.observation[row, :3], DEMONSTRATIONS.features[episode, step])
            np.testing.assert_array_equal(samples.observation[row, 3:], DEMONSTRATIONS.goal[episode, step])
            np.testing.assert_array_equal(samples.action[row], DEMONSTRATIONS.action[episode, step])
    assert (samples.weight == 1.0).all()


def test_the_hash_differs_between_demonstrations():
    changed = DEMONSTRATIONS.action.copy()
    changed[2, 1, 0] += 1e-6
    others = [DEMONSTRATIONS.first(3), Demonstrations("point", **arrays(action=changed))]
    assert len({DEMONSTRATIONS.sha256, *(other.sha256 for other in others)}) == 3


@pytest.mark.parametrize("count", [0, -1, 5])
def test_there_are_only_so_many(count):
    with pytest.raises(ValueError, match="there are 4 demonstrations"):
        DEMONSTRATIONS.first(count)


def test_sizes_of_another_task_are_refused():
    with pytest.raises(ValueError, match=r"sizes \(3, 3, 3\); the task: \(6, 3, 4\)"):
        DEMONSTRATIONS.samples(hgail_envs.make("reach"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"said": {"format": "hgail_jax demonstrations 0"}}, "its format is 'hgail_jax demonstrations 0'"),
        ({"said": {"task": "reach"}}, "demonstrates 'reach', not 'point'"),
        ({"header": np.array("{}")}, "does not hold demonstrations"),
        ({"header": np.array("[]")}, "does not hold demonstrations"),
        ({"action": np.full((4, 5, 3), np.nan, np.float32)}, "action is not all finite float32"),
        ({"goal": np.zeros((4, 5, 3))}, "goal is not all finite float32"),
        ({"goal": np.zeros((4, 3), np.float32)}, r"goal has the shape \(4, 3\)"),
        ({"action": np.zeros((4, 6, 3), np.float32)}, "differ in their episodes or steps"),
        ({"features": np.zeros((5, 5, 3), np.float32)}, "differ in their episodes or steps"),
        ({"features": np.zeros((4, 0, 3), np.float32)}, r"features has the shape"),
        ({"returns": np.zeros(3, np.float32)}, "not of 4 episodes each"),
        ({"success": np.array([{}, 1, 2, 3], object)}, "pickle"),
        ({"save": np.savez_compressed}, "it is compressed"),
    ],
)
def test_files_that_do_not_fit_are_refused(path, changes, message):
    rewrite(path)
    load_demonstrations(path, "point")
    rewrite(path, **changes)
    with pytest.raises(ValueError, match=message) as error:
        load_demonstrations(path, "point")
    assert str(path) in str(error.value)


def test_truncated_files_are_refused(path):
    content = path.read_bytes()
    for length in range(0, len(content), len(content) // 15):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="does not hold demonstrations"):
            load_demonstrations(path, "point")


def test_a_missing_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_demonstrations(tmp_path / "d.npz", "point")
