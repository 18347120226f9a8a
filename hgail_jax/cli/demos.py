"""Records demonstrations of a task by a scripted controller or a policy."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from hgail_envs import GoalEnv
from hgail_envs.robots import ROBOTS, check_robot
from hgail_envs.validation import MOST_SEED, check_count, check_name, counted
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.parallel import start_server
from hgail_envs.vision.pictures import Pictures
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.cli.policies import find_policies
from hgail_jax.io.demonstrations import save_demonstrations
from hgail_jax.io.files import check_new_file, from_here
from hgail_jax.io.provenance import installed, own_command
from hgail_jax.learners import LEARNERS, PPO
from hgail_jax.lerobot import check_installed
from hgail_jax.play.recording import made_by, make_for_demonstrations, record, successes
from hgail_jax.policy import MeanPolicy
from hgail_jax.terminal import StatusLine, say
from hgail_jax.trainer.train_options import unless_given

PROGRAM = "hgail demos"


@dataclasses.dataclass(frozen=True)
class Options:
    """Records demonstrations of a task by a scripted controller or a policy."""

    task: str = "reach"
    """A task's name, e.g. reach or grasp."""
    policy: Annotated[Path | None, unless_given("the task's scripted controller", "FILE|FOLDER|NAME")] = None
    """The policy that demonstrates it, in the task's reference physics; by name one that comes with the package."""
    learner: Annotated[str | None, unless_given(PPO.name, f"{{{','.join(LEARNERS)}}}")] = None
    """The learner that a controller's demonstrations are for: in grasp td3 sees the cube at each step, ppo once."""
    episodes: int = 100
    """Successful episodes to record; the first of them are the smaller sets."""
    seed: int = 0
    """Seed of the episodes."""
    robot: Annotated[str | None, unless_given("the Fetch, of a task of an arm", "|".join((*ROBOTS, "FILE.toml")))] = (
        None
    )
    """The robot that demonstrates it."""
    format: Annotated[Literal["lerobot"] | None, unless_given("npz", "lerobot")] = None
    """`lerobot` writes a folder, a LeRobotDataset; see docs/lerobot.md."""
    camera: str = ""
    """Cameras of the scene, with commas between them, for pictures (--format lerobot)."""
    picture_size: int = 96
    """Edge of the square pictures, pixels."""
    target: str = "given"
    """Target by its numbers in the observation, `given`, or as a ball in the pictures, `seen`."""
    out: Annotated[Path | None, unless_given("demonstrations/<task>.npz, or <task>", "FILE|FOLDER")] = None
    """File or folder to write, which must not exist."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    path = options.out or Path("demonstrations") / (options.task if options.format else f"{options.task}.npz")
    try:
        check_count("episodes", options.episodes)
        check_count("seed", options.seed, least=0, most=MOST_SEED)
        check_new_file(path)
        if options.robot is not None:
            check_robot(options.robot)
        _check_pictures(options)
        policy = _policy(options)
        learner = options.learner or PPO.name
        check_name("learner", learner, LEARNERS)
        env = make_for_demonstrations(options.task, options.episodes, options.robot, policy, learner)
        if options.camera or options.target != "given":
            cameras = [name.strip() for name in options.camera.split(",") if name]
            env = CameraEnv(env, Pictures(env, cameras, options.picture_size, target=options.target))
            start_server("hgail_jax.lerobot.dataset")
        with StatusLine(f"compiling and running {counted(options.episodes, 'episode')} of {options.task}") as line:
            if options.format:
                _write_dataset(path, env, options, policy, line)
                return
            demonstrations = record(env, options.task, options.episodes, options.seed, policy)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_demonstrations(path, demonstrations)
    except (ValueError, OSError, RenderingError) as error:
        fail(PROGRAM, error, 2)
    say(
        f"{counted(options.episodes, 'successful episode')} of {options.task}:"
        f" return {demonstrations.returns.mean():.1f}, L1 distance {demonstrations.distance_l1.mean():.4f} m -> {path}"
    )


def _check_pictures(options: Options) -> None:
    if options.format:
        check_installed()
    for name in ("camera", "picture_size", "target"):
        chosen = getattr(options, name) != getattr(Options, name)
        if chosen and not options.format:
            raise ValueError(f"--{name.replace('_', '-')} goes with --format lerobot")
        if chosen and not options.camera:
            raise ValueError(f"--{name.replace('_', '-')} goes with --camera")
    if options.picture_size % 2:
        raise ValueError(f"picture-size is {options.picture_size}; a film needs an even one")


def _policy(options: Options) -> MeanPolicy | None:
    """Returns the policy that demonstrates the task, if there is one; a ValueError says that it cannot."""
    if options.policy is None:
        return None
    if options.learner is not None:
        raise ValueError("--learner is for a controller; a policy observes what it did in its training")
    (path, policy), *others = find_policies(options.task, options.policy)
    if others:
        raise ValueError(f"{options.policy} has {1 + len(others)} policies; name one, e.g. {from_here(path)}")
    if not isinstance(policy, MeanPolicy):
        raise ValueError(f"{path} sees pictures; a policy that demonstrates is given positions")
    return policy


def _write_dataset(path: Path, env: GoalEnv, options: Options, policy: MeanPolicy | None, line: StatusLine) -> None:
    from hgail_jax.lerobot.dataset import write_dataset

    trajectory, episodes = successes(env, options.task, options.episodes, options.seed, policy)
    path.parent.mkdir(parents=True, exist_ok=True)
    made = made_by(env, options.seed, policy) | {"command": own_command()}
    made["versions"] |= installed("lerobot")

    def report(written: int) -> None:
        line.show(f"writing, episode {written} of {options.episodes}", log=False)

    write_dataset(path, options.task, env, trajectory, episodes, made, report)
    say(f"{counted(options.episodes, 'successful episode')} of {options.task} -> {path}")
