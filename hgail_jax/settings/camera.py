"""Default settings of a policy that sees pictures."""

from typing import Any

from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners.student import Student
from hgail_jax.settings.methods import Method
from hgail_jax.settings.presets import OBJECT_SUBSTEPS, Preset

CAMERA = Method(
    "taught by a policy that knows the positions (as DAgger, Ross et al. 2011)",
    without_effect=(
        *("method", "learner", "preset", "demos", "pretrain", "randomize", "p_ht", "strategy", "reward"),
        *("standardize_reward", "environment_reward", "bc_weight"),
    ),
    learners=(Student.name,),
)
"""The method `camera`, which `--observe camera` chooses."""

# Roll-outs of 512 episodes: a trial had push at .98 after 40 rounds, pick and place at 1.00 after 90, and a stack at
# 1.00 after 100.
_ROUNDS = {"reach": 20, "grasp": 40, "push": 40, "slide": 80, "pick-and-place": 80, "stack": 100, "tower": 120}
_SIZES: dict[str, dict[str, Any]] = {
    "gpu": {"num_envs": 512},
    # a picture takes a CPU a hundredth of a second: enough to try it out, not to solve a task
    "cpu": {"num_envs": 16},
}


def camera_preset(task: str, platform: str) -> Preset:
    """Returns the settings of a task's student on a platform, `"cpu"` or `"gpu"`."""
    config = Config(
        Student(),
        rounds=_ROUNDS.get(task, max(_ROUNDS.values())),
        training_goals=False,
        discriminator_minibatches=0,
        policy_hidden=(256, 256),
        **_SIZES[platform],
    )
    hyperparameters = Hyperparameters(exploration_noise=0.1, policy_learning_rate=1e-3, environment_reward=1.0)
    return Preset(config, hyperparameters, "camera", OBJECT_SUBSTEPS, evaluate_every=5)
