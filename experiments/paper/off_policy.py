"""Studies of the learner TD3: what each part of it adds, and what other methods learn by it."""

import dataclasses
from typing import Any

from experiments.paper.study import MOST_DEMONSTRATIONS, PAPER_DEMONSTRATIONS, PART_STEPS, Setting, Study
from hgail_jax.settings.methods import PAPER_SAMPLES

OFF_POLICY_FIGURE = 8
"""Number of the figure of the methods by TD3; the paper has 3 to 7."""


def _change(name: str, config: dict[str, Any] | None = None, **hyperparameters: Any) -> Setting:
    """Returns the task's default method with changes, or HGAIL with another weight of the goal test."""
    method = "hgail" if "environment_reward" in hyperparameters else None
    return Setting(name, method=method, learner="td3", config=config or {}, hyperparameters=hyperparameters)


_HER = Setting("HER", method="her", learner="td3")

# But for HER, which has no discriminator, these differ in numbers alone and are one program.
_NUMBERS = Study(
    "off-policy",
    "TD3, parts left out or changed",
    (
        _change("as it is"),
        *(_change(f"goal test × {weight:g}", environment_reward=weight) for weight in (0.25, 0.5)),
        _HER,
        *(_change(f"p_ht {p_ht:g}", p_ht=p_ht) for p_ht in (0.5, 1.0)),
        _change("BC weight 0.1", bc_weight=0.1),
        _change("solved samples × 0.3", solved_weight=0.3),
        _change("discriminator's goals any number of steps ahead", discriminator_horizon=2**30),
    ),
    curves=True,
)
_SAMPLES = Study(
    "off-policy-samples",
    "TD3, other samples of the discriminator",
    (
        _change("as it is"),
        _change("the paper's: goals achieved against goals pursued", **PAPER_SAMPLES),
        *(_change(f"{share:.0%} of the negatives shuffled", shuffled_goals=share) for share in (0.5, 0.9, 1.0)),
        *(_change(f"positives jittered by {size:g} of the tolerance", goal_jitter=size) for size in (0.0, 1.0)),
        _change("negatives under the goals pursued", negative_p_ht=0.0),
        *(_change(f"negatives × {weight:g}", negative_weight=weight) for weight in (1.0, 2.0)),
        _HER,
    ),
    curves=True,
)
_SIZES = Study(
    "off-policy-sizes",
    "TD3, other sizes and goals",
    (
        _change("as it is"),
        _change("the task's own goals to learn from", {"training_goals": False}),
        *(_change(f"{count} updates a roll-out", {"updates": count}) for count in (128, 512)),
        *(_change(f"{count} critic{'s' * (count > 1)}", {"critics": count}) for count in (1, 4)),
    ),
    curves=True,
)
_REWARDS = Study(
    "off-policy-rewards",
    "TD3 by its reward and its goals, beside HGAIL with PPO",
    (
        _HER,
        _change("no reward: the discriminator alone", environment_reward=0.0),
        _change("goal test × 0.5", environment_reward=0.5),
        dataclasses.replace(_HER, name="HER, the task's own goals to learn from", config={"training_goals": False}),
        Setting("HGAIL with PPO, no reward", learner="ppo"),
    ),
    curves=True,
)


def _method(name: str, method: str, demonstrations: int = 0, **changes: float) -> Setting:
    changes = {"environment_reward": 0.0} | changes
    return Setting(name, method=method, learner="td3", hyperparameters=changes, demonstrations=demonstrations)


_METHODS = Study(
    "off-policy-methods",
    "methods off-policy; a reward of the task in HER alone",
    (
        _method("HGAIL", "hgail"),
        _method("HGAIL-no", "hgail-no"),
        *(_method(f"GAIL-demo ({count})", "gail-demo", count) for count in (PAPER_DEMONSTRATIONS, MOST_DEMONSTRATIONS)),
        *(
            _method(f"GAIL-demo ({count}), half the negatives shuffled", "gail-demo", count, shuffled_goals=0.5)
            for count in (PAPER_DEMONSTRATIONS, MOST_DEMONSTRATIONS)
        ),
        _method("GASIL", "gasil"),
        _method("GASIL, half the negatives shuffled", "gasil", shuffled_goals=0.5),
        _HER,
        Setting("contrastive RL", learner="crl"),
    ),
    figure=OFF_POLICY_FIGURE,
)
_PPO_SAMPLES = Study(
    "ppo-samples",
    "HGAIL with PPO, other samples of the discriminator",
    tuple(
        Setting(name, hyperparameters=samples, steps=PART_STEPS)
        for name, samples in (
            ("the paper's: goals achieved against goals pursued", {}),
            ("95% of the negatives shuffled", {"shuffled_goals": 0.95}),
            ("positives jittered by 0.5 of the tolerance", {"goal_jitter": 0.5}),
            ("both", {"shuffled_goals": 0.95, "goal_jitter": 0.5}),
        )
    ),
    curves=True,
)
OFF_POLICY_STUDIES = (_NUMBERS, _SAMPLES, _SIZES, _REWARDS, _METHODS, _PPO_SAMPLES)
