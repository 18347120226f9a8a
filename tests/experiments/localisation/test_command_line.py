"""The command line, and the files that it writes."""

import csv
import json

import imageio.v3 as imageio
import pytest

from experiments.localisation import __main__ as localisation
from experiments.localisation.error import SWEEPS
from experiments.localisation.keypoint_network import load_weights


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_training_writes_weights_that_load(rendering, tmp_path):
    out = tmp_path / "out"
    localisation.main(["train", "--pictures", "64", "--epochs", "1", "--out", str(out)])
    load_weights(out / "weights.npz")
    assert [row["epoch"] for row in rows_of(out / "training.csv")] == ["1"]
    config = json.loads((out / "config.json").read_text())
    assert config["options"]["pictures"] == 64
    assert {"command", "device", "versions"} <= config.keys()


def test_evaluation_writes_tables_and_pictures(rendering, tmp_path):
    out = tmp_path / "out"
    localisation.main(["evaluate", "--scenes", "3", "--out", str(out)])
    errors, noise = rows_of(out / "errors.csv"), rows_of(out / "noise.csv")
    assert len(errors) == 2 * 2 * 2 * 2  # targets, scenes, cameras, detectors
    assert {row["count"] for row in errors} == {"3"}
    assert len(noise) == 2 * 2 * sum(map(len, SWEEPS.values()))
    for kind in SWEEPS:  # the largest noise errs more than none
        of_kind = [float(row["median_mm"]) for row in noise if row["noise"] == kind and row["detector"] == "colour"]
        assert of_kind[-1] > of_kind[0] + 5.0
    for name in ("noise", "examples"):
        assert imageio.imread(out / f"{name}.png").std() > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "train, evaluate"),
        (["train", "--pictures", "63"], "pictures is 63; it must be at least 64"),
        (["train", "--epochs", "0"], "epochs is 0; it must be at least 1"),
        (["evaluate", "--scenes", "0"], "scenes is 0; it must be at least 1"),
        (["evaluate", "--weights", "none.npz"], "none.npz"),
        (["evaluate", "--epochs", "1"], "epochs"),
        (["train", "--seed", "-1"], "seed is -1; it must be at least 0"),
        (["evaluate", "--out", "."], ". exists already"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch, request):
    if "--out" in arguments:
        request.getfixturevalue("rendering")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        localisation.main(arguments)
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("localisation: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_without_a_renderer_nothing_is_written(capsys, tmp_path, monkeypatch):
    def cannot():
        raise RuntimeError("MuJoCo cannot render here, install EGL or OSMesa")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(localisation, "Studio", cannot)
    with pytest.raises(SystemExit):
        localisation.main(["train"])
    assert "install EGL or OSMesa" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
