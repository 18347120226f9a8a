"""Writes a trained policy for other programs: as ONNX, as StableHLO, or as npz for NumPy."""

import dataclasses
import importlib.util
import json
import os
import re
from pathlib import Path
from typing import Annotated

from hgail_envs.randomization import LEVELS
from hgail_envs.validation import check_name
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.cli.policies import DEFAULT_TASK, find_policies
from hgail_jax.io.export import export_onnx, export_policy
from hgail_jax.io.files import check_writable, from_here
from hgail_jax.io.policy import save_policy
from hgail_jax.trainer.options import unless_given

PROGRAM = "hgail export"
FORMATS = {".onnx": "ONNX", ".mlirbc": "StableHLO", ".npz": "npz"}
"""Formats, by the end of a file's name."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Writes a trained policy for other programs; the end of the file's name decides the format."""

    task: Annotated[str | None, unless_given(f"the task of --policy, or {DEFAULT_TASK}", "STR")] = None
    """A task's name, or 'module:Class' of your own."""
    policy: Annotated[Path | None, unless_given("one that comes with the package", "FILE|FOLDER")] = None
    """The policy's file, or the folder of a run of one seed. Of those that come with the package the plain one, or with
    --randomize the robust one, if there is one."""
    randomize: Annotated[str | None, unless_given("the plain policy", "|".join(LEVELS))] = None
    """Level that chooses the robust one of the policies that come with the package."""
    out: Annotated[Path | None, unless_given("<task>.onnx", "FILE")] = None
    """File to write, which must not exist: .onnx (extra `onnx`), .mlirbc for StableHLO, or .npz."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    try:
        if options.randomize is not None:
            check_name("randomize", options.randomize, LEVELS)
        # The task's own code is not needed, so that a file's task may be any.
        task = options.task or (DEFAULT_TASK if options.policy is None else None)
        found = find_policies(task, options.policy, options.randomize)
        if len(found) > 1:
            raise ValueError(f"{options.policy} has {len(found)} policies; name one, e.g. {from_here(found[0][0])}")
        path, policy = found[0]
        out = options.out or Path(f"{policy.task.replace(':', '.')}.onnx")
        _check_file(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.suffix == ".onnx":
            export_onnx(out, policy, _success(path))
        else:
            {".mlirbc": export_policy, ".npz": save_policy}[out.suffix](out, policy)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    print(f"policy {from_here(path)} as {FORMATS[out.suffix]} -> {out}")


def _check_file(path: Path) -> None:
    """Refuses a file that exists or cannot be written, or a format that there is not or lacks its package."""
    if path.suffix not in FORMATS:
        raise ValueError(f"{path} is not the name of a policy to write; it must end in {', '.join(FORMATS)}")
    if os.path.lexists(path):
        raise ValueError(f"{path} exists already; name another file, or remove it")
    check_writable(path)
    if path.suffix == ".onnx" and importlib.util.find_spec("onnx") is None:
        raise ValueError("ONNX needs the package onnx: pip install 'hgail-jax[onnx]'")


def _success(path: Path) -> float | None:
    """Returns the success of a policy in the final evaluation of its run, if it lies in the run's folder."""
    folder, seed = path.parent.parent, re.fullmatch(r"seed-(\d+)", path.stem)
    try:
        rates = json.loads((folder / "summary.json").read_text())["success_rate"]["per_seed"]
        seeds = sorted(int(file.stem.removeprefix("seed-")) for file in path.parent.glob("seed-*.npz"))
        return float(rates[seeds.index(int(seed[1]))]) if seed and len(rates) == len(seeds) else None
    except (OSError, ValueError, LookupError, TypeError):
        return None
