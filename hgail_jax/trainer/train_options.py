"""Options of a training, and the run that they ask for on a platform."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

import hgail_envs
from hgail_envs.engines import ENGINES
from hgail_envs.randomization import LEVELS
from hgail_envs.randomized import randomize
from hgail_envs.registry import check_takes_robot
from hgail_envs.robots import ROBOTS
from hgail_envs.validation import check_count, check_name, parse_option
from hgail_envs.vision.cameras import DEFAULT_CAMERAS
from hgail_envs.vision.look import LOOKS
from hgail_envs.vision.pictures import KINDS, RENDERERS, SIZE, TARGETS
from hgail_jax.config import REWARDS, STRATEGIES
from hgail_jax.devices.processes import choose_mesh
from hgail_jax.learners import LEARNERS, PPO
from hgail_jax.learners.student import Student
from hgail_jax.lerobot import find_demonstrations
from hgail_jax.seeds import check_seeds
from hgail_jax.settings.defaults import EVALUATION_EPISODES, default_learner, task_preset
from hgail_jax.settings.methods import METHODS, method_of
from hgail_jax.settings.presets import PRESETS, Preset, asymmetric
from hgail_jax.trainer.camera import is_taught, kept_teacher, refuse_camera_options, refuse_missing_teacher, with_camera
from hgail_jax.trainer.folder import resumed_folder
from hgail_jax.trainer.loggers import LOGGERS, check_loggers
from hgail_jax.trainer.run import Run

OBSERVED = ("positions", "camera")
"""What a policy may see of the objects: their positions, or pictures of them."""
_PHYSICS = ("impl", "substeps", "worlds")
"""Options of a task that are options of `TrainOptions`, or follow from them."""
_OF_DISCRIMINATOR = ("discriminator_", "negative_", "goal_jitter", "shuffled_goals")
"""Beginnings of the names of sizes and hyperparameters of the discriminator and its samples."""
_EPISODES = f"{EVALUATION_EPISODES['cpu']} on a CPU, {EVALUATION_EPISODES['gpu']} on a GPU"


def _choices(text: str, names: Any) -> Any:
    return tyro.conf.arg(help=f"{text}: {', '.join(names)}.")


def unless_given(default: str, metavar: str) -> Any:
    """Returns the marker of an option that is None by default, for which its help shows `default`."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {default})", metavar=metavar)


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Trains several seeds of a method on a task, side by side, and writes the results to a new folder."""

    task: str = "reach"
    """A task's name, or module:Class for a GoalEnv of your own."""
    method: Annotated[str | None, unless_given("the task's", f"{{{','.join(METHODS)}}}")] = None
    """Method to train."""
    learner: Annotated[str | None, unless_given("the task's", f"{{{','.join(LEARNERS)}}}")] = None
    """How roll-outs change the networks: ppo uses each once, td3 and crl keep them in a replay buffer. With --observe
    camera td3 learns without a teacher."""
    demos: Annotated[Path | None, unless_given("none", "FILE|FOLDER")] = None
    """Demonstrations of the task, from the command demos, or a LeRobotDataset's folder; gail-demo needs them."""
    seeds: int = 8
    """Number of seeds, trained side by side."""
    first_seed: int = 0
    """The first seed; the others count up from it."""
    num_envs: Annotated[int | None, unless_given("the task's for the platform", "INT")] = None
    """Environments per seed, that is episodes per roll-out."""
    rounds: Annotated[int | None, unless_given("the task's for the platform", "INT")] = None
    """Rounds of the adversarial training. 0 leaves the pre-training alone."""
    preset: Annotated[str, _choices("Sizes and schedule", PRESETS)] = "parallel"
    pretrain: Annotated[bool | None, unless_given("the method's", "| --no-pretrain")] = None
    """Fit policy and discriminator to the first roll-out before the rounds begin."""
    robot: Annotated[str, _choices("Robot of the tasks of an arm", (*ROBOTS, "FILE.toml of hgail robot"))] = "fetch"
    impl: Annotated[str, _choices("Physics engine of the tasks of an arm", ["auto", *ENGINES])] = "auto"
    substeps: Annotated[int | None, unless_given("the task's", "INT")] = None
    """Physics steps per action in training, 4 to 20. The final evaluation has 20."""
    randomize: Annotated[str, _choices("How much each episode is randomised, see docs/robust.md", LEVELS)] = "none"
    observe: Annotated[str, _choices("What the policy sees of the objects", OBSERVED)] = "positions"
    teacher: Annotated[Path | None, unless_given("trained first", "FILE")] = None
    """Policy that sees positions, to teach one that sees pictures (--observe camera)."""
    camera: str = ",".join(DEFAULT_CAMERAS)
    """Cameras of the scene, with commas between them (--observe camera)."""
    picture_size: int = SIZE
    """Edge of the square pictures, pixels (--observe camera)."""
    picture_kind: Annotated[str, _choices("What a picture shows (--observe camera)", KINDS)] = "colour"
    look: Annotated[str, _choices("How the look of the scene varies in training (--observe camera)", LOOKS)] = "varied"
    renderer: Annotated[str, _choices("Renderer of the pictures (--observe camera)", ["auto", *RENDERERS])] = "auto"
    target: Annotated[str, _choices("Target by numbers or as a ball to be seen (--observe camera)", TARGETS)] = "given"
    task_options: tuple[str, ...] = ()
    """Further options of the task, as name=value: a number, true, false or a word."""
    p_ht: Annotated[float | None, unless_given("the method's", "FLOAT")] = None
    """Probability that hindsight replaces a step's goal, 0 to 1."""
    strategy: Annotated[str | None, unless_given("the task's", f"{{{','.join(STRATEGIES)}}}")] = None
    """Hindsight takes goals from the steps that follow (future), or from the last one (final)."""
    reward: Annotated[str | None, unless_given("the task's", f"{{{','.join(REWARDS)}}}")] = None
    """Form of the reward that is made of the discriminator's logit, see `hgail_jax.discriminator`."""
    standardize_reward: Annotated[bool | None, unless_given("the task's", "| --no-standardize-reward")] = None
    """Shift and scale the reward to mean 0 and standard deviation 1 over each roll-out."""
    environment_reward: Annotated[float | None, unless_given("the task's", "FLOAT")] = None
    """Weight of the environment's reward, the discriminator's has the rest. With TD3 1 is the method her."""
    bc_weight: Annotated[float | None, unless_given("the task's", "FLOAT")] = None
    """Weight of the behaviour-cloning (BC) loss in the policy's updates, 0 for the paper's: PPO clones expert samples,
    TD3 actions of the buffer that its critics prefer."""
    exploration_noise: Annotated[tuple[float, ...] | None, unless_given("the task's", "FLOAT [FLOAT ...]")] = None
    """Standard deviation of the policy, one number or one for each of the action's."""
    settings: tuple[str, ...] = ()
    """Fields of Config, its learner or Hyperparameters that have no option, as name=value, e.g. tau=0.01."""
    devices: Annotated[int | None, unless_given("one, or all of several processes", "INT")] = None
    """Devices to spread seeds, and then environments, over."""
    out: Annotated[Path | None, unless_given("runs/<task>-<method>-<number>", "FOLDER")] = None
    """Folder to write, which must not exist."""
    resume: Annotated[str | None, unless_given("begins a run", "FOLDER|auto")] = None
    """Folder of a run to resume; auto takes the run of the task and method in runs/ that was saved last, or
    begins one."""
    checkpoint_every: int = 1
    """Rounds from one checkpoint to the next; more where saving would take a twentieth of the time."""
    evaluate_every: Annotated[int | None, unless_given("the task's for the platform", "INT")] = None
    """Rounds from one evaluation to the next; the last round always has one. Training does not depend on it."""
    evaluation_episodes: Annotated[int | None, unless_given(_EPISODES, "INT")] = None
    """Episodes per seed in the final evaluation, rounded up to whole roll-outs."""
    logger: Annotated[str, _choices("Where measurements go, several with commas between them", LOGGERS)] = "csv"


def choose(
    task: str, platform: str, method: str | None, preset: str, learner: str | None, randomize: str = "none"
) -> Preset:
    """Returns a task's settings under a method and a learner, None for its own; a ValueError if they do not fit."""
    check_name("randomize", randomize, LEVELS)
    with _one_error(f"cannot load task {task!r}"):
        task_class = hgail_envs.find_class(task)
    if method is not None:
        check_name("method", method, METHODS)
    if learner is not None:
        check_name("learner", learner, LEARNERS)
        if method is not None:
            check_name(f"learner of the method {method}", learner, METHODS[method].learners)
    else:
        learner = default_learner(task_class) if preset == "parallel" else PPO.name
        if method is not None and learner not in METHODS[method].learners:
            learner = METHODS[method].learners[0]
    level = LEVELS[randomize]
    found = task_preset(task_class, platform, preset, learner, randomized=level != level.nominal())
    chosen = method or found.method
    return dataclasses.replace(METHODS[chosen].apply(found), method=chosen)


def task_defaults(platform: str, **options: Any) -> dict[str, Any]:
    """Returns the task's, or the method's, values of the options that are None by default."""
    chosen = _choose(TrainOptions(**options), platform)
    config, hyperparameters, physics = chosen.config, chosen.hyperparameters, chosen.task_options
    values = {
        "method": chosen.method,
        **({"learner": config.learner.name} if config.learner.name in LEARNERS else {}),
        "num_envs": config.num_envs,
        "rounds": config.rounds,
        **({"substeps": physics["substeps"]} if "substeps" in physics else {}),
        "p_ht": hyperparameters.p_ht,
        "environment_reward": hyperparameters.environment_reward,
        "bc_weight": hyperparameters.bc_weight if getattr(config.learner, "bc_batch", 1) else 0,
        "exploration_noise": " ".join(map(str, np.ravel(hyperparameters.exploration_noise))),
    }
    method = method_of(chosen)
    refused = method.without_effect + method.decides
    return {name: value for name, value in values.items() if name not in refused}


def plan(options: TrainOptions, platform: str) -> Run:
    """Returns the run that the options ask for on a platform, `"cpu"` or `"gpu"`; a ValueError names what it cannot.

    It is a MissingTeacherError where all is well but that a teacher is neither named nor in the folder to resume.
    """
    started = time.perf_counter()
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined, unused-ignore]  # declared from JAX 0.11 on
        raise ValueError("JAX_ENABLE_X64 is set, and training is in float32; unset it")
    _check(options)
    chosen = _choose(options, platform)
    _refuse_without_effect(options, chosen)
    if is_taught(options) and options.teacher is None:
        resumed = resumed_folder(options.task, chosen.method, options.resume)
        options = dataclasses.replace(options, teacher=resumed and kept_teacher(resumed))
    preset = _with_options(options, chosen)
    if preset.hyperparameters.p_ht == 0.0 and options.strategy is not None:
        raise ValueError("--strategy changes nothing where p_ht is 0, which replaces no goal")
    mesh = choose_mesh(options.seeds, preset.config.num_envs, options.devices)
    defaults = {name: value for name, value in preset.task_options.items() if name not in _PHYSICS}
    task_options = defaults | dict(_parse_task_option(option) for option in options.task_options)
    if options.robot != TrainOptions.robot:
        task_options["robot"] = options.robot
    worlds = options.seeds * preset.config.num_envs // mesh.size
    env = _make(options, preset.task_options, worlds, task_options)
    if options.task not in hgail_envs.TASKS:  # those have tests
        hgail_envs.check_task(env)
    env = randomize(env, options.randomize)
    if options.observe == "camera":
        env = with_camera(env, options, mesh.size)
    demonstrations = None if options.demos is None else find_demonstrations(options.demos, options.task, env)
    if (demonstrations is None) != (preset.method != "gail-demo"):
        raise ValueError("--demos goes with the method gail-demo, which needs it; the command demos makes such a file")
    run = Run(
        task=options.task,
        method=preset.method,
        seeds=options.seeds,
        first_seed=options.first_seed,
        env=env,
        task_options=task_options,
        config=preset.config.validate(env),
        settings=(preset.hyperparameters.validate(env.action_size, preset.config),),
        evaluation_episodes=options.evaluation_episodes or EVALUATION_EPISODES[platform],
        checkpoint_every=options.checkpoint_every,
        evaluate_every=options.evaluate_every or preset.evaluate_every,
        mesh=mesh,
        demonstrations=None if demonstrations is None else demonstrations.samples(env),
        demonstrations_sha256=None if demonstrations is None else demonstrations.sha256,
        teacher=None if options.teacher is None else Path(options.teacher),
        loggers=check_loggers(options.logger),
        options=dataclasses.asdict(options),
        started=started,
    )
    if is_taught(options) and options.teacher is None:  # all else is checked
        refuse_missing_teacher()
    return run


def _choose(options: TrainOptions, platform: str) -> Preset:
    if is_taught(options):
        with _one_error(f"cannot load task {options.task!r}"):
            return task_preset(hgail_envs.find_class(options.task), platform, learner=Student.name)
    preset = choose(options.task, platform, options.method, options.preset, options.learner, options.randomize)
    return asymmetric(preset, platform) if options.observe == "camera" else preset


def _check(options: TrainOptions) -> None:
    check_name("observe", options.observe, OBSERVED)
    if options.observe != "camera":
        refuse_camera_options(vars(options), vars(TrainOptions()))
    check_seeds(options.first_seed, options.seeds)
    for name in ("checkpoint_every", "evaluate_every", "evaluation_episodes", "rounds"):
        if getattr(options, name) is not None:
            check_count(name, getattr(options, name), least=int(name != "rounds"))
    for name, values in (("strategy", STRATEGIES), ("reward", REWARDS)):
        if getattr(options, name) is not None:
            check_name(name, getattr(options, name), values)
    if options.resume == "":
        raise ValueError("resume is ''; it must be a run's folder, or auto")
    if options.resume is not None and options.out is not None:
        raise ValueError("--resume and --out exclude each other; a run resumes in its own folder")


def _refuse_without_effect(options: TrainOptions, preset: Preset) -> None:
    name, learner, method = preset.method, preset.config.learner, method_of(preset)
    others = "" if options.method else ", the task's default; name another by --method"
    for names, why in (
        (method.without_effect, f"changes nothing for the method {name}"),
        (learner.without_effect, f"changes nothing for the learner {learner.name}"),
        (method.decides, f"is decided by the method {name}{others}"),
    ):
        for option in names:
            if (value := getattr(options, option)) != getattr(TrainOptions, option):
                flag = ("no-" if value is False else "") + option.replace("_", "-")
                raise ValueError(f"--{flag} {why}")
    if options.resume is not None and not learner.resumes:
        raise ValueError(f"--resume: a run of the learner {learner.name} keeps no checkpoint")


def _with_options(options: TrainOptions, preset: Preset) -> Preset:
    """Returns a method's preset with the sizes and hyperparameters that are given."""
    sizes: dict[str, Any] = {name: getattr(options, name) for name in ("num_envs", "rounds", "pretrain")}
    if options.bc_weight is not None:
        sizes["learner"] = preset.config.learner.with_bc(options.bc_weight)
    std = options.exploration_noise
    plain = ("p_ht", "environment_reward", "bc_weight", "standardize_reward")
    scalars = {name: getattr(options, name) for name in plain} | {
        "exploration_noise": std[0] if isinstance(std, tuple) and len(std) == 1 else std,
        "strategy": options.strategy and STRATEGIES[options.strategy],
        "reward": options.reward and REWARDS[options.reward],
    }
    for name, value in map(_parse_setting, options.settings):
        _check_effect(name, preset)
        (scalars if name in vars(preset.hyperparameters) else sizes)[name] = value
    hyperparameters = preset.hyperparameters.replace(**_given(scalars))
    return dataclasses.replace(preset, config=preset.config.replace(**_given(sizes)), hyperparameters=hyperparameters)


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


@contextlib.contextmanager
def _one_error(fault: str) -> Iterator[None]:
    """Turns errors of any type, as a user's task raises them, into a ValueError."""
    try:
        yield
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"{fault}: {error}") from error


def _make(options: TrainOptions, defaults: Any, worlds: int, task_options: dict[str, Any]) -> hgail_envs.GoalEnv:
    """Makes the task; `defaults` have the physics that it is trained with unless other is given."""
    accepted = hgail_envs.accepted_options(options.task)
    given = {"impl": options.impl, "worlds": worlds} | defaults | _given({"substeps": options.substeps})
    if (options.substeps is not None or options.impl != "auto") and not {"substeps", "impl"} <= set(accepted):
        raise ValueError(f"--substeps and --impl are for the tasks of an arm; {options.task!r} is none")
    if "robot" in task_options:
        check_takes_robot(options.task)
    with _one_error(f"cannot make task {options.task!r}"):
        return hgail_envs.make(options.task, **{name: given[name] for name in accepted if name in given} | task_options)


def _check_effect(name: str, preset: Preset) -> None:
    """Raises a ValueError for a setting that nothing reads."""
    config = preset.config
    if name in config.learner.ignored:
        raise ValueError(f"--settings {name} changes nothing for the learner {config.learner.name}")
    if not config.discriminator_minibatches and name.startswith(_OF_DISCRIMINATOR):
        method = f"the method {preset.method}, which has no discriminator"
        raise ValueError(f"--settings {name} changes nothing for {method}")


def _parse_setting(setting: str) -> tuple[str, Any]:
    """Splits `name=value`; a list becomes a tuple, as `Config` has the widths of networks."""
    name, _, text = setting.partition("=")
    if name in {field.name for field in dataclasses.fields(TrainOptions)}:
        raise ValueError(f"setting {setting!r}: {name} is --{name.replace('_', '-')} here")
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, bool | int | float | list):
        raise ValueError(f"setting {setting!r} is not name=value with a number, true, false or a list of numbers")
    return name, tuple(value) if isinstance(value, list) else value


def _parse_task_option(option: str) -> tuple[str, Any]:
    name, value = parse_option("task", option)
    if name in (*_PHYSICS, "robot"):
        instead = "follows from the numbers of seeds and environments" if name == "worlds" else f"is --{name} here"
        raise ValueError(f"task option {option!r}: {name} {instead}")
    return name, value
