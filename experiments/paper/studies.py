"""The paper's experiments as data: the settings that each table or figure compares, and the paper's figures.

Their seeds are in `study`, the studies of TD3 in `off_policy`.
"""

import dataclasses
from typing import Any

from experiments.paper.off_policy import OFF_POLICY_STUDIES
from experiments.paper.study import MOST_DEMONSTRATIONS, PAPER_DEMONSTRATIONS, PART_STEPS, Setting, Study
from hgail_jax.config import FROZEN, REWARDS, STRATEGIES
from hgail_jax.settings.presets import AS_WRITTEN

LONGER = "table1-longer"
"""Name of the study that takes ten times the steps of table 1."""


def _both(*settings: Setting) -> tuple[Setting, ...]:
    """Returns ablations with and without pre-training, over 3 times the steps: some diverge late."""
    variants: tuple[tuple[str, dict], ...] = (("with pre-training", {}), ("without pre-training", {"pretrain": False}))
    return tuple(
        dataclasses.replace(setting, panel=panel, config=setting.config | change, steps=3)
        for panel, change in variants
        for setting in settings
    )


_VARIANTS = "variants"
_GAIL_DEMO = {"reach": (".98 ± .02", ".03 ± .01"), "grasp": (".95 ± .02", ".02 ± .003")}

_METHODS = Study(
    "table1",
    "methods",
    (
        Setting(
            f"GAIL-demo ({PAPER_DEMONSTRATIONS}), with BC",
            method="gail-demo",
            demonstrations=PAPER_DEMONSTRATIONS,
            paper=_GAIL_DEMO,
        ),
        Setting(
            "GASIL",
            method="gasil",
            paper={"reach": (".42 ± .08", ".20 ± .07"), "grasp": (".03 ± .03", ".25 ± .06")},
        ),
        Setting("PPO", method="ppo", paper={"reach": ("0", "1.70 ± .12"), "grasp": ("0", "1.53 ± .08")}),
        Setting(
            "HGAIL",
            paper={"reach": (".98 ± .02", "1.05 ± .03 (sic)"), "grasp": (".95 ± .03", ".03 ± .002")},
        ),
        Setting(
            "HGAIL-no",
            method="hgail-no",
            paper={"reach": (".01 ± .01", ".62 ± .27"), "grasp": (".02 ± .02", "1.49 ± .04")},
        ),
        Setting("GCSL", method="gcsl"),
        Setting("GAIL-demo (5), with BC", _VARIANTS, method="gail-demo", demonstrations=5),
        Setting("GAIL-demo (100), with BC", _VARIANTS, method="gail-demo", demonstrations=MOST_DEMONSTRATIONS),
        Setting(
            f"GAIL-demo ({PAPER_DEMONSTRATIONS}), no BC",
            _VARIANTS,
            method="gail-demo",
            config={"bc_batch": 0},
            demonstrations=PAPER_DEMONSTRATIONS,
            paper=_GAIL_DEMO,
        ),
        *(
            Setting(
                f"GAIL-demo ({PAPER_DEMONSTRATIONS}), BC × {weight:g}",
                _VARIANTS,
                method="gail-demo",
                hyperparameters={"bc_weight": weight},
                demonstrations=PAPER_DEMONSTRATIONS,
                paper=_GAIL_DEMO,
            )
            for weight in (3.0, 10.0)  # of the method's 1
        ),
        Setting("GASIL, ties by distance", _VARIANTS, method="gasil", hyperparameters={"ties_by_distance": True}),
        Setting("HGAIL, no pre-training", _VARIANTS, config={"pretrain": False}),
    ),
    table=1,
    figure=3,
    reference="HGAIL",
)
_LONGER = Study(
    LONGER,
    "methods, 10 times the steps",
    (
        Setting("GASIL", "10 times the steps", method="gasil", steps=10),
        Setting("PPO", "10 times the steps", method="ppo", steps=10),
    ),
    table=1,
    figure=3,
)
_CURRICULUM = Study(
    "table2",
    "curriculum",
    _both(
        Setting("curriculum", paper={"reach": (".98 ± .02", ".03 ± .01")}),
        Setting("no curriculum", config={"expert_source": FROZEN}, paper={"reach": (".49 ± .17", ".16 ± .05")}),
    ),
    table=2,
    figure=4,
)
_STRATEGIES = Study(
    "table3",
    "hindsight strategies",
    _both(
        Setting("future", paper={"reach": (".99 ± .01", ".04 ± .01")}),
        Setting(
            "final", hyperparameters={"strategy": STRATEGIES["final"]}, paper={"reach": (".31 ± .17", ".18 ± .05")}
        ),
    ),
    table=3,
    figure=5,
)
_P_HT = Study(
    "p_ht",
    "probability of relabelling",
    _both(*(Setting(f"p_ht {p_ht}", hyperparameters={"p_ht": p_ht}) for p_ht in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0))),
    figure=6,
    reference="p_ht 1.0",
)
_REWARDS = Study(
    "rewards",
    "reward forms",
    _both(*(Setting(name, hyperparameters={"reward": form}) for name, form in REWARDS.items())),
    figure=7,
)
_ABLATIONS = Study(
    "ablations",
    "all ablations",
    (
        Setting("pre-training alone", "with pre-training", config={"rounds": 0}),
        *_both(
            Setting("the paper's sizes", preset="paper", config=AS_WRITTEN),
            Setting("the paper's sizes, 1 update of the policy to 3", preset="paper"),
        ),
        *_both(Setting("HGAIL")),
        *(
            dataclasses.replace(setting, paper={})
            for study in (_CURRICULUM, _STRATEGIES, _P_HT, _REWARDS)
            for setting in study.settings
            if setting.config.get("expert_source") == FROZEN or setting.hyperparameters
        ),
    ),
    reference="HGAIL",
)
_GASIL = Study(
    "gasil",
    "GASIL with the environment's reward",
    (
        Setting("GASIL", method="gasil"),
        Setting(
            "GASIL, half of its reward the environment's", method="gasil", hyperparameters={"environment_reward": 0.5}
        ),
    ),
)


def _raw_beside(*settings: Setting) -> tuple[Setting, ...]:
    """Returns settings, and the same with rewards that are not standardised."""
    raw = {"standardize_reward": False}
    return settings + tuple(
        dataclasses.replace(setting, name=f"{setting.name}, raw", hyperparameters=setting.hyperparameters | raw)
        for setting in settings
    )


_STANDARDIZATION = Study(
    "standardization",
    "rewards standardised or raw",
    _raw_beside(
        Setting("PPO", "PPO", method="ppo"),
        Setting("PPO", "PPO, 10 times the steps", method="ppo", steps=10),
        *_both(*(Setting(name, hyperparameters={"reward": form}) for name, form in REWARDS.items())),
    ),
)


def _part(
    name: str, config: dict[str, Any] | None = None, task_options: dict[str, Any] | None = None, **hyperparameters: Any
) -> Setting:
    """Returns HGAIL with a part left out or changed, on a task with an object."""
    return Setting(
        name, config=config or {}, hyperparameters=hyperparameters, task_options=task_options or {}, steps=PART_STEPS
    )


_PARTS = Study(
    "parts",
    "parts left out or changed",
    (
        _part("HGAIL"),
        _part("without the adversary (GCSL and the same exploration)", ppo_weight=0.0),
        _part("without BC (the paper's HGAIL)", bc_weight=0.0),
        _part("PPO on the sparse reward, same starts and goals", environment_reward=1.0, bc_weight=0.0),
        _part("solved samples × 0.3", solved_weight=0.3),  # one of the two is the task's own
        _part("solved samples × 1", solved_weight=1.0),
        _part("the task's own goals to learn from", {"training_goals": False}),
        _part("without pre-training", {"pretrain": False}),
        _part("the reference's 25 numbers as observation", task_options={"observation": "official"}),
    ),
)
_REPORTED = (_METHODS, _LONGER, _CURRICULUM, _STRATEGIES, _P_HT, _REWARDS, _ABLATIONS, _GASIL, _STANDARDIZATION)
STUDIES = (*_REPORTED, _PARTS, *OFF_POLICY_STUDIES)
"""Every study, in order of training. The paper has table 1 alone of grasp."""
_TABLE_1_ALONE = ("grasp",)  # tasks of which the paper has no ablations
_NOT_IN_THE_PAPER = ("push", "pick-and-place", "slide")


def studies_of(task: str) -> tuple[Study, ...]:
    """Returns the studies that are reported of a task."""
    if task in _NOT_IN_THE_PAPER:
        return (_PARTS,)
    return tuple(study for study in _REPORTED if task not in _TABLE_1_ALONE or study.table == 1)


SWEEP = tuple(
    Setting(f"{name}, p_ht {p_ht}, {form}", hyperparameters={"strategy": number, "p_ht": p_ht, "reward": REWARDS[form]})
    for name, number in STRATEGIES.items()
    for p_ht in (0.2, 0.6, 1.0)
    for form in ("r1", "r2", "r3")
)
"""Settings with the same shapes and counts, timed as one program against one after another."""
