"""Writes the table of the paper's claims, as Markdown."""

from docs._generate.results import count, fixed, halfway, off, reached, transfer, trial
from docs._generate.tables import markdown

_UNTAUGHT = "without pre-training"
_HALFWAY = f"after {count(307_200)} steps"


def claims() -> str:
    """Claims of the paper, the figures measured here, and whether these confirm them."""
    rows = [*_methods(), *_hindsight(), *_settings(), _transfer()]
    return markdown(["the paper finds", "here", "confirmed?"], rows)


def _methods() -> list[list[str]]:
    return [
        [
            f"HGAIL solves reach ({_paper('reach', 'HGAIL')}) and grasp ({_paper('grasp', 'HGAIL')})",
            _on_both("table1", "HGAIL"),
            "yes; grasp with [two additions](grasp.md#two-additions)",
        ],
        ["without hindsight it learns nothing", _on_both("table1", "HGAIL-no"), "yes"],
        [
            "GAIL with 20 demonstrations does as well",
            f"{_on_both('table1', 'GAIL-demo (20), no likelihood')};"
            f" with likelihood {_on_both('table1', 'GAIL-demo (20), with likelihood')},"
            f" with three times its weight {_on_both('table1', 'GAIL-demo (20), likelihood × 3')}",
            "only with likelihood",
        ],
        [
            f"GASIL has {_paper('reach', 'GASIL')} and {_paper('grasp', 'GASIL')}",
            f"{_on_both('table1', 'GASIL')}; with ten times the steps {_on_both('table1-longer', 'GASIL')}",
            "no: on reach it learns less, on grasp more, and seeds differ widely",
        ],
        [
            "PPO on the sparse reward has 0 and 0",
            f"{_on_both('table1', 'PPO')}; with ten times the steps {_on_both('table1-longer', 'PPO')}",
            "no; yes on reach with [raw rewards](reach.md#what-else-to-read-from-the-tables)",
        ],
    ]


def _hindsight() -> list[list[str]]:
    with_it, without_it = (trial("table2-reach", each, _UNTAUGHT) for each in ("curriculum", "no curriculum"))
    future, final = (trial("table3-reach", each, _UNTAUGHT) for each in ("future", "final"))
    return [
        [
            f"the curriculum matters: {with_it['paper_success']} with it, {without_it['paper_success']} without",
            _with_distance("table2-reach", "curriculum", "no curriculum"),
            "direction yes, size no",
        ],
        [
            f'"future" has {future["paper_success"]}, "final" {final["paper_success"]} and diverges',
            f"{_with_distance('table3-reach', 'future', 'final')}; nothing diverges",
            "direction yes, size no",
        ],
        [
            "a larger p_ht is better",
            f"{_HALFWAY} {halfway('p_ht-reach', 'p_ht 0.2')} for 0.2, {halfway('p_ht-reach', 'p_ht 1.0')} for 1;"
            f" in the end {reached('p_ht-reach', 'p_ht 0.2', _UNTAUGHT)}"
            f" and {reached('p_ht-reach', 'p_ht 1.0', _UNTAUGHT)}; 0 learns nothing",
            "yes, as to speed",
        ],
    ]


def _settings() -> list[list[str]]:
    r1, r2, r3 = (halfway("rewards-reach", each) for each in ("r1", "r2", "r3"))
    at_least = reached("rewards-reach", "r3", _UNTAUGHT)
    as_written = reached("ablations-reach", "the paper's sizes", "with pre-training")
    one_update = reached("ablations-reach", "the paper's sizes, 1 update of the policy to 3", "with pre-training")
    return [
        [
            "r1 learns fastest, r2 is worst",
            f"{_HALFWAY} r3 has {r3}, r1 {r1}, r2 {r2}; in the end at least {at_least}",
            "r2 is slowest, r1 is not fastest",
        ],
        [
            "its sizes and schedule",
            f"{as_written} on reach; with one update of the policy to three of the discriminator {one_update}",
            "no: as we read them they do not work, but [one change](reach.md#the-papers-sizes) is enough",
        ],
    ]


def _transfer() -> list[str]:
    reach, grasp = (fixed(transfer("UR5e", task, period=160)["success_rate"], 3) for task in ("reach", "grasp"))
    best = fixed(transfer("UR5e", "grasp", period=160, policy="other arms")["success_rate"], 3)
    return [
        "a policy moves to a real UR5: 0.95 ± 0.03 reaching, 0.93 ± 0.04 picking",  # of its table 4
        f"{reach} and {grasp} on a simulated UR5e",
        f"reaching as it is, picking by policies that were trained for other arms, {best}: [Transfer](transfer.md)",
    ]


def _paper(task: str, setting: str) -> str:
    return trial(f"table1-{task}", setting)["paper_success"]


def _on_both(table: str, setting: str) -> str:
    return f"{reached(f'{table}-reach', setting)} and {reached(f'{table}-grasp', setting)}"


def _with_distance(table: str, first: str, second: str) -> str:
    rates = " and ".join(reached(table, each, _UNTAUGHT) for each in (first, second))
    return f"{rates}; L1 distance {' and '.join(off(table, each, _UNTAUGHT) for each in (first, second))}"
