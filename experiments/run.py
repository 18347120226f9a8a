"""Trains several seeds of a method on a task, side by side, and writes what came of it to a new folder."""

import contextlib
import dataclasses
import io
import itertools
import os
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro
from curves import draw_curves
from run_folder import MetricsFile, create_folder, next_folder, provenance, write_json
from tqdm import tqdm
from video import film

import envs
from envs.fetch import FAST_SUBSTEPS, FetchEnv
from hgail_jax.config import PRESETS, REWARDS, STRATEGIES, Config, Hyperparameters, Preset
from hgail_jax.evaluate import EpisodeMetrics
from hgail_jax.methods import METHODS
from hgail_jax.parallel import compile_train_step, evaluate_seeds, evaluation_episodes, init_seeds, seed_keys
from hgail_jax.policy import MeanPolicy, from_state, load_policy, save_policy
from hgail_jax.train import RoundMetrics, env_steps, schedule

AUTO_SIZES = {"cpu": {"num_envs": 64, "rounds": 6}, "gpu": {"num_envs": 256, "rounds": 4}}
"""What `--num-envs` and `--iterations` are by default under the preset `parallel`."""
EVALUATION_EPISODES = {"cpu": 128, "gpu": 512}
"""Episodes per seed in the final evaluation."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains several seeds of a method on a task and writes the results to a new folder."""

    task: str = "reach"
    """A task's name, or module:Class for a GoalEnv of your own."""
    method: Literal["hgail", "hgail-no", "ppo"] = "hgail"
    """What to train: HGAIL, HGAIL without hindsight, or PPO on the sparse reward."""
    seeds: int = 8
    """Number of seeds, trained side by side."""
    first_seed: int = 0
    """The first seed; the others count up from it."""
    num_envs: int | None = None
    """Environments per seed, that is episodes per roll-out; by default chosen for the platform."""
    iterations: int | None = None
    """Rounds of the adversarial training; by default chosen for the platform. 0 leaves the pre-training alone."""
    preset: Literal["parallel", "paper"] = "parallel"
    """Sizes and schedule: wide roll-outs with few updates, or the paper's."""
    pretrain: bool = True
    """Fit policy and discriminator to the first roll-out before the rounds begin."""
    impl: Literal["auto", "jax", "warp"] = "auto"
    """Physics implementation of the Fetch tasks; auto takes the best available."""
    substeps: int | None = None
    """Physics steps per action in training, 4 to 20; by default 4 of 10 ms. The final evaluation takes 20 of 2 ms."""
    p_ht: float | None = None
    """Probability that hindsight replaces a step's goal, 0 to 1; by default the method's."""
    strategy: Literal["future", "final"] = "future"
    """Where hindsight takes goals from: later in the trajectory, or its end."""
    reward: Literal["r1", "r2", "r3", "r4"] = "r1"
    """How the discriminator's logit becomes a reward."""
    out: Path | None = None
    """Folder to write, which must not exist; by default runs/<task>-<method>-<number>."""
    video: bool = False
    """Film the policy of the first seed after training (Fetch tasks)."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Options, checked and worked out."""

    env: envs.GoalEnv
    config: Config
    hyperparameters: Hyperparameters
    evaluation_episodes: int
    """Episodes per seed that the final evaluation has at least."""


def prepare(options: Options, platform: str) -> Run:
    """Works out what the options ask for on `platform`, `"cpu"` or `"gpu"`.

    Raises:
      ValueError: an option has a value that it cannot have.

    """
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; it must be at least 1")
    preset = PRESETS[options.preset]
    sizes: dict[str, Any] = dict(AUTO_SIZES[platform]) if options.preset == "parallel" else {}
    given = {"num_envs": options.num_envs, "rounds": options.iterations}
    sizes |= {name: value for name, value in given.items() if value is not None}
    preset = Preset(dataclasses.replace(preset.config, pretrain=options.pretrain, **sizes), preset.hyperparameters)
    preset = METHODS[options.method].apply(preset)
    hyperparameters = preset.hyperparameters.replace(
        strategy=STRATEGIES[options.strategy], reward=REWARDS[options.reward]
    )
    if options.p_ht is not None:
        hyperparameters = hyperparameters.replace(p_ht=options.p_ht)
    return Run(
        env=_make(options),
        config=preset.config,
        hyperparameters=hyperparameters.validate(),
        evaluation_episodes=EVALUATION_EPISODES[platform],
    )


def _make(options: Options) -> envs.GoalEnv:
    if issubclass(envs.find_class(options.task), FetchEnv):
        return envs.make(
            options.task, impl=options.impl, substeps=FAST_SUBSTEPS if options.substeps is None else options.substeps
        )
    if options.substeps is not None or options.impl != "auto":
        raise ValueError(f"--substeps and --impl are for the Fetch tasks; {options.task!r} is none")
    return envs.make(options.task)


def parse(arguments: list[str] | None) -> Options:
    """Reads the command line; what it cannot read is said in one line instead of tyro's box, with exit code 2."""
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(Options, args=arguments, description=__doc__)
    except SystemExit as stop:
        # A title, perhaps a rule, the message on one line or more, a rule, and advice.
        lines = [line.strip("│|─-╰╯+ ") for line in box.getvalue().strip().splitlines()[1:]]
        message = itertools.takewhile(bool, itertools.dropwhile(lambda line: not line, lines))
        if stop.code:
            print(f"run.py: {' '.join(message)}", file=sys.stderr)
        raise


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(arguments)
    started = time.perf_counter()
    try:
        run = prepare(options, "cpu" if jax.default_backend() == "cpu" else "gpu")
        folder = options.out or next_folder(Path("runs"), f"{options.task.split(':')[-1]}-{options.method}")
        create_folder(folder)
    except ValueError as error:
        print(f"run.py: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"{options.method} on {options.task}, {options.seeds} seeds × {run.config.num_envs} envs -> {folder}")
    made_by = provenance()
    settings = {"config": dataclasses.asdict(run.config), "hyperparameters": dataclasses.asdict(run.hyperparameters)}
    write_json(folder / "config.json", {"options": dataclasses.asdict(options), **settings, **made_by})
    summary = train(options, run, folder)
    summary["wall_seconds"]["total"] = time.perf_counter() - started
    write_json(folder / "summary.json", summary | made_by)
    report(summary, folder)
    if options.video:
        film_policy(run, folder, load_policy(folder / "policies" / f"seed-{options.first_seed}.npz"))


def train(options: Options, run: Run, folder: Path) -> dict:
    """Trains and evaluates all seeds, writes every file but the summary into `folder`, and returns the summary."""
    phases = schedule(run.config)
    steps = env_steps(run.env, run.config, phases).cumsum()
    keys = seed_keys(options.first_seed, options.seeds)
    states = init_seeds(run.env, run.config, run.hyperparameters, keys)

    compile_started = time.perf_counter()
    print("compiling ...", flush=True)
    train_step = compile_train_step(run.env, run.config, states, phases[0])
    train_started = time.perf_counter()

    metrics_file, history = MetricsFile(folder / "metrics.csv"), []
    bar = tqdm(zip(phases, steps, strict=True), total=len(phases), unit="round", desc="training")
    for row, total_steps in bar:
        states, metrics = train_step(states, row)
        history.append(jax.tree.map(np.asarray, metrics))
        seconds = time.perf_counter() - train_started
        metrics_file.append(metrics_rows(options, len(history) - 1, total_steps, seconds, history[-1]))
        reached = history[-1].evaluation
        bar.set_postfix_str(
            f"success {reached.success.mean():.3f}, distance {reached.distance_l2.mean():.3f} m,"
            f" {total_steps * options.seeds / seconds:,.0f} env steps/s"
        )
    trained = time.perf_counter()
    states, final = evaluate_seeds(train_step, run.config, states, run.evaluation_episodes)
    evaluated = time.perf_counter()

    write_results(options, run, folder, states, steps, history)
    timing = {
        "compile": train_started - compile_started,
        "train": trained - train_started,
        "evaluation": evaluated - trained,
    }
    return summarize(options, run, final, int(steps[-1]), timing)


def metrics_rows(
    options: Options, round_index: int, steps: int, seconds: float, metrics: RoundMetrics
) -> list[dict[str, float]]:
    """Returns the rows of metrics.csv for one round, one per seed."""
    columns = {
        "success_rate": metrics.evaluation.success,
        "success_rate_achieved": metrics.evaluation.achieved,
        "success_rate_l1": metrics.evaluation.success_l1,
        "distance_l1": metrics.evaluation.distance_l1,
        "distance_l2": metrics.evaluation.distance_l2,
        "training_success_rate": metrics.training.success,
        **vars(metrics.update),
    }
    first = options.first_seed
    return [
        {"seed": first + index, "round": round_index, "env_steps": int(steps), "seconds": round(seconds, 3)}
        | {name: float(values[index]) for name, values in columns.items()}
        for index in range(options.seeds)
    ]


def write_results(
    options: Options, run: Run, folder: Path, states, steps: np.ndarray, history: list[RoundMetrics]
) -> None:
    """Writes the policies and the curves."""
    (folder / "policies").mkdir()
    policies = [
        from_state(options.task, jax.tree.map(lambda leaf, i=index: leaf[i], states)) for index in range(options.seeds)
    ]
    for index, policy in enumerate(policies):
        save_policy(folder / "policies" / f"seed-{options.first_seed + index}.npz", policy)
    title = f"{options.method} on {options.task}: {options.seeds} seeds, {run.config.num_envs} environments each"
    success, distance = (
        np.stack([getattr(metrics.evaluation, name) for metrics in history]) for name in ("success", "distance_l1")
    )
    draw_curves(folder / "curves.png", title, steps, success, distance)


def film_policy(run: Run, folder: Path, policy: MeanPolicy) -> None:
    """Writes rollout.mp4, or says in one line why it cannot."""
    try:
        if not isinstance(run.env, FetchEnv):
            raise RuntimeError("the task has no scene to film")
        film(folder / "rollout.mp4", run.env.accurate(), policy)
    except Exception as error:  # whatever rendering or encoding raises, the results are written
        print(f"no video: {str(error).splitlines()[0] if str(error) else type(error).__name__}", file=sys.stderr)


def summarize(options: Options, run: Run, final: EpisodeMetrics, steps: int, timing: dict) -> dict:
    """Returns summary.json's content, less what made it and the total time."""

    def over_seeds(measured: jax.Array | float) -> dict:
        values = np.asarray(measured)
        return {"mean": float(values.mean()), "std": float(values.std()), "per_seed": values.tolist()}

    return {
        "task": options.task,
        "method": options.method,
        "seeds": options.seeds,
        "success_rate": over_seeds(final.success),
        "success_rate_l1": over_seeds(final.success_l1),
        "distance_l1": over_seeds(final.distance_l1),
        "distance_l2": over_seeds(final.distance_l2),
        "evaluation_episodes_per_seed": evaluation_episodes(run.config, run.evaluation_episodes),
        "env_steps_per_seed": steps,
        "env_steps_per_second": steps * options.seeds / timing["train"],
        "wall_seconds": timing,
    }


def report(summary: dict, folder: Path) -> None:
    """Prints the outcome."""
    success, distance, seconds = summary["success_rate"], summary["distance_l1"], summary["wall_seconds"]
    print(
        f"success {success['mean']:.3f} ± {success['std']:.3f} (worst seed {min(success['per_seed']):.3f}), "
        f"L1 distance {distance['mean']:.3f} m, {summary['env_steps_per_seed']:,} env steps per seed\n"
        f"compile {seconds['compile']:.1f} s, train {seconds['train']:.1f} s at "
        f"{summary['env_steps_per_second']:,.0f} env steps/s, total {seconds['total']:.1f} s -> {folder}"
    )


if __name__ == "__main__":
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hgail_jax"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    sys.path.append(os.getcwd())  # where --task finds a module of the user's own
    main()
