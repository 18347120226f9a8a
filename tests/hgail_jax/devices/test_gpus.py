import pytest

from hgail_jax.devices import gpus


@pytest.fixture
def driver(tmp_path, monkeypatch):
    """A machine of two GPUs, as its nvidia-smi describes it."""
    tool = tmp_path / "nvidia-smi"
    tool.write_text('#!/bin/sh\ncase "$1" in *index*) echo 0; echo 1;; *driver*) echo 580.1; echo 580.1;; esac\n')
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)


def test_the_gpus_are_those_that_a_program_may_use(driver, monkeypatch):
    assert gpus.visible_gpus() == ["0", "1"]
    assert gpus.driver_version() == "580.1"
    for chosen, expected in (("1", ["1"]), ("GPU-8a,GPU-9b", ["GPU-8a", "GPU-9b"]), ("", [])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", chosen)
        assert gpus.visible_gpus() == expected


def test_without_a_driver_there_is_none(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert gpus.visible_gpus() == []
    assert gpus.driver_version() is None
