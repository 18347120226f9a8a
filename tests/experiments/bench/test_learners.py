"""Learners side by side."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments.bench import __main__ as bench
from experiments.bench import learners
from experiments.bench.figures import draw_learners
from tests.support import ELSEWHERE, HERE


@pytest.mark.parametrize(("limit", "count"), [(900.0, 3), (15.0, 2)])
def test_a_seed_ends_with_two_successes_or_at_its_time(monkeypatch, limit, count):
    def train(task, num_envs, seed, tested):
        for index, success in enumerate((0.99, 0.5, 0.98, 1.0, 0.0)[1 if limit == 900.0 else 0 :]):
            if tested(100 * index, 10.0 * (index + 1), success):
                return
        pytest.fail("nothing ended it")

    monkeypatch.setattr(learners, "train_contrastive", train)
    rows = list(learners.contrastive_rows("reach", False, limit))
    assert [row["seed"] for row in rows] == [0, 1, 2, 3]
    assert all(len(row["success"]) == len(row["env_steps"]) == len(row["train_seconds"]) == count for row in rows)


def test_a_method_s_rows_are_its_tests(monkeypatch):
    def train(folder, arguments, programs):
        assert arguments == ["--task", "reach", "--method", "gcsl", "--seeds", "4"]
        rows = [
            {"seed": str(seed), "success_rate": success, "env_steps": str(steps), "seconds": str(seconds)}
            for steps, seconds, success in ((100, 1.5, "0.25"), (200, 3.0, ""), (300, 4.5, "0.75"))
            for seed in range(4)
        ]
        return {"wall_seconds": {"compile": 10.0}, "commit": "c", "device": {}, "cpu_cores": 2, "versions": {}}, rows

    monkeypatch.setattr(learners, "train", train)
    rows, made_by = zip(*learners.method_rows("reach", "gcsl", False), strict=True)
    assert [(made["commit"], made["cpu_cores"]) for made in made_by] == [("c", 2)] * 4
    assert [row.pop("seed") for row in rows] == [0, 1, 2, 3]
    measured = SimpleNamespace(**rows[3])
    assert measured.what == "GCSL"
    assert (measured.env_steps, measured.train_seconds, measured.success) == ([100, 300], [11.5, 14.5], [0.25, 0.75])


def test_the_picture_shows_what_ran_on_the_same_device(tmp_path, monkeypatch):
    def row(what, seed):
        curve = {"env_steps": [100, 200], "train_seconds": [1.0, 2.0], "success": [0.0, 1.0]}
        return {"section": "learners", "task": "reach", "what": what, "seed": seed, **curve}

    drawn = []
    monkeypatch.setattr(bench, "draw_learners", lambda rows, path: drawn.append((rows, path)))
    made = [(row("HGAIL", 0), ELSEWHERE), (row("HGAIL", 0), HERE), (row("HGAIL", 1), HERE), (row("other", 0), HERE)]
    monkeypatch.setattr(bench, "measure", lambda options: iter(made))
    bench.main(["--out", str(tmp_path / "bench.json")])
    ((rows, path),) = drawn
    assert [(row["what"], row["seed"]) for row in rows] == [("HGAIL", 0), ("HGAIL", 1), ("other", 0)]
    assert path == tmp_path / "learners-reach-cpu.png"


def test_each_learner_has_a_colour_of_its_own(tmp_path):
    curve = {
        "env_steps": [100, 200],
        "train_seconds": [1.0, 2.0],
        "success": [0.0, 1.0],
        "made_by": HERE | {"cpu_cores": 2},
    }
    rows = [{"task": "reach", "what": what, "seed": seed} | curve for what in ("HGAIL", "other") for seed in (0, 1)]
    learners_figure = tmp_path / "learners.png"
    draw_learners(rows, learners_figure)
    colours = {tuple(colour) for colour in np.asarray(Image.open(learners_figure).convert("RGB")).reshape(-1, 3)}
    strong = {colour for colour in colours if max(colour) - min(colour) > 100}
    assert any(blue > red for red, _, blue in strong) and any(red > blue for red, _, blue in strong)
