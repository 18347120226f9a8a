"""Trains the detector that finds the target in pictures, and measures the error of its positions."""

import dataclasses
from pathlib import Path
from typing import Annotated

from experiments.localisation.error import measure
from experiments.localisation.figures import draw_examples, draw_sweeps
from experiments.localisation.keypoint_network import load_detector, save_weights
from experiments.localisation.keypoint_training import train
from experiments.localisation.localiser import detect_colour
from experiments.localisation.random_scenes import Studio
from experiments.paths import WEIGHTS
from hgail_envs.validation import MOST_SEED, check_count
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.io.files import write_csv, write_json
from hgail_jax.io.provenance import provenance
from hgail_jax.trainer.folder import create_folder, create_numbered_folder
from hgail_jax.trainer.options import unless_given

_PROGRAM = "localisation"
_LEAST_PICTURES = 64  # one batch


@dataclasses.dataclass(frozen=True)
class _Options:
    seed: int = 0
    """Seed of the scenes and of the training; evaluations never reuse the scenes of a training."""
    out: Annotated[Path | None, unless_given("runs/localisation-<number>", "FOLDER")] = None
    """Folder to write, which must not exist yet."""


@dataclasses.dataclass(frozen=True)
class Train(_Options):
    """Takes pictures of randomised scenes and trains the detector on them: 15 minutes on two CPU cores."""

    pictures: int = 8000
    """Pictures to take and learn from."""
    epochs: int = 8
    """Passes over them."""


@dataclasses.dataclass(frozen=True)
class Evaluate(_Options):
    """Compares the network with the colour detector, without noise and with: tables, curves and examples."""

    scenes: int = 500
    """Scenes of each kind."""
    weights: Annotated[Path | None, unless_given("the repository's", "FILE")] = None
    """The network's weights."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    both = Train | Evaluate  # tyro makes subcommands of a union
    options: Train | Evaluate = parse(both, _PROGRAM, __doc__, arguments)  # type: ignore[arg-type]
    try:
        check_count("seed", options.seed, least=0, most=MOST_SEED)
        if isinstance(options, Train):
            check_count("pictures", options.pictures, least=_LEAST_PICTURES)
            check_count("epochs", options.epochs)
        else:
            check_count("scenes", options.scenes)
            load_detector(options.weights or WEIGHTS)
        Studio().close()  # raises before anything is written if MuJoCo cannot render
        folder = options.out or create_numbered_folder(Path("runs"), "localisation")
        if options.out:
            create_folder(folder)
    except (ValueError, OSError, RuntimeError) as error:
        fail(_PROGRAM, error, 2)
    print(folder, flush=True)
    write_json(folder / "config.json", {"options": dataclasses.asdict(options)} | provenance())
    if isinstance(options, Train):
        _train(options, folder)
    else:
        _evaluate(options, folder)


def _train(options: Train, folder: Path) -> None:
    params, rows = train(options.pictures, options.epochs, options.seed)
    save_weights(folder / "weights.npz", params)
    write_csv(folder / "training.csv", rows)
    last = rows[-1]
    print(
        f"held-out pictures: {last['median_pixels']:.2f} pixels off in the median, {last['p95_pixels']:.2f} at the 95th"
        f" percentile, {last['missed_rate']:.3f} missed, {last['imagined_rate']:.3f} of the hidden ones imagined"
    )


def _evaluate(options: Evaluate, folder: Path) -> None:
    detectors = {"colour": detect_colour, "network": load_detector(options.weights or WEIGHTS)}
    with Studio() as studio:
        table, sweeps, examples = measure(studio, detectors, options.scenes, options.seed)
    write_csv(folder / "errors.csv", table)
    write_csv(folder / "noise.csv", sweeps)
    draw_sweeps(folder / "noise.png", sweeps, "network")
    draw_examples(folder / "examples.png", examples, detectors)
    for row in table:
        print(
            f"{row['target']:6} {row['scenes']:10} cameras {row['cameras']} {row['detector']:7}: median"
            f" {row['median_mm']:.1f} mm, 95 % {row['p95_mm']:.1f} mm, not found {row['not_found_rate']:.3f}"
        )


if __name__ == "__main__":
    with one_line_errors(_PROGRAM):
        prepare_process()
        main()
