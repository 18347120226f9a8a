"""The methods of the paper, as the few choices in which they differ."""

import dataclasses

from hgail_jax.config import Preset


@dataclasses.dataclass(frozen=True)
class Method:
    """What a method changes in a preset; the training step is the same for all."""

    description: str
    config: dict
    hyperparameters: dict

    def apply(self, preset: Preset) -> Preset:
        """Returns `preset` as this method runs it."""
        return Preset(
            dataclasses.replace(preset.config, **self.config),
            preset.hyperparameters.replace(**self.hyperparameters),
        )


METHODS = {
    "hgail": Method("hindsight supplies the expert samples of a discriminator", {}, {}),
    "hgail-no": Method("HGAIL without hindsight: no goal is ever replaced", {}, {"p_ht": 0.0}),
    "ppo": Method(
        "PPO on the environment's sparse reward alone",
        {"pretrain": False, "discriminator_phases": 0},
        {"environment_reward": 1.0},
    ),
}
"""Methods by name."""
