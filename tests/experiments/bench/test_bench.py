"""The benchmark's bookkeeping, and, slowly, that each of its sections runs."""

import json
import os
import subprocess
import sys

import pytest

from experiments.bench import __main__ as bench
from experiments.bench import shares
from experiments.bench.__main__ import Results, table
from experiments.bench.speed import Size
from experiments.bench.whole_runs import first_success
from hgail_jax.trainer import run_folder

HERE = {"device": {"platform": "cpu", "kind": "a", "count": 1}}
ELSEWHERE = {"device": {"platform": "gpu", "kind": "b", "count": 1}}


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


def test_a_file_of_something_else_is_left_as_it_is(tmp_path, capsys):
    path = tmp_path / "bench.json"
    path.write_text("[1, 2]")
    with pytest.raises(SystemExit) as stop:
        bench.main(["--section", "physics", "--out", str(path)])
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert path.read_text() == "[1, 2]"


def test_quick_rows_go_to_a_file_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "measure", lambda options: iter([({"section": "speed", "num_envs": 4}, HERE)]))
    bench.main(["--quick"])
    (row,) = json.loads((tmp_path / "runs" / "quick" / "bench.json").read_text())["rows"]
    assert (row["num_envs"], row["quick"]) == (4, True)


def test_what_made_a_row_has_the_commit_of_the_checkout():
    found = subprocess.run(
        ["git", "-C", os.path.dirname(__file__), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    commit = run_folder.provenance()["commit"]
    assert commit is None if found.returncode else found.stdout.startswith(commit.removesuffix("-dirty"))


def test_a_run_that_refuses_its_options_says_so_alone(tmp_path, capfd):
    path = tmp_path / "bench.json"
    with pytest.raises(SystemExit) as stop:
        bench.main(["--section", "compile", "--run=--seeds=0", "--out", str(path)])
    assert stop.value.code == 2
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("run.py: seeds is 0")
    assert not path.exists()


def test_a_table_has_a_column_for_each_row_and_gaps_where_one_lacks_a_quantity():
    text = table([{"num_envs": 64, "rate": 1234.5}, {"num_envs": 128, "share": 0.125}])
    assert [line.split() for line in text.splitlines()] == [
        ["num_envs", "64", "128"],
        ["rate", "1,230"],
        ["share", "0.125"],
    ]


def test_shares_add_up_to_one_and_find_what_was_put_in():
    """A round of four PPO phases and one of the discriminator, made of parts that are known."""
    size = Size("grasp", "jax", 4, 8, quick=True)
    raw, policy, relabel, ppo, discriminator = 1.0, 0.25, 0.125, 0.5, 2.0
    rollout = raw + policy
    found = shares.shares(
        size,
        {
            "raw_env_steps_per_second": size.env_steps / raw,
            "rollout_env_steps_per_second": size.env_steps / rollout,
            "relabel_seconds": relabel,
            "ppo_phase_seconds": rollout + relabel + ppo,
            "discriminator_phase_seconds": rollout + relabel + discriminator,
        },
    )
    parts = {
        "physics": 5 * raw,
        "policy_and_bookkeeping": 5 * policy,
        "relabelling": 5 * relabel,
        "ppo": 4 * ppo,
        "discriminator": discriminator,
    }
    assert found == pytest.approx({f"share_{name}": part / sum(parts.values()) for name, part in parts.items()})


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "section",
    [["physics", "rollout", "train", "shares"], ["seeds"], ["devices"], ["compile"], ["time-to-success"], ["peers"]],
)
def test_every_section_runs(tmp_path, section):
    path = tmp_path / "bench.json"
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
    flags += " --xla_force_host_platform_device_count=2" if section == ["devices"] else ""
    command = [sys.executable, bench.__file__, "--quick", "--section", *section, "--out", path]
    subprocess.run(command, check=True, env=os.environ | {"XLA_FLAGS": flags}, timeout=900)
    found = json.loads(path.read_text())["rows"]
    assert found
    assert all(row["made_by"]["command"] and row["quick"] for row in found)
