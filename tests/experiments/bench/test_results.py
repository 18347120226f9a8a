"""The file of measurements, and how rows are printed."""

import json
import sys

import pytest

from experiments.bench import whole_runs
from experiments.bench.results import Results, table
from experiments.bench.whole_runs import first_success, train
from tests.support import ELSEWHERE, HERE


def rows(path):
    return [(row["num_envs"], row["speed"]) for row in json.loads(path.read_text())["rows"]]


def test_a_row_takes_the_place_of_its_like_and_of_no_other(tmp_path):
    path = tmp_path / "bench.json"
    results = Results(path)
    results.add({"section": "speed", "num_envs": 1, "speed": 10.0}, HERE)
    results.add({"section": "speed", "num_envs": 2, "speed": 20.0}, HERE)
    results.add({"section": "speed", "num_envs": 1, "speed": 30.0}, ELSEWHERE)
    again = Results(path)
    again.add({"section": "speed", "num_envs": 1, "speed": 40.0}, HERE)
    assert rows(path) == [(2, 20.0), (1, 30.0), (1, 40.0)]
    assert [row["speed"] for row in again.added] == [40.0]
    again.add({"section": "speed", "num_envs": 2, "options": "--seeds=1", "speed": 50.0}, HERE)
    assert rows(path) == [(2, 20.0), (1, 30.0), (1, 40.0), (2, 50.0)]


def test_a_file_of_something_else_is_refused_and_left_as_it_is(tmp_path):
    path = tmp_path / "bench.json"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match="no file of measurements"):
        Results(path)
    assert path.read_text() == "[1, 2]"


def test_a_table_has_a_column_for_each_row_and_gaps_where_one_lacks_a_quantity():
    text = table([{"num_envs": 64, "rate": 1234.5}, {"num_envs": 128, "share": 0.125}])
    assert [line.split() for line in text.splitlines()] == [
        ["num_envs", "64", "128"],
        ["rate", "1,230"],
        ["share", "0.125"],
    ]


def test_success_counts_from_the_round_in_which_every_seed_has_it():
    def row(index, success):
        return {
            "round": str(index),
            "seconds": str(2.5 * index),
            "env_steps": str(100 * index),
            "success_rate": success,
        }

    measured = [row(0, ""), row(0, "1.0"), row(1, "0.99"), row(1, "0.97"), row(2, "0.98"), row(2, "1.0")]
    assert first_success(measured, 0.98) == (5.0, 200)
    assert first_success(measured, 0.999) == (None, None)


def test_a_run_finds_only_the_programs_that_it_is_given(tmp_path, monkeypatch):
    program = (
        "import json, os, pathlib, sys; folder = pathlib.Path(sys.argv[-1]); (folder / 'metrics.csv').touch();"
        "(folder / 'summary.json').write_text(json.dumps(dict(os.environ)))"
    )
    monkeypatch.setattr(whole_runs, "_TRAIN", (sys.executable, "-c", program))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "the user's")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    environment, _ = train(tmp_path, [], tmp_path / "programs")
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "programs")
    assert environment["WARP_CACHE_PATH"] == str(tmp_path / "cache" / "warp")
