"""Which seeds choose settings, and which are reported: never the same ones."""

from hgail_jax.seeds import check_seeds

REPORTED_SEEDS = range(0, 8)
"""Of the tables and figures. No setting is chosen by what comes of them."""
TUNING_SEEDS = range(1000, 1004)
"""Of the studies that settings are chosen by. Nothing that comes of them is reported as a method's result."""


def choose_seeds(tuning: bool, count: int | None = None) -> range:
    """Returns the seeds of a study: those above or, from the same start, `count` of them.

    Raises:
      ValueError: there are none, or so many that seeds for reporting are also seeds for choosing.

    >>> choose_seeds(tuning=True), choose_seeds(tuning=False, count=2)
    (range(1000, 1004), range(0, 2))

    """
    whole = TUNING_SEEDS if tuning else REPORTED_SEEDS
    if count is None:
        return whole
    check_seeds(whole.start, count)
    if not tuning and count > TUNING_SEEDS.start:
        raise ValueError(f"seeds is {count}; from {TUNING_SEEDS.start} on they are for choosing settings")
    return range(whole.start, whole.start + count)


def describe_seeds(seeds: list[int]) -> str:
    """Says of consecutive seeds what they are for.

    >>> describe_seeds([0, 1])
    'Seeds 0 to 1 are for reporting; settings are chosen on others, from 1000 on.'
    """
    these = f"Seeds {seeds[0]} to {seeds[-1]}"
    if seeds[0] >= TUNING_SEEDS.start:
        return f"{these} are for choosing settings; what is reported comes from others, from {REPORTED_SEEDS.start} on."
    return f"{these} are for reporting; settings are chosen on others, from {TUNING_SEEDS.start} on."
