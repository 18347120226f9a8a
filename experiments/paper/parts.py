"""What each part of the method adds on a task with an object, of which the paper has no ablations: a study as data."""

from typing import Any

from experiments.paper.study import Setting, Study

_STEPS = {"pick-and-place": 1 / 2, "push": 1 / 3, "slide": 1 / 5}  # of their own: 8 to 10 million


def _part(
    name: str, config: dict[str, Any] | None = None, task_options: dict[str, Any] | None = None, **hyperparameters: Any
) -> Setting:
    return Setting(
        name, config=config or {}, hyperparameters=hyperparameters, task_options=task_options or {}, steps=_STEPS
    )


PARTS = Study(
    "parts",
    "parts left out or changed",
    (
        _part("HGAIL"),
        _part("without the adversary (GCSL and the same exploration)", ppo_weight=0.0),
        _part("without likelihood (the paper's HGAIL)", bc_weight=0.0),
        _part("PPO on the sparse reward, same starts and goals", environment_reward=1.0, bc_weight=0.0),
        _part("trivial samples × 0.3", solved_weight=0.3),
        _part("trivial samples × 1", solved_weight=1.0),
        _part("the task's own goals to learn from", {"training_goals": False}),
        _part("without pre-training", {"pretrain": False}),
        _part("the reference's 25 numbers as observation", task_options={"observation": "official"}),
    ),
)
"""Of the two trivial weights one is the task's own."""
