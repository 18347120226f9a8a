"""Derives the description of an arm of your own from its MJCF or URDF, and shows a scripted pick with it."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import tyro

import hgail_envs
from hgail_envs.robots.derivation import Derived, Given, derive
from hgail_envs.robots.derivation.writing import write_description
from hgail_envs.robots.description import Description
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.io.files import check_new_file, replace_path
from hgail_jax.play.playback import film
from hgail_jax.play.portrait import portrait
from hgail_jax.play.recording import run_controller
from hgail_jax.terminal import StatusLine
from hgail_jax.trainer.train_options import unless_given

PROGRAM = "hgail robot"

_TASK, _CONTROLLER = "pick-and-place", "from-above"
_FILMED = 2  # episodes
_EPISODES = 20  # two are too few to see a bad grip
_ENOUGH = 18


@dataclasses.dataclass(frozen=True)
class Options:
    """Derives the description of an arm of your own from its MJCF or URDF, and shows a scripted pick with it."""

    model: Annotated[Path, tyro.conf.Positional]
    """MJCF or URDF of the arm, or of the arm and its hand."""
    hand: Annotated[Path | None, unless_given("the arm's file has it", "FILE")] = None
    """MJCF or URDF of the hand of a bare arm."""
    flange: Annotated[str, unless_given("none", "NAME")] = ""
    """Site or body of the arm that takes the hand."""
    pads: Annotated[tuple[str, ...], unless_given("the two fingers", "NAME NAME")] = ()
    """Bodies of the two sides that meet, of a hand with more fingers; several of a side with commas between."""
    top_speed: Annotated[tuple[float, ...], unless_given("3.14", "FLOAT [FLOAT ...]")] = ()
    """Of the joints by the data sheet, radians per second: one number, or one for each."""
    torque: Annotated[tuple[float, ...], unless_given("the model's limits", "FLOAT [FLOAT ...]")] = ()
    """Of the joints by the data sheet, N m: one number, or one for each."""
    out: Annotated[Path | None, unless_given("<model>.toml, here", "FILE")] = None
    """Description to write, .toml, which must not exist; a picture and a film get its name with .png and .mp4."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    path = options.out or Path(options.model.name).with_suffix(".toml")
    files = path, path.with_suffix(".png"), path.with_suffix(".mp4")
    try:
        for needed in filter(None, (options.model, options.hand)):
            if not needed.is_file():
                raise ValueError(f"there is no file {needed}")
        if (options.hand is None) != (not options.flange):
            raise ValueError("--hand and --flange go together: the hand's file, and where on the arm it sits")
        check_new_file(path, (".toml",))
        for file in files[1:]:
            check_new_file(file)
        with StatusLine(f"deriving a description of {options.model.name}"):
            given = {field.name: getattr(options, field.name) for field in dataclasses.fields(Given)}
            derived = derive(Given(**given))
        print("\n".join(derived.notes), flush=True)
        picked, shown = _write(derived, *files)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    print(f"the script picks the cube up and brings it to its place in {picked} of {_EPISODES} episodes")
    print(f"{path}{', ' + ', '.join(map(str, files[1:])) if shown else ''}")
    if not picked:
        why = f"look at {files[1]}: is an axis wrong?" if shown else "a picture would show if an axis is wrong"
        fail(PROGRAM, f"the script never picks the cube up; {why}", 1)
    if picked < _ENOUGH:
        print("it should in nearly all: [tool], [hand] or payload in the file may be wrong, see docs/add-a-robot.md")


def _write(derived: Derived, path: Path, picture: Path, video: Path) -> tuple[int, bool]:
    """Writes the three files, or the first alone where MuJoCo cannot render.

    Returns how many episodes succeeded, and whether there are pictures. A failure leaves no file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_path(path) as temporary:
        temporary.write_text(write_description(_beside(derived, path.parent), derived.notes))
        env = hgail_envs.make(_TASK, robot=str(temporary), impl="c")
        controller = env.controllers[_CONTROLLER]
        with StatusLine(f"the script's success in {_EPISODES} episodes"):
            picked = int(np.sum(run_controller(env, _CONTROLLER, _EPISODES, seed=0).outcome.success))
        try:
            with replace_path(picture) as of_picture, replace_path(video) as of_video:
                portrait(of_picture, env)
                film(of_video, env, lambda seen: np.asarray(controller(jnp.asarray(seen))), _FILMED)
                return picked, True
        except RenderingError as error:
            print(f"no picture and no film: {error}")
            return picked, False


def _beside(derived: Derived, folder: Path) -> Description:
    """Returns the description with its models' paths relative to its own folder."""
    arm = derived.description
    model, hand = (
        Path(os.path.relpath(name, folder)).as_posix() if name else "" for name in (arm.model, arm.hand_model)
    )
    return dataclasses.replace(arm, model=model, hand_model=hand)
