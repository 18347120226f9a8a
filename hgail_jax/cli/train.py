"""Trains several seeds of a method on a task, side by side, and writes what came of it to a folder."""

import contextlib
import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax

import envs
from envs.fetch.arm import FetchEnv
from hgail_jax.cli.command_line import cache_compilations, fail, parse
from hgail_jax.config import PRESETS, REWARDS, STRATEGIES, Preset
from hgail_jax.distributed.processes import choose_mesh, join, silent_but_first
from hgail_jax.distributed.seeds import check_seeds
from hgail_jax.distributed.sharding import any_process
from hgail_jax.io.demonstrations import load_demonstrations
from hgail_jax.io.files import remove_partial_files, write_json
from hgail_jax.io.policy import MeanPolicy, load_policy
from hgail_jax.methods import LIKELIHOOD_BATCH, METHODS
from hgail_jax.playback import film
from hgail_jax.presets import EVALUATION_EPISODES, Defaults, defaults
from hgail_jax.train import schedule
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints
from hgail_jax.trainer.loop import Run, train
from hgail_jax.trainer.provenance import provenance
from hgail_jax.trainer.run_folder import create_folder, newest_folder, next_folder, reopen_folder, sole_user
from hgail_jax.trainer.signals import stop_on_signal
from hgail_jax.validation import check_count


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains several seeds of a method on a task and writes the results to a new folder."""

    task: str = "reach"
    """A task's name, or module:Class for a GoalEnv of your own."""
    method: Literal["hgail", "hgail-no", "gail-demo", "gasil", "ppo", "gcsl"] = "hgail"
    """What to train: HGAIL, HGAIL without hindsight, GAIL on demonstrations, GASIL, PPO on sparse reward, or GCSL."""
    demos: Path | None = None
    """Demonstrations of the task, from experiments/demos.py; gail-demo needs them."""
    seeds: int = 8
    """Number of seeds, trained side by side."""
    first_seed: int = 0
    """The first seed; the others count up from it."""
    num_envs: int | None = None
    """Environments per seed, that is episodes per roll-out; by default chosen for the task and the platform."""
    iterations: int | None = None
    """Rounds of the adversarial training; by default chosen likewise. 0 leaves the pre-training alone."""
    preset: Literal["parallel", "paper"] = "parallel"
    """Sizes and schedule: wide roll-outs with few updates, or the paper's."""
    pretrain: bool = True
    """Fit policy and discriminator to the first roll-out before the rounds begin."""
    impl: Literal["auto", "jax", "warp"] = "auto"
    """Physics implementation of the Fetch tasks; auto takes the best available."""
    substeps: int | None = None
    """Physics steps per action in training, 4 to 20; by default 4 (reach) or 8 (grasp). The final evaluation has 20."""
    task_options: tuple[str, ...] = ()
    """Further options of the task, as name=value, e.g. track_cube=true."""
    p_ht: float | None = None
    """Probability that hindsight replaces a step's goal, 0 to 1; by default the method's."""
    strategy: Literal["future", "final"] = "future"
    """Where hindsight takes goals from: later in the trajectory, or its end."""
    reward: Literal["r1", "r2", "r3", "r4"] = "r1"
    """How the discriminator's logit becomes a reward."""
    likelihood: float | None = None
    """Weight of the likelihood of expert samples in the policy's updates, 0 for the paper's; by default the task's."""
    action_std: tuple[float, ...] | None = None
    """Standard deviation of the policy, one number or one for each of the action's; by default the task's."""
    devices: int | None = None
    """Devices to spread seeds, and then environments, over: by default one, or all of several processes."""
    coordinator: str | None = None
    """host:port of the first of several processes that train together; each has all options of the others but one."""
    num_processes: int = 1
    """Number of these processes."""
    process_id: int = 0
    """Which of them this one is, from 0; the first writes the files."""
    out: Path | None = None
    """Folder to write, which must not exist; by default runs/<task>-<method>-<number>."""
    resume: str | None = None
    """Folder of a run to go on with; auto takes the newest of the task and method in runs/, or begins one."""
    checkpoint_every: int = 1
    """Rounds from one checkpoint to the next."""
    video: bool = False
    """Film the policy of the first seed after training (Fetch tasks)."""


def prepare(options: Options, platform: str) -> Run:
    """Works out what the options ask for on `platform`, `"cpu"` or `"gpu"`.

    Raises:
      ValueError: an option has a value that it cannot have.

    """
    check_seeds(options.first_seed, options.seeds)
    check_count("checkpoint_every", options.checkpoint_every)
    if options.resume is not None and options.out is not None:
        raise ValueError("--resume and --out exclude each other; a run goes on in its own folder")
    task_class = _find(options)
    preset = METHODS[options.method].apply(_sized(options, defaults(task_class, platform)))
    if options.likelihood == 0:  # not even for a method that has it by default
        preset = Preset(dataclasses.replace(preset.config, likelihood_batch=0), preset.hyperparameters)
    given: dict[str, Any] = {
        "p_ht": options.p_ht,
        "likelihood_weight": options.likelihood,
        "action_std": options.action_std,
    }
    if options.action_std is not None and len(options.action_std) == 1:
        given["action_std"] = options.action_std[0]
    hyperparameters = preset.hyperparameters.replace(
        strategy=STRATEGIES[options.strategy],
        reward=REWARDS[options.reward],
        **{name: value for name, value in given.items() if value is not None},
    )
    mesh = choose_mesh(options.seeds, preset.config.num_envs, options.devices)
    worlds = options.seeds * preset.config.num_envs // mesh.size
    env, task_options = _make(options, task_class, defaults(task_class, platform).substeps, worlds)
    demonstrations = None if options.demos is None else load_demonstrations(options.demos, options.task).validate(env)
    if (demonstrations is None) != (options.method != "gail-demo"):
        raise ValueError(
            "--demos goes with the method gail-demo, which needs it; experiments/demos.py makes such a file"
        )
    return Run(
        task=options.task,
        method=options.method,
        seeds=options.seeds,
        first_seed=options.first_seed,
        env=env,
        task_options=task_options,
        config=preset.config.validate(env),
        hyperparameters=hyperparameters.validate(env.action_size),
        evaluation_episodes=EVALUATION_EPISODES[platform],
        checkpoint_every=options.checkpoint_every,
        mesh=mesh,
        demonstrations=demonstrations,
    )


def _sized(options: Options, default: Defaults) -> Preset:
    """Returns the preset with the sizes of the task, or those given."""
    preset = PRESETS[options.preset]
    parallel = options.preset == "parallel"
    sizes: dict[str, Any] = dict(default.config) if parallel else {}
    given = {"num_envs": options.num_envs, "rounds": options.iterations}
    sizes |= {name: value for name, value in given.items() if value is not None}
    if options.likelihood:
        sizes["likelihood_batch"] = sizes.get("likelihood_batch") or LIKELIHOOD_BATCH
    config = dataclasses.replace(preset.config, pretrain=options.pretrain, **sizes)
    return Preset(config, preset.hyperparameters.replace(**(default.hyperparameters if parallel else {})))


def _find(options: Options) -> type[envs.GoalEnv]:
    try:
        return envs.find_class(options.task)
    except ValueError:
        raise
    except Exception as error:  # a module of the user's own raises what it likes
        raise ValueError(f"cannot load task {options.task!r}: {error}") from error


def _make(
    options: Options, task_class: type[envs.GoalEnv], substeps: int, worlds: int
) -> tuple[envs.GoalEnv, dict[str, Any]]:
    """Returns the task and the options of its own that it was given."""
    own = dict(_parse_task_option(option) for option in options.task_options)
    fetch = issubclass(task_class, FetchEnv)
    if not fetch and (options.substeps is not None or options.impl != "auto"):
        raise ValueError(f"--substeps and --impl are for the Fetch tasks; {options.task!r} is none")
    substeps = substeps if options.substeps is None else options.substeps
    physics = {"impl": options.impl, "substeps": substeps, "worlds": worlds} if fetch else {}
    try:
        return envs.make(options.task, **physics, **own), own
    except ValueError:
        raise
    except Exception as error:  # a class that is abstract, or the user's own
        raise ValueError(f"cannot make task {options.task!r}: {error}") from error


def _parse_task_option(option: str) -> tuple[str, Any]:
    name, _, value = option.partition("=")
    try:
        parsed = json.loads(value)
        if name not in ("impl", "substeps", "worlds") and isinstance(parsed, bool | int | float):
            return name, parsed
    except json.JSONDecodeError:
        pass
    raise ValueError(
        f"task option {option!r} is not name=value with a number, true or false, or has an option of its own here"
    )


def choose_folder(options: Options, unwanted: Path | None) -> tuple[Path, bool]:
    """Returns the run's folder, and whether it is there already, to be gone on with; `unwanted` if that is a path."""
    if unwanted is not None:
        return unwanted, False
    stem = f"{options.task.split(':')[-1]}-{options.method}"
    resumed = newest_folder(Path("runs"), stem) if options.resume == "auto" else options.resume
    if resumed is not None:
        return Path(resumed), True
    return options.out or next_folder(Path("runs"), stem), False


def open_folder(
    options: Options, run: Run, held: contextlib.ExitStack, unwanted: Path | None
) -> tuple[Path, Checkpoints, Checkpoint | None]:
    """Makes the run's folder, or finds what to go on with; a folder of another run is left as it is.

    A process that is not the first takes the folder `unwanted`. Until `held` is left, no other process can open it.

    Raises:
      ValueError: the folder, or its checkpoints, cannot be used.

    """
    folder, resumed = choose_folder(options, unwanted)
    checkpoints = Checkpoints(folder / "checkpoints", run.identity())
    if not resumed:
        create_folder(folder)
        held.enter_context(sole_user(folder))
        return folder, checkpoints, None
    reopen_folder(folder, run.identity())
    held.enter_context(sole_user(folder))
    restored = checkpoints.restore(jax.eval_shape(run.init))
    for line in restored.damaged if restored else ():
        print(line, file=sys.stderr)
    rounds, total = restored.rounds if restored else 0, len(schedule(run.config))
    if rounds == total:
        print(f"{folder} is complete; its results are written again")
    else:
        print(f"{folder} goes on after {rounds} of {total} rounds")
    return folder, checkpoints, restored


def open_together(
    options: Options, run: Run, held: contextlib.ExitStack, unwanted: Path | None
) -> tuple[Path, Checkpoints, Checkpoint | None]:
    """Opens the folder as `open_folder` does; where one process cannot, none of them goes on."""
    refusal: Exception | None = None
    try:
        opened = open_folder(options, run, held, unwanted)
    except (ValueError, OSError) as error:
        refusal = error
    if any_process(refusal is not None):
        raise refusal or ValueError("another process cannot go on, and says why")
    return opened


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "run.py", __doc__, arguments)
    started = time.perf_counter()
    with contextlib.ExitStack() as held:
        try:
            join(options.coordinator, options.num_processes, options.process_id)
            run = prepare(options, "cpu" if jax.default_backend() == "cpu" else "gpu")
            unwanted = held.enter_context(silent_but_first())
            folder, checkpoints, restored = open_together(options, run, held, unwanted)
        except (ValueError, OSError) as error:
            fail("run.py", error, 2)
        print(f"{options.method} on {options.task}, {options.seeds} seeds × {run.config.num_envs} envs -> {folder}")
        summary = carry_out(options, run, folder, checkpoints, restored, started)
        if summary is None:
            rounds = len(schedule(run.config))
            print(f"stopped after {checkpoints.saved} of {rounds} rounds; go on with --resume {folder}")
            return
        report(summary, folder)
        if options.video and unwanted is None:
            film_policy(run, folder, load_policy(folder / "policies" / f"seed-{options.first_seed}.npz"))


def carry_out(
    options: Options, run: Run, folder: Path, checkpoints: Checkpoints, restored: Checkpoint | None, started: float
) -> dict | None:
    """Trains, writes everything into the folder and returns the summary, or None if a signal stopped it.

    Ends the process with one line if the training diverges or something cannot be written.
    """
    try:
        made_by = provenance()
        remove_partial_files(folder)
        if not (folder / "config.json").exists():
            write_json(folder / "config.json", {"options": dataclasses.asdict(options)} | run.identity() | made_by)
        with stop_on_signal() as stop:
            summary = train(run, folder, checkpoints, restored, stop)
            if summary is not None:
                summary["wall_seconds"]["total"] = time.perf_counter() - started
                write_json(folder / "summary.json", summary | made_by)
        return summary
    except (FloatingPointError, OverflowError) as error:
        last = "none" if checkpoints.saved is None else checkpoints.folder / str(checkpoints.saved)
        fail("run.py", f"the training stops: {error}; the last good checkpoint: {last}", 1)
    except OSError as error:
        fail("run.py", f"the run stops: {error}; go on with --resume {folder}", 1)


def film_policy(run: Run, folder: Path, policy: MeanPolicy) -> None:
    """Writes rollout.mp4, or says in one line why it cannot."""
    try:
        if not isinstance(run.env, FetchEnv):
            raise RuntimeError("the task has no scene to film")
        film(folder / "rollout.mp4", run.env.accurate(), policy)
    except Exception as error:  # whatever rendering or encoding raises, the results are written
        print(f"no video: {str(error).splitlines()[0] if str(error) else type(error).__name__}", file=sys.stderr)


def report(summary: dict, folder: Path) -> None:
    """Prints the outcome."""
    success, distance, seconds = summary["success_rate"], summary["distance_l1"], summary["wall_seconds"]
    print(
        f"success {success['mean']:.3f} ± {success['std']:.3f} (worst seed {min(success['per_seed']):.3f}), "
        f"L1 distance {distance['mean']:.3f} m, {summary['env_steps_per_seed']:,} env steps per seed\n"
        f"compile {seconds['compile']:.1f} s, train {seconds['train']:.1f} s at "
        f"{summary['env_steps_per_second']:,.0f} env steps/s, evaluate {seconds['evaluation']:.1f} s, "
        f"total {seconds['total']:.1f} s -> {folder}"
    )


if __name__ == "__main__":
    cache_compilations()
    sys.path.append(os.getcwd())  # where --task finds a module of the user's own
    main()
