import csv
import json

import pytest

from experiments import publish
from hgail_jax.io.files import write_csv, write_json

MADE_BY = {
    "command": "hgail train",
    "commit": "c0ffee1",
    "device": {"kind": "a chip"},
    "cpu_cores": 2,
    "versions": {"jax": "1"},
}


def write_run(folder, rates, curve, method="hgail"):
    """Writes a run's folder; `curve` has success of two seeds by env steps."""
    folder.mkdir(exist_ok=True)
    mean = sum(rates) / len(rates)
    config = {
        "config": {"learner": {"name": "td3"}},
        "options": {"randomize": None, "look": "plain", "picture_kind": "depth"},
        "hyperparameters": {"environment_reward": 0.5},
        "first_seed": 8,
    }
    summary = {
        "task": "push",
        "method": method,
        "seeds": len(rates),
        "evaluation_episodes_per_seed": 100,
        "success_rate": {"mean": mean, "std": 0.0, "per_seed": rates},
        "distance_l1": {"mean": 0.01},
        "env_steps_per_seed": max(curve),
        "wall_seconds": {"train": 3.0, "total": 5.0},
        "env_steps_per_second": 10.0,
    }
    write_json(folder / "config.json", config)
    write_json(folder / "summary.json", summary | MADE_BY)
    rows = [
        {"seed": seed, "env_steps": steps, "seconds": steps / 100, "success_rate": rate}
        for steps, seeds in curve.items()
        for seed, rate in enumerate(seeds)
    ]
    write_csv(folder / "metrics.csv", rows)
    assert list(csv.DictReader((folder / "metrics.csv").open()))


@pytest.fixture
def results(tmp_path, monkeypatch):
    """An empty folder of results."""
    for name in ("RUNS", "STUDIES", "TABLE4"):
        monkeypatch.setattr(publish, name, tmp_path / f"{name}.json")
    return tmp_path


def test_a_run_becomes_a_row_and_is_replaced(results, tmp_path):
    folder, other = tmp_path / "push-td3", tmp_path / "push-td3-2"
    write_run(folder, [0.9, 1.0], {100: [0.7, 0.8], 200: [None, None], 300: [0.8, 0.9], 400: [1.0, 0.9]})
    write_run(other, [0.2, 0.4], {100: [0.1, 0.2]})
    publish.main([str(folder), str(other)])
    row, second = json.loads(publish.RUNS.read_text())
    assert (row["name"], row["learner"], row["level"], row["seeds"]) == ("push-td3", "td3", "none", [8, 9])
    assert (row["worst"], row["success_ci95"]) == (0.9, None)  # two seeds have no interval
    assert row["reached"] == {"0.80": {"env_steps": 300, "seconds": 3.0}, "0.95": {"env_steps": 400, "seconds": 4.0}}
    assert {name: row[name] for name in MADE_BY} == MADE_BY
    assert second["reached"] == {"0.80": None, "0.95": None}
    assert "look" not in row  # nothing is seen
    write_run(folder, [0.5, 0.5, 0.5], {100: [0.5, 0.5]})
    publish.main([str(folder)])
    assert [(row["name"], row["worst"]) for row in json.loads(publish.RUNS.read_text())] == [
        ("push-td3", 0.5),
        ("push-td3-2", 0.2),
    ]


def setting(name, commit, **more):
    return {
        "setting": name,
        "panel": "",
        "identity": {"method": "hgail", "seeds": [0, 1], "name": name},
        "final": {"success": [0.5, 1.0]},
        "success_ci95": None,
        "worst_seed": 0.5,
        "distance_l1": 0.1,
        "env_steps_per_seed": 20,
        "paper_success": "",
        "paper_distance_l1": "",
        "made_by": MADE_BY | {"commit": commit, "date": "today"},
        **more,
    }


def test_a_study_s_rows_replace_those_of_the_same_study_and_task(results, tmp_path):
    curves = {"env_steps": [10, 20], "success": [[0.9, 0.8], [1.0, 0.9]]}
    path = tmp_path / "table1-push.json"
    for task, commits in (("push", ("a", "b")), ("reach", ("a", "a")), ("push", ("c", "c"))):
        rows = [setting("x", commits[0], curves=curves), setting("y", commits[1])]
        write_json(path, {"study": "table1", "task": task, "settings": rows})
        publish.main([str(path)])
    content = json.loads(publish.STUDIES.read_text())
    assert [(row["task"], row["setting"], row["steps_to_95"]) for row in content["rows"]] == [
        ("reach", "x", 20),
        ("reach", "y", None),
        ("push", "x", 20),
        ("push", "y", None),
    ]
    assert [content["made_by"][row["made_by"]]["commit"] for row in content["rows"]] == ["a", "a", "c", "c"]
    assert len(content["made_by"]) == 2


def test_table_4_is_written_a_row_a_line(results, tmp_path):
    content = {"made_by": {"a": MADE_BY}, "rows": [{"robot": "x"}, {"robot": "y"}]}
    write_json(tmp_path / "TABLE4.json", content)
    publish.main([str(tmp_path / "TABLE4.json")])
    assert json.loads(publish.TABLE4.read_text()) == content
    assert publish.TABLE4.read_text().count("\n") == 6


def test_a_row_of_a_policy_that_sees_has_its_look(results, tmp_path):
    write_run(tmp_path / "push-camera", [0.9, 1.0], {100: [0.7, 0.8]}, method="camera")
    publish.main([str(tmp_path / "push-camera")])
    (row,) = json.loads(publish.RUNS.read_text())
    assert (row["look"], row["kind"]) == ("plain", "depth")


def test_what_cannot_be_published_is_said_in_a_line(results, tmp_path):
    write_json(tmp_path / "odd.json", {"rows": []})
    for path in (tmp_path / "odd.json", tmp_path / "none.json", tmp_path):
        with pytest.raises(SystemExit, match=r"^publish: .* is not a finished run's folder, .*$"):
            publish.main([str(path)])
    assert not publish.RUNS.exists()
