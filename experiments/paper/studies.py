"""The paper's experiments as data: which settings a table or figure compares, and what the paper found."""

import dataclasses
import json
from collections.abc import Callable
from hashlib import sha256
from typing import Any

import numpy as np

import envs
from envs.fetch.arm import FetchEnv, resolve_impl
from experiments.paper.sizes import Sizes
from hgail_jax.config import FROZEN, REWARDS, STRATEGIES, Config, Hyperparameters
from hgail_jax.methods import METHODS
from hgail_jax.train import EVALUATE, SKIP, env_steps, schedule

PAPER_DEMONSTRATIONS = 20
MOST_DEMONSTRATIONS = 100
FEW_ROUNDS = 100
"""Up to so many rounds a setting is evaluated in every one of them."""
LONGER = "table1-longer"
"""Name of the study that takes ten times the steps of table 1."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One line of a figure and row of a table."""

    name: str
    panel: str = ""
    """The row of a figure that the line is in."""
    method: str = "hgail"
    config: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Changes to the method's config."""
    hyperparameters: dict[str, Any] = dataclasses.field(default_factory=dict)
    steps: int = 1
    """Environment steps, as a multiple of those that HGAIL takes by default."""
    preset: str = "parallel"
    demonstrations: int = 0
    paper: dict[str, tuple[str, str]] = dataclasses.field(default_factory=dict)
    """By task, the paper's success rate and L1 distance (m)."""


@dataclasses.dataclass(frozen=True)
class Study:
    """What one training serves: a table, a figure, or both."""

    name: str
    """Of its files: `<name>-<task>.csv` and so on."""
    title: str
    settings: tuple[Setting, ...]
    table: int | None = None
    """The paper's number; more than one study may belong to it."""
    figure: int | None = None
    """The paper's number."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """A setting worked out for a task and a platform: all that decides what is computed."""

    task: str
    setting: Setting
    config: Config
    hyperparameters: Hyperparameters
    seeds: int
    substeps: int
    evaluation_episodes: int
    demonstrations_sha256: str | None

    def identity(self) -> dict:
        """Returns, as JSON has it, what another computation of the same results shares with this one."""
        fetch = issubclass(envs.find_class(self.task), FetchEnv)
        identity = {
            "task": self.task,
            "method": self.setting.method,
            "seeds": self.seeds,
            "evaluation_episodes": self.evaluation_episodes,
            "physics": {"impl": resolve_impl("auto"), "substeps": self.substeps} if fetch else None,
            "demonstrations": self.demonstrations_sha256,
            "config": dataclasses.asdict(self.config),
            "hyperparameters": {name: np.asarray(value).tolist() for name, value in vars(self.hyperparameters).items()},
        }
        return json.loads(json.dumps(identity))

    def phases(self) -> np.ndarray:
        """Returns the schedule; a setting of k times the steps and many rounds is evaluated in every k-th and the last.

        An evaluation costs as much as a roll-out to learn from, and changes nothing in the training. Many rounds are
        more than `FEW_ROUNDS`.
        """
        rows = schedule(self.config)
        if len(rows) > FEW_ROUNDS:
            rows[np.arange(len(rows)) % self.setting.steps > 0, -1] = SKIP
            rows[-1, -1] = EVALUATE
        return rows

    def key(self) -> str:
        """Returns a hash of the identity."""
        return hash_json(self.identity())


def hash_json(content: Any) -> str:
    """Returns the first 16 hexadecimal digits of the SHA-256 of what JSON makes of `content`."""
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def work_out(
    task: str, setting: Setting, sizes_of: Callable[[str], Sizes], seeds: int, demonstrations_sha256: str | None = None
) -> Trial:
    """Returns a setting as it is trained.

    It takes `setting.steps` times the environment steps that HGAIL takes by default, to the nearest whole round.

    Args:
      task: the task's name.
      setting: what to work out.
      sizes_of: from a preset's name to its sizes on the task.
      seeds: how many.
      demonstrations_sha256: what the demonstrations are, where the setting has any.

    """
    env, sizes = envs.find_class(task), sizes_of("parallel")
    base = METHODS[setting.method].apply(sizes_of(setting.preset).preset)
    config = dataclasses.replace(base.config, **setting.config)
    if "rounds" not in setting.config:
        wanted = setting.steps * _steps(env, sizes.preset.config)
        before = _steps(env, dataclasses.replace(config, rounds=0))
        each = _steps(env, dataclasses.replace(config, rounds=1)) - before
        config = dataclasses.replace(config, rounds=max(round((wanted - before) / each), 1))
    return Trial(
        task=task,
        setting=setting,
        config=config,
        hyperparameters=base.hyperparameters.replace(**setting.hyperparameters).validate(),
        seeds=seeds,
        substeps=sizes.substeps,
        evaluation_episodes=sizes.evaluation_episodes,
        demonstrations_sha256=demonstrations_sha256,
    )


def _steps(env: Any, config: Config) -> int:
    return int(env_steps(env, config, schedule(config)).sum())


def _both(*settings: Setting) -> tuple[Setting, ...]:
    """Returns ablations with and without pre-training, over more rounds than it takes to learn: some diverge late."""
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
            f"GAIL-demo ({PAPER_DEMONSTRATIONS}), with likelihood",
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
        Setting("GAIL-demo (5), with likelihood", _VARIANTS, method="gail-demo", demonstrations=5),
        Setting("GAIL-demo (100), with likelihood", _VARIANTS, method="gail-demo", demonstrations=MOST_DEMONSTRATIONS),
        Setting(
            f"GAIL-demo ({PAPER_DEMONSTRATIONS}), no likelihood",
            _VARIANTS,
            method="gail-demo",
            config={"likelihood_batch": 0},
            demonstrations=PAPER_DEMONSTRATIONS,
            paper=_GAIL_DEMO,
        ),
        *(
            Setting(
                f"GAIL-demo ({PAPER_DEMONSTRATIONS}), likelihood × {weight:g}",
                _VARIANTS,
                method="gail-demo",
                hyperparameters={"likelihood_weight": weight},
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
_SHARES = Study(
    "p_ht",
    "probability of relabelling",
    _both(*(Setting(f"p_ht {share}", hyperparameters={"p_ht": share}) for share in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0))),
    figure=6,
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
        *_both(Setting("the paper's sizes", preset="paper")),
        *_both(Setting("HGAIL")),
        *(
            dataclasses.replace(setting, paper={})
            for study in (_CURRICULUM, _STRATEGIES, _SHARES, _REWARDS)
            for setting in study.settings
            if setting.config.get("expert_source") == FROZEN or setting.hyperparameters
        ),
    ),
)
STUDIES = (_METHODS, _LONGER, _CURRICULUM, _STRATEGIES, _SHARES, _REWARDS, _ABLATIONS)
"""Every study, in the order in which they are trained. Of grasp the paper has table 1 alone."""
FIGURES = {study.figure: study.title for study in reversed(STUDIES) if study.figure is not None}
"""Titles by the paper's number."""

SWEEP = tuple(
    Setting(
        f"{name}, p_ht {share}, {form}", hyperparameters={"strategy": number, "p_ht": share, "reward": REWARDS[form]}
    )
    for name, number in STRATEGIES.items()
    for share in (0.2, 0.6, 1.0)
    for form in ("r1", "r2", "r3")
)
"""Settings that share all shapes and counts: what is timed as one program against one after another."""
