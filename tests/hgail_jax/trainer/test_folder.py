import itertools
import os
import re
from pathlib import Path

import pytest

from hgail_jax.trainer.folder import create_folder, create_numbered_folder, newest_folder, reopen_folder, sole_user


def test_numbered_folders_count_on(tmp_path):
    assert create_numbered_folder(tmp_path / "runs", "reach-hgail") == tmp_path / "runs" / "reach-hgail-1"
    for name in ("reach-hgail-2", "reach-hgail-10", "reach-hgail-no-30", "reach-hgail-x"):
        (tmp_path / "runs" / name).mkdir()
    assert create_numbered_folder(tmp_path / "runs", "reach-hgail").name == "reach-hgail-11"
    assert (tmp_path / "runs" / "reach-hgail-11").is_dir()


def test_a_run_begun_at_the_same_moment_takes_the_next_number(tmp_path, monkeypatch):
    mkdir, others = Path.mkdir, iter(range(2))

    def made_by_another_first(path, **options):
        for _ in itertools.islice(others, 1):
            mkdir(path, **options)
        mkdir(path, **options)

    monkeypatch.setattr(Path, "mkdir", made_by_another_first)
    assert create_numbered_folder(tmp_path, "reach-hgail").name == "reach-hgail-3"
    assert {path.name for path in tmp_path.iterdir()} == {f"reach-hgail-{number}" for number in (1, 2, 3)}


def test_a_numbered_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "away").symlink_to(tmp_path / "missing")
    for parent in ("file", "away"):
        with pytest.raises(ValueError, match=f"{parent}/reach-hgail-1"):
            create_numbered_folder(tmp_path / parent, "reach-hgail")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "away"}


def saved_at(path, seconds):
    """Makes a file, and the folder that it is in as of that time, too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    for written in (path, path.parent):
        os.utime(written, (seconds, seconds))


def test_the_newest_folder_is_of_the_run_that_was_saved_last(tmp_path):
    def newest():
        found = newest_folder(tmp_path, "reach-hgail")
        return found and found.name

    assert newest() is None
    saved_at(tmp_path / "reach-hgail-7" / "photograph.png", 900)
    saved_at(tmp_path / "reach-hgail-9", 900)
    assert newest() is None  # neither is the folder of a run
    saved_at(tmp_path / "reach-hgail-2" / "config.json", 100)
    saved_at(tmp_path / "reach-hgail-10" / "config.json", 200)
    saved_at(tmp_path / "reach-hgail-no-30" / "config.json", 900)  # another method's
    assert newest() == "reach-hgail-10"
    saved_at(tmp_path / "reach-hgail-2" / "checkpoints" / "1", 300)
    assert newest() == "reach-hgail-2"  # which went on
    saved_at(tmp_path / "reach-hgail-10" / "checkpoints" / "2", 400)
    assert newest() == "reach-hgail-10"
    saved_at(tmp_path / "reach-hgail-1" / ".17.partial.config.json", 500)
    assert newest() == "reach-hgail-1"  # killed before its first file
    saved_at(tmp_path / "reach-hgail-3" / "config.json", 500)
    assert newest() == "reach-hgail-3"  # the higher number, where the times are the same


def test_a_folder_is_made_once(tmp_path):
    create_folder(tmp_path / "runs" / "one")
    with pytest.raises(ValueError, match="one exists already"):
        create_folder(tmp_path / "runs" / "one")


def test_a_run_that_is_not_finished_is_not_begun_again_but_gone_on_with(tmp_path):
    (tmp_path / "config.json").touch()
    hint = re.escape(f"exists already; resume its run by --resume {tmp_path}, or name another folder")
    with pytest.raises(ValueError, match=hint):
        create_folder(tmp_path)
    (tmp_path / "summary.json").touch()
    with pytest.raises(ValueError, match="exists already; name another folder"):
        create_folder(tmp_path)


def test_an_empty_folder_may_be_gone_on_with_and_one_of_something_else_not(tmp_path):
    reopen_folder(tmp_path, {"task": "reach"})
    (tmp_path / ".hidden").touch()
    reopen_folder(tmp_path, {"task": "reach"})
    (tmp_path / "photograph.png").touch()
    with pytest.raises(ValueError, match=r"not the folder of a run that can be resumed: it has no config\.json"):
        reopen_folder(tmp_path, {"task": "reach"})
    (tmp_path / "config.json").write_text('{"task": "grasp", "more": 1}')
    with pytest.raises(ValueError, match="task is grasp there and reach here"):
        reopen_folder(tmp_path, {"task": "reach"})
    reopen_folder(tmp_path, {"task": "grasp"})
    with pytest.raises(ValueError, match="there is no folder"):
        reopen_folder(tmp_path / "missing", {})


def test_a_folder_has_one_user_at_a_time(tmp_path):
    for _ in range(3):
        with sole_user(tmp_path):
            with pytest.raises(ValueError, match="is in use by another process"), sole_user(tmp_path):
                pass
            with pytest.raises(ValueError, match="in use"), sole_user(tmp_path):
                pass
    assert not [path for path in tmp_path.iterdir() if path.name != ".lock"]
