"""Studies that choose settings, on seeds that are never reported."""

import dataclasses
from typing import Any

from experiments.paper.study import PAPER_DEMONSTRATIONS, Setting, Study
from hgail_jax.config import REWARDS
from hgail_jax.settings.presets import AS_WRITTEN


def _change(name: str, config: dict[str, Any] | None = None, **hyperparameters: Any) -> Setting:
    return Setting(name, preset="paper", config=AS_WRITTEN | (config or {}), hyperparameters=hyperparameters, steps=5)


def _second_change(name: str, config: dict[str, Any] | None = None, **hyperparameters: Any) -> Setting:
    """Returns a change on top of the preset `paper`'s own, over the steps that it needs to learn."""
    return Setting(name, "phases 1 + 3", preset="paper", config=config or {}, hyperparameters=hyperparameters, steps=12)


# The paper has 16 + 3 phases of 64 episodes, 3,200 samples: 25 minibatches of 128 for the policy, once each, and 50 of
# 64 for the discriminator. Settings that differ in numbers alone are one program.
_OF_NUMBERS = (
    _change("as they are"),
    *(_change(f"σ {std:g}", exploration_noise=std) for std in (0.1, 0.2, 0.3, 0.5)),
    *(_change(f"policy's learning rate {rate:g}", policy_learning_rate=rate) for rate in (1e-4, 3e-4)),
    *(
        _change(f"discriminator's learning rate {rate:g}", discriminator_learning_rate=rate)
        for rate in (1e-4, 1e-3, 3e-3)
    ),
    _change("raw rewards / 50", standardize_reward=False),
    _change("raw rewards", standardize_reward=False, reward_scale=50.0),
    _change("standardised rewards, not / 50", reward_scale=50.0),
    *(_change(name, reward=REWARDS[name]) for name in ("r2", "r3")),
    _change("raw observations", standardize_observation=False),
    _change("raw advantages", standardize_advantage=False),
    _change("raw rewards and advantages", standardize_advantage=False, standardize_reward=False, reward_scale=50.0),
)
_OF_COUNTS = (
    _change("policy's learning rate shrinks to 0", {"final_learning_rate": 0.0}),
    _change("policy: 1 update of 3,200", {"minibatches": 1}),
    _change("policy: 5 updates of 640", {"minibatches": 5}),
    _change("policy: 2 × 4 updates of 800", {"epochs": 2, "minibatches": 4}),
    _change("policy: 4 × 25 updates of 128", {"epochs": 4}),
    *(_change(f"discriminator: {count} updates", {"discriminator_minibatches": count}) for count in (1, 10, 200, 500)),
    *(
        _change(f"phases {policy} + {discriminator}", {"policy_phases": policy, "discriminator_phases": discriminator})
        for policy, discriminator in ((1, 3), (3, 3), (16, 16))
    ),
    *(
        _change(f"{episodes} episodes in a phase", {"num_envs": episodes, "minibatches": minibatches})
        for episodes, minibatches in ((5, 2), (16, 6), (256, 100))  # of 125 to 133 samples each
    ),
)
_SECOND = (
    _second_change("as they are"),
    _second_change("σ 0.5", exploration_noise=0.5),
    _second_change("σ 0.3", exploration_noise=0.3),
    _second_change("policy's learning rate 0.0003", policy_learning_rate=3e-4),
    _second_change("policy's learning rate shrinks to 0", {"final_learning_rate": 0.0}),
    _second_change("σ 0.3, policy's learning rate shrinks to 0", {"final_learning_rate": 0.0}, exploration_noise=0.3),
)
_PAPER_SIZES = Study(
    "paper-sizes",
    "the paper's sizes with one change, or two",
    tuple(
        dataclasses.replace(setting, panel=panel, config=setting.config | pretrain)
        for panel, pretrain in (("with pre-training", {}), ("without pre-training", {"pretrain": False}))
        for setting in _OF_NUMBERS + _OF_COUNTS
    )
    + _SECOND,
    tuning=True,
)
_GAIL_DEMO_WEIGHT = Study(
    "gail-demo-weight",
    "weights of GAIL-demo's BC",
    tuple(
        Setting(
            f"BC × {weight:g}",
            method="gail-demo",
            hyperparameters={"bc_weight": weight},
            demonstrations=PAPER_DEMONSTRATIONS,
        )
        for weight in (1.0, 0.3, 3.0, 10.0)
    ),
    tuning=True,
)


def _grasp(episodes: int, rounds: int, hidden: int | None) -> tuple[Setting, ...]:
    """Returns settings of grasp with these sizes, one for each weight of the behaviour-cloning (BC) loss.

    Args:
      episodes: of a roll-out.
      rounds: of the training.
      hidden: width of all networks' hidden layers; None is the default.
    """
    widths = {} if hidden is None else {"policy_hidden": (hidden, hidden), "discriminator_hidden": (hidden, hidden)}
    sizes = {"num_envs": episodes, "rounds": rounds}
    panel = f"{episodes} episodes, {rounds} rounds" + (f", {hidden} wide" if hidden else "")
    return tuple(
        Setting(f"BC × {weight:g}", panel, config=sizes | widths, hyperparameters={"bc_weight": weight})
        for weight in (0.3, 1.0, 3.0)
    )


_GRASP_SIZES = Study(
    "grasp-sizes",
    "sizes of a training of grasp",
    _grasp(512, 16, 256) + _grasp(1024, 12, 256) + _grasp(1024, 16, None) + _grasp(512, 16, None),
    tuning=True,
)
TUNING_STUDIES = (_PAPER_SIZES, _GAIL_DEMO_WEIGHT, _GRASP_SIZES)
