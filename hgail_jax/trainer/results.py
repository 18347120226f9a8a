"""Results of a trained run: policies, learning curves and a summary."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hgail_envs import EpisodeMetrics
from hgail_envs.validation import counted
from hgail_jax.evaluate import whole_rollouts
from hgail_jax.io.files import replace_file
from hgail_jax.io.policy import from_state, save_policy
from hgail_jax.state import TrainState
from hgail_jax.trainer.loop import Progress, diverged_seeds
from hgail_jax.trainer.run import Run

_COLOR = "#1f5f8b"


def write_results(run: Run, folder: Path, states: TrainState, history: list[dict[str, Any]]) -> None:
    """Writes the policies and the curves."""
    (folder / "policies").mkdir(exist_ok=True)
    # On the host, as a device would compile each slice.
    on_host = jax.device_get(states.replace(rng=None, expert=None, buffer=None))
    for index in range(run.seeds):
        state = jax.tree.map(lambda leaf, i=index: leaf[i], on_host)
        policy = from_state(run.task, run.env, run.config, state, run.task_options)
        save_policy(folder / "policies" / f"seed-{run.first_seed + index}.npz", policy)
    size = f"{counted(run.seeds, 'seed')}, {counted(run.config.num_envs, 'environment')} each"
    title = f"{run.method} on {run.task}: {size}"
    names = ("env_steps", "success_rate", "distance_l1")
    steps, success, distance = (np.array([record[name] for record in history], float) for name in names)
    evaluated = np.isfinite(success).any(axis=1)
    draw_curves(folder / "curves.png", title, steps[evaluated], success[evaluated], distance[evaluated])


def summarize(
    run: Run, progress: Progress, evaluations: Mapping[str, EpisodeMetrics], timing: dict[str, float]
) -> dict[str, Any]:
    """Returns summary.json's content, after the last round, without provenance and total time.

    The evaluations, leaves `[seeds]`, are `"final"` and, of a randomised task, `"nominal"`, that of the task without
    randomisation; the timing has seconds of `compile`, `train` and `evaluation`.
    """

    def over_seeds(measured: jax.Array | float) -> dict[str, Any]:
        values = np.asarray(measured)
        return {"mean": float(values.mean()), "std": float(values.std()), "per_seed": values.tolist()}

    rollouts = whole_rollouts(run.evaluation_episodes, run.config.num_envs)
    final, steps = evaluations["final"], progress.history[-1]["env_steps"]
    nominal = {"nominal_success_rate": over_seeds(evaluations["nominal"].success)} if "nominal" in evaluations else {}
    return {
        "task": run.task,
        "method": run.method,
        "learner": run.config.learner.name,
        "environment_reward": float(run.hyperparameters.environment_reward),
        "seeds": run.seeds,
        "mesh": dict(run.mesh.shape),
        "success_rate": over_seeds(final.success),
        **nominal,
        "achieved_rate": over_seeds(final.achieved),
        "success_rate_l1": over_seeds(final.success_l1),
        **{name: over_seeds(getattr(final, name)) for name in ("distance_l1", "distance_l2")},
        "diverged_seeds": diverged_seeds(run, progress),
        "evaluation_episodes_per_seed": rollouts * run.config.num_envs,
        "env_steps_per_seed": steps,
        "env_steps_per_second": steps * run.seeds / timing["train"],
        "wall_seconds": timing,
    }


def draw_curves(path: Path, title: str, env_steps: np.ndarray, success: np.ndarray, distance: np.ndarray) -> None:
    """Writes a PNG: each seed thin, their mean thick, a band of one standard deviation around it.

    `env_steps` are `[rounds]`, learnt from so far per seed; `success`, the mean action's rate, and `distance`, the L1
    distance at the end of the episode in metres, are `[rounds, seeds]`.
    """
    # Not pyplot, whose backend is the user's; late, for it takes its time.
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, MaxNLocator

    figure = Figure(figsize=(9, 3.8), layout="constrained")
    axes = figure.subplots(1, 2)
    panels = ((success, "success rate", (-0.02, 1.02)), (distance, "L1 distance at the end (m)", (0.0, None)))
    for axis, (values, label, limits) in zip(axes, panels, strict=True):
        mean, std = values.mean(axis=1), values.std(axis=1)
        each, *_ = axis.plot(env_steps, values, color=_COLOR, alpha=0.3, linewidth=0.7)
        band = axis.fill_between(env_steps, mean - std, mean + std, color=_COLOR, alpha=0.15, linewidth=0)
        (middle,) = axis.plot(env_steps, mean, color=_COLOR, linewidth=2, marker="o", markersize=4)
        axis.set(xlabel="environment steps per seed", ylabel=label, ylim=limits)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    if success.shape[1] > 1:
        names = ("a seed", "mean of the seeds", "one standard deviation")
        figure.legend((each, middle, band), names, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title, fontsize=11)
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=130, format="png")
