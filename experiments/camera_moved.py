"""Measures how far a policy's cameras may be moved before it fails, and draws the curves.

python -m experiments.camera_moved --policy runs/push-camera-1

Each camera is displaced on its own, anew in each episode, by the same distance in a random direction, or turned by the
same angle about a random axis, or its field of view is wider or narrower by the same fraction. All else is the scene's
own look.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from experiments.figures import style_axes, write_figure
from hgail_envs.validation import check_count, check_not_negative
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.look import LOOKS, split_draws
from hgail_envs.vision.pictures import Pictures
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.cli.policies import find_policies, find_task, make_task
from hgail_jax.io.files import from_here, write_json
from hgail_jax.io.provenance import provenance
from hgail_jax.play.evaluation import Evaluation
from hgail_jax.trainer.folder import create_folder, create_numbered_folder
from hgail_jax.trainer.statistics import success_interval
from hgail_jax.trainer.train_options import unless_given
from hgail_jax.vision.policy import CameraPolicy

PROGRAM = "camera_moved"
_LOOK = "cameras"  # which varies the cameras alone
_KINDS = {
    "shift": ("camera moved, cm", 100.0, LOOKS[_LOOK].camera_shift),
    "turn": ("camera turned, degrees", np.rad2deg(1.0), LOOKS[_LOOK].camera_turn),
    "zoom": ("field of view changed, %", 100.0, LOOKS[_LOOK].zoom),
}
"""Label of each quantity's axis, the label's units in a metre, radian or fraction, and a draw of 1 in those."""


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures the success of trained policies with their cameras moved, turned and zoomed."""

    policy: Path
    """The policy's file, or a run's folder, whose seeds are all measured."""
    shift: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
    """Displacements, centimetres."""
    turn: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    """Angles, degrees."""
    zoom: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0)
    """Changes of the field of view, per cent."""
    episodes: int = 100
    """Episodes of each policy at each point."""
    seed: int = 0
    """Of the episodes."""
    out: Annotated[Path | None, unless_given("runs/camera-moved-<number>", "FOLDER")] = None
    """Folder to write the figure and the numbers to, which must not exist."""


class Moved:
    """Pictures whose cameras are displaced in each scene by the same amount, in directions that its draws decide."""

    def __init__(self, pictures: Pictures, kind: str, amount: float) -> None:
        self._pictures, self._kind, self._draw = pictures, kind, amount / _KINDS[kind][2]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pictures, name)

    def __call__(self, qpos: jax.Array, draws: jax.Array) -> jax.Array:
        """Returns the pictures as `Pictures` does; of the draws only the directions count."""
        parts = split_draws(self._pictures.model, draws)
        directions = jax.scipy.special.erfinv(jnp.clip(parts[self._kind], -0.999, 0.999))  # normally distributed
        if self._kind == "zoom":
            directions = jnp.sign(directions)
        else:
            directions /= jnp.linalg.norm(directions, axis=-1, keepdims=True)
        moved = {name: jnp.zeros_like(values) for name, values in parts.items()} | {self._kind: self._draw * directions}
        batch = draws.shape[:-1]
        return self._pictures(qpos, jnp.concatenate([values.reshape(*batch, -1) for values in moved.values()], axis=-1))


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line."""
    command = parse(Command, PROGRAM, __doc__, arguments)
    try:
        points = _points(command)
        check_count("episodes", command.episodes)
        found = find_policies(find_task(None, command.policy), command.policy)
        policies = [(path, policy) for path, policy in found if isinstance(policy, CameraPolicy)]
        if not policies:
            raise ValueError(f"{command.policy} sees positions; a policy with cameras is needed")
        _, first = policies[0]
        env: Any = make_task(first, first.task, None)
        pictures = Pictures(env.task, first.cameras, first.size, look=_LOOK, target=first.target, kind=first.kind)
        out = create_folder(command.out) if command.out else create_numbered_folder(Path("runs"), "camera-moved")
    except (ValueError, OSError, RenderingError) as error:
        fail(PROGRAM, error, 2)
    rows = []
    for kind, amount in points:
        moved: Any = Moved(pictures, kind, amount / _KINDS[kind][1])
        evaluation = Evaluation(CameraEnv(env.task, moved), command.seed, command.episodes)
        success = [float(evaluation(policy).success) for _, policy in policies]
        rows.append({"kind": kind, "amount": amount, "success": success, "episodes": evaluation.episodes})
        print(f"{_KINDS[kind][0]}: {amount:g}, success {np.mean(success):.3f}")
    about: dict[str, Any] = {"task": first.task, "policies": [str(from_here(path)) for path, _ in policies]}
    about |= {"renderer": pictures.renderer, "look": first.look, "cameras": first.cameras}
    write_json(out / "camera-moved.json", about | {"rows": rows, "made_by": provenance()})
    draw(out / "camera-moved.png", first.task, rows)


def _points(command: Command) -> list[tuple[str, float]]:
    """Returns the kinds and amounts to measure; what is not moved at all is the same for each kind."""
    points = [(kind, amount) for kind in _KINDS for amount in getattr(command, kind)]
    for kind, amount in points:
        check_not_negative(kind, amount)
    return points


def draw(path: Path, task: str, rows: Sequence[dict[str, Any]]) -> None:
    """Writes a PNG: success by each quantity, with Wilson's 95 % interval over all episodes; 0 is each one's first."""
    still = [row for row in rows if row["amount"] == 0.0][:1]
    figure, axes = plt.subplots(1, len(_KINDS), figsize=(9, 2.8), sharey=True, layout="constrained")
    for panel, (kind, (label, *_)) in zip(axes, _KINDS.items(), strict=True):
        moved = still + [row for row in rows if row["kind"] == kind and row["amount"] > 0.0]
        amounts = [row["amount"] for row in moved]
        intervals = [
            success_interval(float(np.mean(row["success"])), row["episodes"] * len(row["success"])) for row in moved
        ]
        panel.fill_between(amounts, [each.low for each in intervals], [each.high for each in intervals], alpha=0.2)
        panel.plot(amounts, [each.value for each in intervals], marker="o", markersize=4)
        panel.set(xlabel=label, ylim=(-0.03, 1.03))
        style_axes(panel)
    axes[0].set_ylabel("success rate")
    figure.suptitle(task)
    write_figure(figure, path, dpi=120)


if __name__ == "__main__":
    with one_line_errors(PROGRAM):
        prepare_process()
        main()
