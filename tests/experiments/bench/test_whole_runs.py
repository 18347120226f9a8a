"""What is read from the files of a run, and where it finds programs."""

import json

from experiments.bench.whole_runs import first_success, train


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
    def run(command, env, **_):
        (tmp_path / "summary.json").write_text(json.dumps(env))
        (tmp_path / "metrics.csv").write_text("")

    monkeypatch.setattr("subprocess.run", run)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "the user's")
    monkeypatch.setenv("XDG_CACHE_HOME", "/home/user/.cache")
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    environment, _ = train(tmp_path, [], tmp_path / "programs")
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "programs")
    assert environment["WARP_CACHE_PATH"] == "/home/user/.cache/warp"
