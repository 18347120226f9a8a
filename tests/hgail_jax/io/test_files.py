import importlib.metadata
import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_jax
from hgail_jax.io import provenance
from hgail_jax.io import provenance as module
from hgail_jax.io.files import append_csv, check_writable, remove_partial_files, replace_file, write_csv, write_json
from tests.support import small_files_only


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


@pytest.mark.parametrize(("platform", "driver"), [("gpu", "580.1"), ("cpu", None)])
def test_what_ran_on_a_gpu_names_its_driver(monkeypatch, platform, driver):
    monkeypatch.setattr(provenance, "driver_version", lambda: "580.1")
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(platform=platform, device_kind="a chip")])
    assert provenance.provenance()["versions"]["driver"] == driver


def test_a_checkout_that_is_not_installed_has_its_own_version(monkeypatch):
    def version(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert provenance.installed("hgail-jax", "jax") == {"hgail-jax": hgail_jax.__version__, "jax": None}


def git(folder, *words):
    of_a_user = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", *of_a_user, *words], cwd=folder, check=True, capture_output=True)


@pytest.mark.parametrize(
    ("place", "tracked", "project", "known"),
    [
        (".", True, "hgail-jax", True),  # the project's own checkout
        (".venv", False, "mine", False),  # installed within another's repository
        ("third_party/hgail_jax", True, "hgail-jax", False),  # a copy in it
        (".", True, "mine", False),  # a copy of the package alone
    ],
)
def test_the_commit_is_that_of_this_project_s_own_checkout_alone(tmp_path, monkeypatch, place, tracked, project, known):
    root = tmp_path / place
    (root / "hgail_jax" / "io").mkdir(parents=True)
    for name, content in (("hgail_jax/io/provenance.py", ""), ("pyproject.toml", f'name = "{project}"\n')):
        (root / name).write_text(content)
    (tmp_path / "of_the_user.py").touch()
    git(tmp_path, "init")
    git(tmp_path, "add", "." if tracked else "of_the_user.py")
    git(tmp_path, "commit", "-m", "first")
    monkeypatch.setattr(provenance, "_ROOT", root)
    monkeypatch.setattr(provenance, "_commit", provenance._commit.__wrapped__)
    commit = provenance.provenance()["commit"]
    assert (commit is not None and len(commit) == 7) == known, commit


def test_the_driver_of_several_gpus_has_one_version(tmp_path, monkeypatch):
    tool = tmp_path / "nvidia-smi"
    tool.write_text('#!/bin/sh\ncase "$1" in *driver*) echo 580.1; echo 580.1;; esac\n')
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert module.driver_version() == "580.1"


def test_without_a_driver_there_is_none(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert module.driver_version() is None


def test_rows_are_added_whole_or_not_at_all(tmp_path):
    rows = [{"round": index, "loss": index / 3 if index % 2 else None} for index in range(4)]
    write_csv(tmp_path / "whole.csv", rows)
    write_csv(tmp_path / "a.csv", rows[:1])
    append_csv(tmp_path / "a.csv", rows[1:2])
    before = (tmp_path / "a.csv").read_bytes()
    with small_files_only(len(before) + 3), pytest.raises(OSError):
        append_csv(tmp_path / "a.csv", rows[2:])
    assert (tmp_path / "a.csv").read_bytes() == before
    append_csv(tmp_path / "a.csv", rows[2:])
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
