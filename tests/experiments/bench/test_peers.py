"""Other projects: what is not installed is left out."""

import sys

import pytest

from experiments.bench import peers

ENVPOOL = """
from types import SimpleNamespace
__version__ = "9.9"

def make_gymnasium(name, num_envs, num_threads, seed):
    assert name == "FetchPickAndPlace-v4"
    def step(actions):
        assert actions.shape == (num_envs, 4) and actions.dtype == "float32" and abs(actions).max() <= 1.0
    space = SimpleNamespace(shape=(4,), dtype="float32")
    return SimpleNamespace(action_space=space, reset=lambda: None, step=step)
"""
"""As much of EnvPool's interface as is used."""


def test_a_peer_that_is_not_installed_is_left_out_with_one_line(monkeypatch, capsys):
    def absent_rows(task, quick):
        raise ImportError("No module named 'absent'")
        yield

    for name in ("jaxgcrl_rows", "gymnasium_rows", "envpool_rows", "stable_baselines_rows"):
        monkeypatch.setattr(peers, name, absent_rows)
    monkeypatch.setattr(peers, "rollout_rows", lambda task, quick: iter([{"what": "present"}]))
    (row,) = peers.peer_rows("reach", quick=True)
    assert (row["task"], row["what"]) == ("reach", "present")
    assert row["cpu_cores"] >= 1
    assert capsys.readouterr().out.splitlines() == ["left out: absent (No module named 'absent')"] * 4


@pytest.mark.parametrize(("rows", "module"), [(peers.envpool_rows, "envpool"), (peers.jaxgcrl_rows, "jaxgcrl")])
def test_what_cannot_be_imported_is_not_measured(monkeypatch, rows, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=module):
        next(rows("reach", True))


def test_envpool_is_timed_in_a_process_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "envpool.py").write_text(ENVPOOL)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (row,) = peers.envpool_rows("grasp", True)
    assert row["what"].startswith("EnvPool 9.9 FetchPickAndPlace-v4, ")
    assert row["env_steps_per_second"] > 0
    assert "envpool" not in sys.modules
