"""Films, read back by imageio and Pillow."""

import os
from pathlib import Path

import imageio
import numpy as np
import pytest
from PIL import Image

from hgail_jax.io.files import check_new_file
from hgail_jax.play.playback import FORMATS, open_film

COLOURS = [(220, 30, 30), (30, 200, 40), (30, 40, 210), (240, 240, 240), (10, 10, 10)]


def picture(index):
    frame = np.full((48, 64, 3), 128, np.uint8)
    frame[8:40, 8:40] = COLOURS[index]
    return frame


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_film_has_the_pictures_that_it_was_given(tmp_path, monkeypatch, suffix):
    monkeypatch.chdir(tmp_path)
    path = Path("[re:1] %d") / f"film{suffix}"
    with open_film(path, 0.04) as append:
        for index in range(len(COLOURS)):
            append(picture(index))
    assert list(path.parent.iterdir()) == [path]
    if suffix == ".mp4":
        with imageio.get_reader(path, format="FFMPEG") as reader:
            assert reader.get_meta_data()["fps"] == 25
            frames = [reader.get_data(index) for index in range(reader.count_frames())]
    else:
        with Image.open(path) as animation:
            assert animation.info["loop"] == 0  # for ever
            frames = []
            for index in range(animation.n_frames):
                animation.seek(index)
                frames.append(np.asarray(animation.convert("RGB")))
                assert animation.info["duration"] == 40
    assert len(frames) == len(COLOURS)
    for index, frame in enumerate(frames):
        np.testing.assert_allclose(frame[16:32, 16:32].mean(axis=(0, 1)), COLOURS[index], atol=45)  # compressed
        np.testing.assert_allclose(frame[:4, 48:].mean(axis=(0, 1)), 128, atol=45)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_a_film_that_is_broken_off_leaves_nothing(tmp_path, suffix, error):
    def record():
        with open_film(tmp_path / f"film{suffix}", 0.04) as append:
            append(picture(0))
            raise error

    with pytest.raises(error):
        record()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["film.mp4", "film.MP4", "film.gif", "film.webp", "a.b.webp"])
def test_a_new_film_may_have_these_names(tmp_path, name):
    check_new_file(tmp_path / name, FORMATS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["film", "film.avi", "film.mp4.part", ".mp4"])
def test_a_film_of_another_format_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match=r"must end in \.mp4, \.gif, \.webp"):
        check_new_file(tmp_path / name, FORMATS)


def test_what_is_there_is_not_overwritten(tmp_path):
    (tmp_path / "film.mp4").write_text("kept")
    (tmp_path / "link.mp4").symlink_to("nowhere.mp4")
    (tmp_path / "folder.mp4").mkdir()
    for name in ("film", "link", "folder"):
        with pytest.raises(ValueError, match=f"{name}.mp4 exists already"):
            check_new_file(tmp_path / f"{name}.mp4", FORMATS)


def test_a_folder_that_takes_no_film_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(PermissionError):
        check_new_file(tmp_path / "film.mp4", FORMATS)
