import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax import Checkpoints
from hgail_jax.trainer.checkpoint import KEPT, SCHEMA
from tests.support import four_devices, small_files_only

RUN = {"task": "point", "config": {"num_envs": 4, "hidden": (8, 8)}}


def small_state(value=0.0):
    return {
        "weights": jnp.full((2, 3), float(value)) + jnp.arange(3),
        "noise": jax.random.normal(jax.random.key(1), (100, 100)),  # too large to be stored in an index
        "count": jnp.array([1, 2], jnp.int32),
        "flag": jnp.array(True),
        "key": jax.random.split(jax.random.key(7), 2),
    }


def numbers(state):
    return jax.tree.map(
        lambda leaf: np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf),
        state,
    )


def assert_same(one, other):
    def same(a, b):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)

    jax.tree.map(same, numbers(one), numbers(other))


def save_small(folder, count, scores=None):
    with Checkpoints(folder, RUN) as checkpoints:
        for rounds in range(1, count + 1):
            score = scores[rounds - 1] if scores else (0.0,)
            checkpoints.save(rounds, small_state(rounds), {"rows": [rounds, 0.1, None]}, score, history(rounds))


def history(rounds):
    return [{"round": index, "values": [index / 3, None]} for index in range(rounds)]


def kept(folder):
    """The rounds of the checkpoints in a folder, in which there is nothing else but their history."""
    return sorted(int(path.name) for path in folder.iterdir() if path.name != "history.jsonl")


def test_a_state_comes_back_as_it_was(tmp_path):
    save_small(tmp_path, 2)
    read = Checkpoints(tmp_path, RUN).restore(jax.eval_shape(small_state))
    assert (read.rounds, read.record, read.damaged) == (2, {"rows": [2, 0.1, None]}, ())
    assert read.history == history(2)
    assert_same(read.state, small_state(2))
    assert jnp.issubdtype(read.state["key"].dtype, jax.dtypes.prng_key)


def test_where_there_is_none_there_is_none(tmp_path):
    assert Checkpoints(tmp_path / "missing", RUN).restore(small_state()) is None
    assert not (tmp_path / "missing").exists()


def test_the_last_ones_and_the_best_are_kept(tmp_path):
    scores = [(0.5, 0.0), (0.9, -2.0), (0.9, -1.0), (0.1, 0.0), (0.2, 0.0), (0.3, 0.0), (0.4, 0.0)]
    save_small(tmp_path, 7, scores)
    assert kept(tmp_path) == [3, 5, 6, 7]
    checkpoints = Checkpoints(tmp_path, RUN)  # the best is still known to a resumed run
    checkpoints.restore(small_state())
    with checkpoints:
        checkpoints.save(8, small_state(8), {}, (0.0, 0.0))
    assert kept(tmp_path) == [3, 6, 7, 8]
    assert KEPT == 3


def test_a_state_may_be_donated_once_it_is_saved(tmp_path):
    step = jax.jit(lambda values: values + 1.0, donate_argnums=0)
    values = jnp.zeros(100_000)
    with Checkpoints(tmp_path, RUN) as checkpoints:
        for rounds in range(1, 4):
            checkpoints.save(rounds, {"values": values}, {}, (0.0,))
            for _ in range(5):
                values = step(values)
    read = Checkpoints(tmp_path, RUN).restore({"values": values})
    np.testing.assert_array_equal(read.state["values"], np.full(100_000, 10.0))


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (RUN | {"task": "reach"}, "task is point there and reach here"),
        (RUN | {"config": {"num_envs": 8, "hidden": (8, 8)}}, "config.num_envs is 4 there and 8 here"),
        (RUN | {"config": {"num_envs": 4, "hidden": (8,)}}, r"config.hidden is \[8, 8\] there and \[8\] here"),
        (RUN | {"seeds": 2}, "seeds is absent there and 2 here"),
        ({"task": "point"}, "config is given there and absent here"),
    ],
)
def test_another_run_is_refused(tmp_path, run, message):
    save_small(tmp_path, 1)
    with pytest.raises(ValueError, match=message):
        Checkpoints(tmp_path, run).restore(small_state())
    assert kept(tmp_path) == [1]


def test_a_state_of_another_shape_or_another_schema_is_refused(tmp_path, monkeypatch):
    save_small(tmp_path, 1)
    for changed, message in (
        ({"weights": jnp.zeros((2, 4))}, r"weights is \['float32', \[2, 3\]\] there and \['float32', \[2, 4\]\] here"),
        ({"count": jnp.zeros(2)}, "count is .*int32"),
        ({"more": jnp.zeros(2)}, "more is absent there"),
    ):
        with pytest.raises(ValueError, match=message):
            Checkpoints(tmp_path, RUN).restore(small_state() | changed)
    monkeypatch.setattr("hgail_jax.trainer.checkpoint.SCHEMA", SCHEMA + 1)
    with pytest.raises(ValueError, match=f"schema {SCHEMA}; this version reads {SCHEMA + 1}"):
        Checkpoints(tmp_path, RUN).restore(small_state())


def flip(file, at=None):
    content = bytearray(file.read_bytes())
    content[len(content) // 2 if at is None else at] ^= 1
    file.write_bytes(content)


def arrays_of(path):
    return path / "state" / "arrays.npz"


def record_of(path):
    return path / "state" / "record.json"


def history_of(path):
    return path.parent / "history.jsonl"


DAMAGE = {
    "arrays cut off": lambda path: os.truncate(arrays_of(path), arrays_of(path).stat().st_size // 2),
    "arrays empty": lambda path: os.truncate(arrays_of(path), 0),
    "a bit of an array": lambda path: flip(arrays_of(path)),
    "no arrays": lambda path: arrays_of(path).unlink(),
    "nothing": lambda path: [shutil.rmtree(path), path.mkdir()],
    "no record": lambda path: record_of(path).unlink(),
    "a bit of the record": lambda path: flip(record_of(path)),
    "an altered record": lambda path: record_of(path).write_text(record_of(path).read_text().replace("rows", "cows")),
    "a history cut off": lambda path: os.truncate(history_of(path), history_of(path).stat().st_size - 1),
    "a bit of the last row": lambda path: flip(history_of(path), -3),
    "no record but a number": lambda path: record_of(path).write_text("7"),
    "deep nesting": lambda path: record_of(path).write_text("[" * 100_000),
}


def saved_in(folder):
    """The rounds of a run's checkpoints."""
    names = os.listdir(folder / "checkpoints") if (folder / "checkpoints").exists() else []
    return sorted(int(name) for name in names if name.isdecimal())


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_falls_back_to_the_one_before(tmp_path, capfd, damage):
    save_small(tmp_path, 3)
    DAMAGE[damage](tmp_path / "3")
    checkpoints = Checkpoints(tmp_path, RUN)
    read = checkpoints.restore(small_state())
    assert read.rounds == 2
    assert len(read.damaged) == 1
    assert f"checkpoint 3 in {tmp_path} is damaged" in read.damaged[0]
    assert "\n" not in read.damaged[0]
    assert_same(read.state, small_state(2))
    assert read.history == history(2)
    assert capfd.readouterr().err == ""
    with checkpoints:
        checkpoints.save(3, small_state(30), {}, (0.0,), [*history(2), {"round": "again"}])
    read = Checkpoints(tmp_path, RUN).restore(small_state())
    assert_same(read.state, small_state(30))
    assert read.history == [*history(2), {"round": "again"}]


def test_a_checkpoint_costs_the_same_after_any_number_of_rounds(tmp_path):
    """In bytes: of its own files, and of those added to the history."""
    own, lines = [], []
    with Checkpoints(tmp_path, RUN) as checkpoints:
        for rounds in range(100, 161):
            checkpoints.save(rounds, small_state(), {}, (0.5, -0.1), history(rounds))
            lines.append(history_of(tmp_path / "100").stat().st_size)
    for path in (tmp_path / "158", tmp_path / "160"):
        own.append(record_of(path).stat().st_size)
    assert own[0] == own[1] < 3_000
    assert max(np.diff(lines)) < 60
    assert Checkpoints(tmp_path, RUN).restore(small_state()).history == history(160)


def test_what_a_killed_process_wrote_behind_the_last_checkpoint_is_cut_off(tmp_path):
    save_small(tmp_path, 2)
    for written in ('{"round": 2, "values": [0', '{"round": 2}\n'):
        with history_of(tmp_path / "2").open("a") as file:
            file.write(written)
        checkpoints = Checkpoints(tmp_path, RUN)
        read = checkpoints.restore(small_state())
        assert (read.rounds, read.history, read.damaged) == (2, history(2), ())
    with checkpoints:
        checkpoints.save(3, small_state(3), {}, (0.0,), history(3))
    assert Checkpoints(tmp_path, RUN).restore(small_state()).history == history(3)
    for rounds in (1, 2, 3):
        shutil.rmtree(tmp_path / str(rounds))
    save_small(tmp_path, 1)  # killed before its first checkpoint, a run begins anew
    assert Checkpoints(tmp_path, RUN).restore(small_state()).history == history(1)


def test_where_all_are_damaged_it_says_so(tmp_path):
    save_small(tmp_path, 2)
    for rounds in (1, 2):
        os.truncate(record_of(tmp_path / str(rounds)), 10)
    with pytest.raises(ValueError, match=r"no checkpoint can be read: checkpoint 2 .*; checkpoint 1"):
        Checkpoints(tmp_path, RUN).restore(small_state())


def test_what_a_killed_process_left_is_no_checkpoint_and_is_removed(tmp_path):
    save_small(tmp_path, 2)
    shutil.copytree(tmp_path / "2", tmp_path / "3.orbax-checkpoint-tmp")
    checkpoints = Checkpoints(tmp_path, RUN)
    assert checkpoints.restore(small_state()).rounds == 2
    with checkpoints:
        checkpoints.save(3, small_state(3), {}, (0.0,))
    assert kept(tmp_path) == [1, 2, 3]


def test_checkpoints_are_never_overwritten_unread(tmp_path):
    save_small(tmp_path, 2)
    with pytest.raises(ValueError, match="restore one before saving more"):
        save_small(tmp_path, 1)
    assert kept(tmp_path) == [1, 2]


def test_a_state_that_is_not_finite_is_not_saved(tmp_path):
    with Checkpoints(tmp_path, RUN) as checkpoints, pytest.raises(FloatingPointError, match="weights is not finite"):
        checkpoints.save(1, small_state(float("nan")), {}, (0.0,))
    assert kept(tmp_path) == []


FULL_DISK = """
import sys
import jax
from hgail_jax import Checkpoints
from tests.support import small_files_only
state = {name: jax.random.normal(jax.random.key(0), (100, 100)) for name in "abcdefgh"}
with small_files_only(8192), Checkpoints("checkpoints", {}) as checkpoints:
    checkpoints.save(1, state, {}, None)
"""


def test_a_full_disk_is_an_error_in_one_line_and_leaves_nothing(forks):
    ended = forks.run(FULL_DISK)
    *_, last = ended.stderr.splitlines()
    assert last == f"OSError: cannot write a checkpoint to {ended.folder}/checkpoints: File too large"
    assert ended.stderr.count("OSError: cannot write") == 1 and "Event loop" not in ended.stderr
    assert not list((ended.folder / "checkpoints").iterdir())


def test_a_run_resumes_once_a_full_disk_has_room(tmp_path):
    save_small(tmp_path, 1)
    checkpoints = Checkpoints(tmp_path, RUN)
    checkpoints.restore(small_state())
    with pytest.raises(OSError, match="File too large"), small_files_only(1_000), checkpoints:
        checkpoints.save(2, small_state(), {}, (0.0,))
    assert kept(tmp_path) == [1]
    checkpoints = Checkpoints(tmp_path, RUN)
    assert checkpoints.restore(small_state()).rounds == 1
    with checkpoints:
        checkpoints.save(2, small_state(), {}, (0.0,))
    assert kept(tmp_path) == [1, 2]


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OSError, match="cannot write a checkpoint"),
        Checkpoints(tmp_path / "file" / "run", RUN) as checkpoints,
    ):
        checkpoints.save(1, small_state(), {}, (0.0,))


ON_FOUR_DEVICES = """
import jax, jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from hgail_jax import Checkpoints
mesh = Mesh(jax.devices(), "seeds")
template = {{"values": jax.device_put(jnp.zeros((8, 3)), NamedSharding(mesh, PartitionSpec("seeds")))}}
with Checkpoints({!r}, {{}}) as checkpoints:
    state = checkpoints.restore(template).state
    print(len(state["values"].sharding.device_set), float(state["values"].sum()))
    checkpoints.save(2, jax.jit(lambda state: jax.tree.map(lambda leaf: leaf + 1, state))(state), {{}}, (0.0,))
"""


def test_a_state_is_restored_onto_more_devices_and_onto_fewer(forks, tmp_path):
    values = jnp.arange(24.0).reshape(8, 3)
    with Checkpoints(tmp_path, {}) as checkpoints:
        checkpoints.save(1, {"values": values}, {}, (0.0,))
    ended = forks.run(ON_FOUR_DEVICES.format(str(tmp_path)), four_devices())
    assert ended.stdout.split() == ["4", "276.0"], ended.stderr
    read = Checkpoints(tmp_path, {}).restore({"values": values})
    np.testing.assert_array_equal(read.state["values"], values + 1)
    assert len(read.state["values"].sharding.device_set) == 1


@pytest.mark.parametrize("kind", ["file", "loop"])
def test_what_is_no_folder_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "checkpoints"
    if kind == "file":
        path.write_text("")
    else:
        path.symlink_to(path)
    with pytest.raises(ValueError, match="checkpoints is no folder"):
        Checkpoints(path, RUN)


@pytest.mark.parametrize("name", ["[lab] run", "*", "re:1", "100%s", " ", "~", "läuft", "a\nb", "file", r"q\r/x"])
def test_a_folder_may_have_any_name(tmp_path, name):
    save_small(tmp_path / name, 2)
    assert_same(Checkpoints(tmp_path / name, RUN).restore(small_state()).state, small_state(2))


def test_names_of_leaves_are_free(tmp_path):
    state = {"file": jnp.ones(2), "record": jnp.ones(3), "a/b": {"..": jnp.ones(4)}}
    with Checkpoints(tmp_path, RUN) as checkpoints:
        checkpoints.save(1, state, {}, None)
    assert_same(Checkpoints(tmp_path, RUN).restore(state).state, state)


@pytest.mark.parametrize("earlier", ["2/record/x", "2/record.json"])
def test_checkpoints_of_an_earlier_version_are_refused(tmp_path, earlier):
    (tmp_path / earlier).parent.mkdir(parents=True)
    (tmp_path / earlier).touch()
    with pytest.raises(ValueError, match=r"has checkpoints of hgail-jax 0\.3 or earlier, which 0\.4 cannot read"):
        Checkpoints(tmp_path, RUN)
