"""Policies of this package as policies of LeRobot: folders for `--policy.path`, of the type `hgail`.

LeRobot finds the classes, and the processors' function, by their names.
"""

import dataclasses
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import make_default_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn

from hgail_jax.io.policy import AnyPolicy
from hgail_jax.policy import MAX_NORMALIZED, NORM_EPSILON
from hgail_jax.vision.network import KERNELS, STRIDES
from hgail_jax.vision.policy import CameraPolicy


@PreTrainedConfig.register_subclass("hgail")
@dataclasses.dataclass
class HgailConfig(PreTrainedConfig):
    """Sizes of a policy that reads the task's observation, or with `cameras` pictures and the robot's own numbers."""

    task: str = ""
    """The task that it was trained on."""
    hidden: list[int] = dataclasses.field(default_factory=list)
    """Widths of the hidden layers."""
    cameras: list[str] = dataclasses.field(default_factory=list)
    """Cameras of which it sees pictures, in this order."""
    channels: list[int] = dataclasses.field(default_factory=list)
    """Outputs of the convolutions of the pictures."""
    layer_norm: bool = True
    """Whether layer normalisation and relu, or tanh, come after a hidden layer."""
    squash: bool = True
    """Whether tanh brings the actions into [-1, 1]; else they are clipped."""
    versions: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Versions of the packages that trained it."""
    randomization: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Randomisation of its training episodes."""
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class that it was trained with."""
    normalization_mapping: dict[str, NormalizationMode] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(("STATE", "ENV", "VISUAL", "ACTION"), NormalizationMode.IDENTITY)
    )
    """None: the policy has its own mean and standard deviation."""
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self) -> AdamConfig:
        """Returns the optimizer of a further training by behaviour cloning."""
        return AdamConfig(lr=1e-4)

    def get_scheduler_preset(self) -> None:
        """Returns None: the learning rate is constant."""

    @property
    def numbers(self) -> str:
        """Name of the feature that it reads as numbers."""
        return OBS_STATE if self.cameras else OBS_ENV_STATE

    def validate_features(self) -> None:
        """Raises a ValueError if it lacks one."""
        wanted = {self.numbers, *(f"{OBS_IMAGES}.{camera}" for camera in self.cameras)}
        if not wanted <= set(self.input_features or {}) or self.action_feature is None:
            raise ValueError(f"a policy of the type hgail reads {', '.join(sorted(wanted))} and makes {ACTION}")


class HgailPolicy(PreTrainedPolicy):
    """The mean action of `MeanPolicy`, or the action of `CameraPolicy`, in PyTorch, normalisation included."""

    config_class, name = HgailConfig, "hgail"

    def __init__(self, config: HgailConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        numbers = config.input_features[config.numbers].shape[0]
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("std", torch.ones(numbers))
        inputs = [3 * len(config.cameras), *config.channels]
        self.convolutions = nn.ModuleList(map(_Same, inputs, config.channels, KERNELS, STRIDES))
        sizes = [numbers + 2 * sum(config.channels[-1:]), *config.hidden, *config.action_feature.shape]
        self.layers = nn.ModuleList(map(nn.Linear, sizes, sizes[1:]))
        widths = config.hidden if config.layer_norm else []
        self.norms = nn.ModuleList(nn.LayerNorm(width, eps=NORM_EPSILON) for width in widths)

    def get_optim_params(self) -> Any:
        """Returns what an optimizer trains."""
        return self.parameters()

    def reset(self) -> None:
        """Does nothing: the policy remembers nothing."""

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Returns actions, `[batch, action_size]`; a ValueError if what it reads is missing or has another size."""
        return self._action(batch).clamp(-1.0, 1.0)

    def _action(self, batch: dict[str, Tensor]) -> Tensor:
        """Returns actions before they are clipped: of what is clipped there is no gradient."""
        config = self.config
        for name, feature in config.input_features.items():
            if name not in batch:
                named = f"name --env.cameras={','.join(config.cameras)}"
                raise ValueError(f"{name} is missing; {named if config.cameras else 'leave out --env.cameras'}")
            if tuple(batch[name].shape[1:]) != tuple(feature.shape):
                raise ValueError(
                    f"{name} is {(*batch[name].shape[1:],)}; this policy of {config.task} reads {feature.shape}"
                )
        hidden = (batch[config.numbers] - self.mean) / self.std
        if config.cameras:
            seen = torch.cat([batch[f"{OBS_IMAGES}.{camera}"] for camera in config.cameras], dim=1)
            hidden = torch.cat([self._places(seen), hidden], dim=-1)
        else:
            hidden = hidden.clamp(-MAX_NORMALIZED, MAX_NORMALIZED)
        *inner, last = self.layers
        for index, layer in enumerate(inner):
            hidden = layer(hidden)
            hidden = torch.relu(self.norms[index](hidden)) if config.layer_norm else torch.tanh(hidden)
        return torch.tanh(last(hidden)) if config.squash else last(hidden)

    def _places(self, pictures: Tensor) -> Tensor:
        """Returns the mean place of each feature of pictures, see `hgail_jax.vision.network.look`."""
        features = pictures - 0.5
        for convolution in self.convolutions:
            features = torch.relu(convolution(features))
        weights = features.flatten(2).softmax(dim=-1).unflatten(2, features.shape[2:])
        y, x = (torch.linspace(-1.0, 1.0, size, device=features.device) for size in features.shape[2:])
        return torch.cat([weights.sum(dim=3) @ y, weights.sum(dim=2) @ x], dim=-1)

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Returns the action as a chunk of one, `[batch, 1, action_size]`."""
        return self.select_action(batch)[:, None]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """Returns the mean squared error of the actions, `[]`: behaviour cloning."""
        return nn.functional.mse_loss(self._action(batch), batch[ACTION]), None


class _Same(nn.Conv2d):
    """A convolution with JAX's padding `SAME`, which with a stride is not the same on both sides."""

    def forward(self, values: Tensor) -> Tensor:
        edge, stride = self.kernel_size[0], self.stride[0]
        around = [max((-(-size // stride) - 1) * stride + edge - size, 0) for size in values.shape[:1:-1]]
        return super().forward(nn.functional.pad(values, [part for one in around for part in (one // 2, -(-one // 2))]))


def make_hgail_pre_post_processors(config: HgailConfig, dataset_stats: Any = None) -> tuple[Any, Any]:
    """Returns the processors around the policy, which only move numbers to its device and back."""
    return make_default_pre_post_processors(config, dataset_stats)


def export_lerobot(folder: Path, policy: AnyPolicy) -> None:
    """Writes a policy as a folder that `lerobot-eval --policy.path` takes; see `hgail_jax.lerobot.check_shown`."""
    cameras, convolutions, layers, squash = _parts(policy)
    config = HgailConfig(
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (policy.action_size,))},
        device="cpu",
        push_to_hub=False,
        task=policy.task,
        hidden=[layer[1].size for layer in layers[:-1]],
        cameras=list(cameras),
        channels=[biases.size for _, biases in convolutions],
        layer_norm=len(layers[0]) > 2,
        squash=squash,
        versions=policy.versions,
        randomization=dataclasses.asdict(policy.randomization),
        task_options=policy.task_options,
    )
    kind = FeatureType.STATE if cameras else FeatureType.ENV
    picture = PolicyFeature(FeatureType.VISUAL, (3, *[getattr(policy, "size", 0)] * 2))
    images = {f"{OBS_IMAGES}.{camera}": picture for camera in cameras}
    config.input_features = {config.numbers: PolicyFeature(kind, policy.mean.shape)} | images
    arrays = {"mean": policy.mean, "std": policy.std}
    for index, (kernel, biases) in enumerate(convolutions):
        arrays |= _named(f"convolutions.{index}", kernel.transpose(3, 2, 0, 1), biases)
    for index, (weights, biases, *norm) in enumerate(layers):
        arrays |= _named(f"layers.{index}", weights.T, biases) | _named(f"norms.{index}", *norm)
    exported = HgailPolicy(config)
    exported.load_state_dict({name: torch.tensor(array) for name, array in arrays.items()})
    for written in (exported, *make_hgail_pre_post_processors(config)):
        written.save_pretrained(folder)


def _parts(policy: AnyPolicy) -> tuple[Any, Any, Any, bool]:
    """Returns a policy's cameras, convolutions, layers, and whether tanh ends it."""
    if isinstance(policy, CameraPolicy):
        return policy.cameras, policy.eyes.convolutions, [*policy.eyes.hidden, policy.eyes.action], True
    return (), (), policy.layers, policy.squash


def _named(layer: str, *arrays: Any) -> dict[str, Any]:
    return dict(zip((f"{layer}.weight", f"{layer}.bias"), arrays, strict=False))
