"""Training by several processes."""

import csv
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from hgail_jax.cli import train
from tests.hgail_jax.trainer.test_checkpoint import saved_in
from tests.support import SOURCES, TINY_RUN, free_port, make_runs_tiny

SIZES = ["--seeds", "1", "--num-envs", "4"]

JOB = 4096 * 7 + os.getpid() % 4096
"""A Slurm job's number, from which JAX derives the port; another one in another process."""


def start(folder, *arguments, task="point", rounds=1, variables=None):
    command = [sys.executable, "-c", TINY_RUN, *SIZES, "--task", task, "--rounds", str(rounds)]
    command += [*(() if "--resume" in arguments else ("--out", str(folder))), *arguments]
    quickly = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    environment = os.environ | {"PYTHONPATH": SOURCES, "XLA_FLAGS": quickly} | (variables or {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment, cwd=folder.parent, **pipes)


def start_pair(folder, *arguments, **options):
    coordinator = ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    return [start(folder, *coordinator, "--process-id", str(process), *arguments, **options) for process in range(2)]


def slurm(process):
    """The variables that Slurm sets in a process of a job of two, as its documentation lists them."""
    return {
        "SLURM_JOB_ID": str(JOB),
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "2",
        "SLURM_PROCID": str(process),
        "SLURM_LOCALID": str(process),
    }


def wait_for_rounds(folder, count):
    end = time.monotonic() + 300
    while not (folder / "metrics.csv").exists() or len(rows(folder)) < count:
        assert time.monotonic() < end
        time.sleep(0.05)


def rows(folder):
    with (folder / "metrics.csv").open() as file:
        return [[float(cell or 0) for name, cell in row.items() if name != "seconds"] for row in csv.DictReader(file)]


PAIR = """
import jax, os, sys
process = int(os.fork() == 0)
sys.argv = ["hgail", *{words}, "--process-id", str(process)]
exec({script!r})
jax.distributed.shutdown()  # for which each waits for the other
if not process:
    sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""
"""A script of two processes, of which the first ends as the other did."""


@pytest.mark.parametrize(
    ("method", "nearly"),
    [
        (("--method", "ppo"), {"rtol": 1e-3, "atol": 1e-4}),
        pytest.param(("--method", "hgail", "--learner", "ppo"), {"rtol": 1e-3, "atol": 1e-4}, marks=pytest.mark.slow),
        # many gradient steps enlarge a difference in rounding: other flags of the compiler change as much
        pytest.param(("--method", "hgail", "--learner", "td3"), {"rtol": 1e-2, "atol": 1e-2}, marks=pytest.mark.slow),
    ],
)
def test_two_processes_train_as_one_does_and_the_first_writes(tmp_path, monkeypatch, method, nearly, forks):
    """The environments of one seed are split between them, so they exchange every trajectory."""
    options = ["--task", "point", *method, *SIZES, "--rounds", "1"]
    together = ["--out", str(tmp_path / "pair"), "--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    pair = forks.run(PAIR.format(words=options + together, script=TINY_RUN))
    assert pair.returncode == 0, pair.stderr
    assert pair.stdout.count("success") == 1
    make_runs_tiny(monkeypatch)
    train.main([*options, "--out", str(tmp_path / "single")])
    assert {path.name for path in tmp_path.iterdir()} == {"pair", "single"}
    np.testing.assert_allclose(rows(tmp_path / "pair"), rows(tmp_path / "single"), **nearly)
    pair, single = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("pair", "single"))
    np.testing.assert_allclose(pair["distance_l1"]["mean"], single["distance_l1"]["mean"], **nearly)
    assert saved_in(tmp_path / "pair") == [1, 2]


@pytest.mark.slow
def test_two_processes_train_reach_in_c_mujoco_as_one_does(tmp_path):
    """Each process calls the engine for its own part of the environments."""
    options = {"task": "reach", "rounds": 2}
    pair = start_pair(tmp_path / "pair", **options)
    assert [(process.communicate(timeout=600)[1][-500:], process.returncode)[1] for process in pair] == [0, 0]
    single = start(tmp_path / "single", **options)
    single.communicate(timeout=300)
    said = json.loads((tmp_path / "pair" / "config.json").read_text())
    assert said["physics"]["impl"] == "c"
    np.testing.assert_allclose(rows(tmp_path / "pair"), rows(tmp_path / "single"), rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_where_a_process_of_slurm_s_is_killed_the_other_ends_and_the_run_continues_alone(tmp_path, killed):
    folder, rounds, heartbeat = tmp_path / "run", 30, 10
    options = ["--distributed", "auto", "--heartbeat-timeout", str(heartbeat)]
    pair = [start(folder, *options, rounds=rounds, variables=slurm(process)) for process in range(2)]
    wait_for_rounds(folder, 5)
    pair[killed].kill()
    error = pair[1 - killed].communicate(timeout=300)[1].decode()
    assert pair[1 - killed].returncode != 0
    *_, last = error.replace("\r", "\n").strip().splitlines()  # after those of JAX's own service
    assert last.startswith("hgail train: ") and "--resume" in last, error
    assert "Traceback" not in error
    alone = start(folder, "--resume", str(folder), rounds=rounds)
    output = alone.communicate(timeout=300)
    assert alone.returncode == 0, output
    assert len(rows(folder)) == rounds + 1
    assert (folder / "summary.json").exists()


def test_without_a_cluster_auto_says_so(forks):
    for some in ({}, {"SLURM_JOB_ID": "1"}, {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost"}):
        script = "from hgail_jax.cli.train import main; main(['--task', 'point', '--distributed', 'auto'])"
        ended = forks.run(script, some)
        last = ended.stderr.splitlines()[-1]
        assert ended.returncode == 2
        assert "--distributed auto finds no processes that Slurm, Open MPI or Kubernetes started, or not all" in last
        assert not list(ended.folder.iterdir())
