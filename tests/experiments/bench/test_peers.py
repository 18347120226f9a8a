"""Other projects: what is not installed is left out."""

import sys
from types import SimpleNamespace

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
    def absent_rows(*arguments):
        raise ImportError("No module named 'absent'")
        yield

    for name in ("jaxgcrl_rows", "own_rows", "gymnasium_rows", "envpool_rows", "stable_baselines_rows"):
        monkeypatch.setattr(peers, name, absent_rows)
    monkeypatch.setattr(peers, "rollout_rows", lambda task, quick: iter([{"what": "present"}]))
    (row,) = peers.peer_rows("reach", quick=True, time_limit=1.0)
    assert (row["task"], row["what"]) == ("reach", "present")
    assert row["cpu_cores"] >= 1
    absent = ("jaxgcrl", "ours", "gymnasium-robotics", "envpool", "stable-baselines3")
    expected = [f"left out: {name} (No module named 'absent')" for name in absent]
    assert capsys.readouterr().out.splitlines() == expected


def test_ours_is_stepped_beside_the_peers_on_both_engines_of_a_cpu(monkeypatch):
    monkeypatch.setattr(peers, "raw_rate", lambda workload: workload.env)
    rows = list(peers.own_rows("reach", True))
    assert [(row["what"], row["substeps"]) for row in rows] == [
        ("hgail_jax, C MuJoCo", 20),
        ("hgail_jax, C MuJoCo", 4),
        ("hgail_jax, MJX-JAX", 20),
    ]
    stepped = [row["env_steps_per_second"] for row in rows]
    assert [(env.impl, env.substeps) for env in stepped] == [("c", 20), ("c", 4), ("jax", 20)]


class Failing:
    """An environment without success, in episodes of one step."""

    def reset(self, seed):
        return None, {}

    def step(self, action):
        return None, 0.0, False, True, {"is_success": 0.0}


class Still:
    """A learner that learns nothing, as far as it is called."""

    def __init__(self, *arguments, **options):
        self.num_timesteps = 0

    def learn(self, steps, reset_num_timesteps):
        self.num_timesteps += steps

    def predict(self, observation, deterministic):
        return None, None


def test_a_test_ends_where_success_is_out_of_reach():
    seeds = []
    env = Failing()
    env.reset = lambda seed: seeds.append(seed) or (None, {})
    assert peers._evaluate(Still(), env, 100) == 0.0
    assert len(seeds) == 3


def test_a_learner_without_success_ends_at_its_time_limit(monkeypatch):
    sb3 = SimpleNamespace(SAC=Still, HerReplayBuffer=None, __version__="9.9")
    monkeypatch.setitem(sys.modules, "stable_baselines3", sb3)
    monkeypatch.setattr(peers, "make_reference", lambda name: Failing())
    clock = iter(range(1_000_000))
    monkeypatch.setattr(peers.time, "perf_counter", lambda: next(clock))
    (row,) = peers.stable_baselines_rows("reach", False, 10.0)
    assert row["success"] == 0.0
    assert row["env_steps"] == 3000  # each thousand reads the clock three times


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
