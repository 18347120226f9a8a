"""What is read from the files of a run."""

from experiments.bench.whole_runs import first_success


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
