"""What each part of the method adds on a task that the paper does not have: a study of parts left out or changed."""

from experiments.paper.study import Setting, Study

PARTS = Study(
    "parts",
    "parts left out or changed",
    tuple(
        # Half the steps: enough to tell them apart.
        Setting(name, config=config, hyperparameters=hyperparameters, task_options=options, steps=0.5)
        for name, config, hyperparameters, options in (
            ("HGAIL", {}, {}, {}),
            ("without the adversary (GCSL and the same exploration)", {}, {"ppo_weight": 0.0}, {}),
            ("without likelihood (the paper's HGAIL)", {}, {"likelihood_weight": 0.0}, {}),
            (
                "PPO on the sparse reward, same starts and goals",
                {},
                {"environment_reward": 1.0, "likelihood_weight": 0.0},
                {},
            ),
            ("trivial samples × 0.3", {}, {"trivial_weight": 0.3}, {}),
            ("trivial samples × 1", {}, {"trivial_weight": 1.0}, {}),
            ("the task's own goals to learn from", {"explore": False}, {}, {}),
            ("without pre-training", {"pretrain": False}, {}, {}),
            ("the reference's 25 numbers as observation", {}, {}, {"observation": "official"}),
        )
    ),
)
"""For tasks with an object; of the two trivial weights one is the task's own."""
