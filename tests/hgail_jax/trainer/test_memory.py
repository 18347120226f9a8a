"""The estimate of a run's memory against what XLA says of the compiled program, and what is made of it."""

import jax
import pytest

from hgail_jax import Trainer, TrainOptions
from hgail_jax.cli import train as run
from hgail_jax.trainer import memory
from hgail_jax.trainer.options import plan
from tests.support import make_runs_tiny


def point(**sizes):
    return plan(TrainOptions(task="point", **sizes), "cpu")


@pytest.fixture
def one_gigabyte(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda device: 10**9)


@pytest.mark.parametrize(
    "sizes", [pytest.param({"num_envs": 512, "seeds": 1}, marks=pytest.mark.slow), {"num_envs": 256, "seeds": 3}]
)
def test_the_estimate_is_near_what_the_compiled_program_takes(monkeypatch, sizes):
    make_runs_tiny(monkeypatch)
    small = point(**sizes)
    compiled = small.program().compile().memory_analysis()
    needed = compiled.temp_size_in_bytes + compiled.argument_size_in_bytes
    assert memory.estimate_memory(small) == pytest.approx(needed, rel=0.35)


def test_what_is_too_large_is_refused_with_what_would_fit(one_gigabyte):
    with pytest.raises(
        ValueError, match=r"8 seeds of 1000000 environments would need about .* GB .* 1.0 GB are free"
    ) as told:
        Trainer(task="point", num_envs=1_000_000)
    most = int(str(told.value).split("--num-envs ")[1].split()[0])
    assert memory.estimate_memory(point(num_envs=most)) <= 1e9
    with pytest.raises(ValueError, match="would fit"):
        point(num_envs=most + 1)


def test_too_many_seeds_are_told_how_many_fit(one_gigabyte):
    with pytest.raises(ValueError, match="--seeds") as told:
        point(seeds=1_000_000)
    most = int(str(told.value).split("--seeds ")[1].split()[0])
    assert memory.estimate_memory(point(seeds=most)) <= 1e9


def test_a_refusal_is_one_line_and_writes_nothing(one_gigabyte, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        run.main(["--task", "point", "--num-envs", "1000000"])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "error", [MemoryError(), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.\nmore")]
)
def test_a_lack_of_memory_that_comes_later_is_one_line(tmp_path, monkeypatch, capsys, error):
    def refuse(self):
        raise error

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hgail_jax.trainer.loop.Program.compile", refuse)
    with pytest.raises(SystemExit) as exit_info:
        run.main(["--task", "point", "--num-envs", "4"])
    assert exit_info.value.code == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("hgail train: out of memory; ")


def test_other_errors_of_the_compiler_are_not_hidden(tmp_path, monkeypatch):
    def refuse(self):
        raise jax.errors.JaxRuntimeError("INTERNAL: a fault")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hgail_jax.trainer.loop.Program.compile", refuse)
    with pytest.raises(jax.errors.JaxRuntimeError, match="a fault"):
        run.main(["--task", "point", "--num-envs", "4"])


def test_the_host_s_free_memory_is_known():
    free = memory.free_memory(jax.devices("cpu")[0])
    assert free is not None and 2**20 < free < 2**50


class Gpu:
    platform = "gpu"

    def __init__(self, stats):
        self.memory_stats = lambda: stats


def test_a_device_s_free_memory_is_what_is_left_of_its_limit():
    assert memory.free_memory(Gpu({"bytes_limit": 100, "bytes_in_use": 30})) == 70
    assert memory.free_memory(Gpu(None)) is None
