"""The method of a policy that sees pictures; its numbers are with the others', in `defaults` and `presets`."""

from hgail_envs import find_class
from hgail_jax.learners.student import Student
from hgail_jax.settings.defaults import task_preset
from hgail_jax.settings.methods import METHODS, Method
from hgail_jax.settings.presets import Preset

CAMERA = Method(
    "taught by a policy that knows the positions (as DAgger, Ross et al. 2011)",
    without_effect=(
        *("method", "preset", "demos", "pretrain", "randomize", "p_ht", "strategy", "reward"),
        *("standardize_reward", "environment_reward", "bc_weight"),
    ),
    learners=(Student.name,),
)
"""The method `camera`, which `--observe camera` chooses."""


def camera_preset(task: str, platform: str) -> Preset:
    """Returns the settings of a task's student on a platform, `"cpu"` or `"gpu"`."""
    return task_preset(find_class(task), platform, learner=Student.name)


def method_of(preset: Preset) -> Method:
    """Returns the method of a preset, which may be that of a student."""
    return (METHODS | {"camera": CAMERA})[preset.method]
