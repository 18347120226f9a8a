"""Draws the reward that push's discriminator gives over the table: `python -m experiments.reward_map` writes `MAP`."""

import functools
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize

import hgail_envs
from experiments.figures import write_figure
from hgail_envs.tasks.push import Push
from hgail_jax.cli.command_line import one_line_errors, prepare_process
from hgail_jax.discriminator import discriminate
from hgail_jax.settings.defaults import platform_name, task_preset
from hgail_jax.settings.methods import PAPER_SAMPLES
from hgail_jax.state import TrainState
from hgail_jax.trainer.loop import Program

MAP = Path(__file__).parent.parent / "docs" / "images" / "reward-map.png"
"""The picture, replaced by each run."""

SEED = 3000
ROUNDS = 8
SAMPLES: Mapping[str, Mapping[str, float]] = {
    "the paper's samples": PAPER_SAMPLES,
    "negatives' goals shuffled": {"goal_jitter": 0.0},
    "and positives' goals jittered": {},
}
"""Titles of the panels, and their changes to the default settings."""

_EDGE = 0.12  # metres shown on each side of the goal
_BINS = 24  # along each edge
_CUBE = "cube position"


def main() -> None:
    """Trains push with each kind of samples, side by side, and draws what their discriminators have learnt."""
    program = _program()
    step, states = program.compile(), program.init()
    for round_, phases in enumerate(program.phases()):
        states, metrics = step(states, phases)
        print(f"round {round_}, success", *np.asarray(metrics.evaluation.success).round(2))
    figure, axes = plt.subplots(1, len(SAMPLES), figsize=(10, 3.6), sharey=True, layout="constrained")
    for index, (title, panel) in enumerate(zip(SAMPLES, axes, strict=True)):
        places, reward = rewards(program, jax.tree.map(lambda leaf, seed=index: leaf[seed], states))
        shown = _draw(panel, title, np.asarray(places), np.asarray(reward))
    axes[0].set_ylabel("from the goal, cm")
    figure.colorbar(shown, ax=axes, label="σ(d), mean of the steps that end there", shrink=0.9)
    write_figure(figure, MAP, dpi=150)
    print(MAP)


def _program() -> Program:
    preset = task_preset(Push, platform_name(), learner="td3")
    settings = tuple(preset.hyperparameters.replace(**changes) for changes in SAMPLES.values())
    config = preset.config.replace(rounds=ROUNDS)
    env = hgail_envs.make("push", worlds=len(settings) * config.num_envs, **preset.task_options)
    return Program(env, config, settings, seeds=1, first_seed=SEED)


def rewards(program: Program, state: TrainState) -> tuple[jax.Array, jax.Array]:
    """Returns the cube's places after the steps of a seed's buffer, `[S, 2]` metres from one goal, and σ(d), `[S]`.

    The goal is the cube's that was pursued nearest to the middle of them all; each step is seen under it.
    """
    env, buffer = program.env, state.buffer
    assert buffer is not None
    valid = np.flatnonzero(buffer.valid)

    def steps(leaf: jax.Array) -> jax.Array:
        return leaf[valid].reshape(-1, leaf.shape[-1])

    pursued = steps(buffer.desired)
    pursued = pursued[env.goal_kind(pursued) > 0]  # 0 is the gripper's
    goal = pursued[jnp.argmin(jnp.linalg.norm(pursued - pursued.mean(axis=0), axis=-1))]
    before, after = steps(buffer.features[:, :-1]), steps(buffer.features[:, 1:])
    observation = env.goal_observation(before, jnp.broadcast_to(goal, (len(before), len(goal))))
    logit = jax.jit(functools.partial(discriminate, program.config))
    logits = logit(state.discriminator, state.normalize(observation), steps(buffer.action))
    return after[:, env.features_layout[_CUBE]][:, :2] - goal[:2], jax.nn.sigmoid(logits)


def _draw(axes: plt.Axes, title: str, places: np.ndarray, reward: np.ndarray) -> plt.cm.ScalarMappable:
    """Draws the mean reward by the cube's place, white where no step ends, and a circle around what is a success."""
    edges = np.linspace(-_EDGE, _EDGE, _BINS + 1)
    x, y = places.T
    count, *_ = np.histogram2d(x, y, bins=[edges, edges])
    total, *_ = np.histogram2d(x, y, bins=[edges, edges], weights=reward)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    shown = axes.pcolormesh(100 * edges, 100 * edges, mean.T, norm=Normalize(0.0, 1.0), cmap="viridis")
    axes.add_patch(plt.Circle((0.0, 0.0), 100 * Push.success_threshold, fill=False, color="white", linewidth=1.5))
    axes.set(title=title, xlabel="from the goal, cm", aspect="equal")
    return shown


if __name__ == "__main__":
    with one_line_errors("reward_map"):
        prepare_process()
        main()
