"""The methods, those of the paper among them, as data: the few choices in which they differ."""

import dataclasses
from typing import Any

from hgail_jax.config import BEST, DEMONSTRATIONS
from hgail_jax.learners.ppo import BC_BATCH
from hgail_jax.learners.student import Student
from hgail_jax.settings.presets import Preset


@dataclasses.dataclass(frozen=True)
class Method:
    """Changes of a method to a preset; the training step is the same for all."""

    description: str
    config: dict = dataclasses.field(default_factory=dict)
    hyperparameters: dict = dataclasses.field(default_factory=dict)
    at_least: dict = dataclasses.field(default_factory=dict)
    """Counts of the config that the method raises to these."""
    without_effect: tuple[str, ...] = ()
    """Options of `hgail train` that change nothing for its policy, and are refused."""
    decides: tuple[str, ...] = ()
    """Options that the method itself decides, and that are refused."""
    learners: tuple[str, ...] = ("ppo", "td3")
    """Learners that it makes sense with."""
    with_learner: dict[str, dict] = dataclasses.field(default_factory=dict)
    """Further changes to the hyperparameters, by learner."""

    def apply(self, preset: Preset) -> Preset:
        """Returns `preset` as this method runs it.

        Raises:
          ValueError: it makes no sense with the preset's learner.
        """
        learner = preset.config.learner.name
        if learner not in self.learners:
            raise ValueError(f"this method has no learner {learner}; choose from {', '.join(self.learners)}")
        sizes = vars(preset.config) | vars(preset.config.learner)
        raised = {name: max(sizes[name], least) for name, least in self.at_least.items() if name in sizes}
        return dataclasses.replace(
            preset,
            config=preset.config.replace(**self.config, **raised),
            hyperparameters=preset.hyperparameters.replace(**self.hyperparameters | self.with_learner.get(learner, {})),
        )


PAPER_SAMPLES: dict[str, Any] = {
    "goal_jitter": 0.0,
    "shuffled_goals": 0.0,
    "negative_p_ht": 0.0,
    "negative_weight": 1.0,
}
"""Hyperparameters with which TD3's discriminator has the paper's samples: goals achieved against goals pursued."""

METHODS = {
    "hgail": Method("hindsight supplies the expert samples of a discriminator"),
    "hgail-no": Method(
        "HGAIL without hindsight: no goal is ever replaced",
        hyperparameters={"p_ht": 0.0},
        with_learner={"td3": PAPER_SAMPLES},
    ),
    "gail-demo": Method(
        "demonstrations supply the expert samples (Ho & Ermon 2016), with a BC loss (after Jena et al. 2020)",
        {"expert_source": DEMONSTRATIONS, "training_goals": False},
        {"bc_weight": 1.0},
        # off-policy with the gradient penalty of the discriminator-actor-critic
        {"bc_batch": BC_BATCH, "gradient_penalty": 10.0},
        without_effect=("p_ht", "strategy"),
        # with TD3 it is the discriminator-actor-critic (Kostrikov et al. 2019), which relabels nothing
        with_learner={"td3": {"p_ht": 0.0, "bc_weight": 0.0, "environment_reward": 0.0} | PAPER_SAMPLES},
    ),
    # As in Guo et al.'s Algorithm 1, and in the paper's comparison, the environment's reward ranks the episodes and is
    # not seen by the policy; `environment_reward` mixes it in, as they do to shape the reward of a policy gradient.
    "gasil": Method(
        "the best episodes so far supply the expert samples (Guo et al. 2018)",
        {"expert_source": BEST, "training_goals": False},
        without_effect=("p_ht", "strategy"),
        with_learner={"td3": {"p_ht": 0.0, "environment_reward": 0.0} | PAPER_SAMPLES},
    ),
    "ppo": Method(
        "PPO on the environment's sparse reward alone",
        {"pretrain": False, "discriminator_phases": 0, "bc_batch": 0, "training_goals": False},
        {"environment_reward": 1.0, "ppo_weight": 1.0},
        without_effect=("pretrain", "p_ht", "strategy", "reward", "bc_weight"),
        decides=("environment_reward",),
        learners=("ppo",),
    ),
    "gcsl": Method(
        "behaviour cloning of relabelled samples alone: the pre-training's loss, iterated (Ghosh et al. 2021)",
        {"discriminator_phases": 0},
        {"ppo_weight": 0.0, "environment_reward": 1.0},
        {"bc_batch": BC_BATCH},
        without_effect=("reward", "standardize_reward", "environment_reward"),
        learners=("ppo",),
    ),
    "her": Method(
        "hindsight experience replay: the goal test is the reward (Andrychowicz et al. 2017)",
        {"discriminator_minibatches": 0},
        {"environment_reward": 1.0},
        decides=("environment_reward",),
        learners=("td3",),
    ),
    "crl": Method(
        "contrastive RL: the critic tells which goals are achieved later; no reward (Eysenbach et al. 2022)",
        {"discriminator_minibatches": 0},
        learners=("crl",),
    ),
}
"""Methods by name. Those that relabel nothing by design learn on the goals that they are measured by; `hgail-no` is
HGAIL in all but the relabelling."""

CAMERA = Method(
    "taught by a policy that knows the positions (as DAgger, Ross et al. 2011)",
    without_effect=(
        *("method", "preset", "demos", "pretrain", "randomize", "p_ht", "strategy", "reward"),
        *("standardize_reward", "environment_reward", "bc_weight"),
    ),
    learners=(Student.name,),
)
"""The method `camera`, which `--observe camera` chooses."""


def method_of(preset: Preset) -> Method:
    """Returns the method of a preset, which may be that of a student."""
    return (METHODS | {"camera": CAMERA})[preset.method]
