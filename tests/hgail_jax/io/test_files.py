import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax.io.files import check_writable, remove_partial_files, replace_file, write_csv, write_json


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), replace_file(path) as file:
        file.write("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert names(tmp_path) == ["file.txt"]


def test_a_file_has_its_name_once_it_is_whole(tmp_path):
    path = tmp_path / "file.bin"
    with replace_file(path, "wb") as file:
        file.write(b"whole")
        file.flush()
        assert not path.exists()
        assert len(names(tmp_path)) == 1
    assert path.read_bytes() == b"whole"
    assert names(tmp_path) == ["file.bin"]


def test_what_cannot_be_written_is_refused_before(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    check_writable(tmp_path / "new" / "folders" / "a.json")
    check_writable(tmp_path / "file")
    with pytest.raises(NotADirectoryError, match="file"):
        check_writable(tmp_path / "file" / "folder" / "a.json")
    with pytest.raises(IsADirectoryError):
        check_writable(tmp_path)
    monkeypatch.setattr(os, "access", lambda *arguments: False)  # root may write anywhere
    with pytest.raises(PermissionError):
        check_writable(tmp_path / "a.json")
    assert names(tmp_path) == ["file"]


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    for name in (".17.partial.metrics.csv", "metrics.csv", ".hidden", "a.partial"):
        (tmp_path / name).touch()
    remove_partial_files(tmp_path)
    assert names(tmp_path) == [".hidden", "a.partial", "metrics.csv"]


def test_json_has_plain_numbers_and_null_for_what_is_none(tmp_path):
    content = {
        "nan": float("nan"),
        "array": np.float32([1, np.inf]),
        "jax": jnp.array([[1, 2]]),
        "path": Path("p"),
        "scalars": [np.int64(8), np.float32(0.5), np.bool_(True)],
        "nested": {"tuple": (1, float("-inf"), "x")},
    }
    write_json(tmp_path / "a.json", content)
    expected = {
        "nan": None,
        "array": [1.0, None],
        "jax": [[1, 2]],
        "path": "p",
        "scalars": [8, 0.5, True],
        "nested": {"tuple": [1, None, "x"]},
    }
    assert json.loads((tmp_path / "a.json").read_text()) == expected


def test_json_has_a_list_of_numbers_on_one_line_and_texts_as_they_are(tmp_path):
    content = {"rows": [[1.5, float("nan")], []], "text": "a [1,  2] b\n[3,\n 4]", "names": ["x", "[\n5]"]}
    write_json(tmp_path / "a.json", content)
    written = (tmp_path / "a.json").read_text()
    assert "    [1.5, null],\n    []\n" in written
    assert json.loads(written) == content | {"rows": [[1.5, None], []]}


def test_csv_has_a_column_per_name_and_leaves_none_empty(tmp_path):
    write_csv(tmp_path / "a.csv", [{"x": None, "y": 1.5}, {"x": 2, "y": "z"}])
    assert (tmp_path / "a.csv").read_text().split() == ["x,y", ",1.5", "2,z"]
    write_csv(tmp_path / "a.csv", [])
    assert (tmp_path / "a.csv").read_text() == ""
