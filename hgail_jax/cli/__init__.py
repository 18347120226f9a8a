"""The console command `hgail`; each of its commands is a module here, with a `main` that takes the arguments."""

import importlib
import sys

COMMANDS = {
    "train": "trains seeds of a method on a task and writes the results to a folder",
    "play": "rolls out a trained policy, in the browser, in a viewer or as a film",
    "evaluate": "measures the success of trained policies, with its interval",
    "export": "writes a trained policy for other programs: ONNX, StableHLO, npz or LeRobot",
    "demos": "records demonstrations by a scripted controller or a policy, also as a dataset of LeRobot",
    "robot": "derives the description of an arm of your own from its MJCF",
}
"""Help of each command; its module has its name."""


def main(arguments: list[str] | None = None) -> None:
    """Runs `hgail <command> <options>`, with the process's own arguments unless others are given."""
    from hgail_jax.cli.command_line import fail, one_line_errors, prepare_process

    name, *options = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        with one_line_errors("hgail"):
            width = max(map(len, COMMANDS))
            print("usage: hgail COMMAND [OPTIONS]\n")
            print("\n".join(f"  {command:{width}}  {text}" for command, text in COMMANDS.items()))
            print("\nhgail COMMAND --help lists the options of a command.")
        return
    if name not in COMMANDS:
        fail("hgail", f"there is no command {name!r}; choose from {', '.join(COMMANDS)}", 2)
    with one_line_errors(f"hgail {name}"):
        prepare_process()
        importlib.import_module(f"hgail_jax.cli.{name}").main(options)
