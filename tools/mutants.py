"""Breaks the learning core, one small change at a time, and lists the changes that no test notices.

    python -m tools.mutants [module ...] [--sample N] [--seed S]

A module is named by its path less the suffix, e.g. `hgail_jax/train`. Each mutant runs in a separate process, forked
from this one, which has imported the libraries but started nothing of JAX.
"""

import argparse
import ast
import contextlib
import copy
import importlib.abc
import importlib.util
import itertools
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent

TIMEOUT = 120.0  # seconds
LIBRARIES = ["jax", "brax.training.acme.running_statistics", "brax.envs.base", "flax.linen", "mujoco.mjx", "optax"]
LIBRARIES += ["orbax.checkpoint", "scipy.stats", "pytest"]
SAMPLES, LEARNING, EXPERTS = (f"tests/hgail_jax/test_{name}.py" for name in ("samples", "learning", "experts"))
ROLLOUT, ROUNDS, TRAIN, DIVERGENCE, DISCRIMINATOR = (
    f"tests/hgail_jax/test_{name}.py" for name in ("rollout", "rounds", "train", "divergence", "discriminator")
)
PPO, TD3, CRL = (f"tests/hgail_jax/learners/test_{name}.py" for name in ("ppo", "td3", "crl"))
BUFFER, HINDSIGHT, METHODS = (f"tests/hgail_jax/test_{name}.py" for name in ("buffer", "hindsight", "methods"))
EVALUATE, GOALS = "tests/hgail_jax/cli/test_evaluate.py", "tests/hgail_envs/test_goals.py"
LAYOUT = "tests/hgail_envs/test_layout.py"
MODEL, GRASP, OBJECTS, OBJECT_PARITY, CUBES, STACK, TOWER = (
    f"tests/hgail_envs/tasks/test_{name}.py"
    for name in ("model", "grasp", "objects", "object_parity", "cubes", "stack", "tower")
)

TESTS = {
    "hgail_jax/hindsight": [BUFFER, SAMPLES, HINDSIGHT],
    "hgail_jax/buffer": [BUFFER, TD3, CRL],
    "hgail_jax/samples": [SAMPLES, PPO],
    "hgail_jax/experts": [EXPERTS],
    "hgail_jax/discriminator": [DISCRIMINATOR, PPO],
    "hgail_jax/networks": [PPO, LEARNING],
    "hgail_jax/descent": [PPO, LEARNING],
    "hgail_jax/learners/ppo_loss": [PPO],
    "hgail_jax/learners/ppo": [PPO, ROUNDS, TRAIN, LEARNING],
    "hgail_jax/learners/td3": [TD3],
    "hgail_jax/learners/td3_step": [TD3],
    "hgail_jax/learners/crl": [CRL],
    "hgail_jax/train": [ROUNDS, DIVERGENCE, TRAIN, LEARNING],
    "hgail_jax/rollout": [ROLLOUT, ROUNDS],
    "hgail_jax/evaluate": [ROLLOUT, ROUNDS, TRAIN, EVALUATE],
    "hgail_jax/state": [PPO, ROUNDS, DIVERGENCE, TRAIN, LEARNING],
    "hgail_jax/settings/methods": [LEARNING, EXPERTS, METHODS],
    "envs/hgail_envs/base": [GOALS, SAMPLES, ROLLOUT],
    "envs/hgail_envs/layout": [LAYOUT],
    "envs/hgail_envs/point": [GOALS, ROLLOUT],
    "envs/hgail_envs/tasks/reach": [GOALS],
    "envs/hgail_envs/tasks/grasp": [GOALS, MODEL, GRASP],
    "envs/hgail_envs/tasks/objects": [OBJECTS, OBJECT_PARITY],
    "envs/hgail_envs/tasks/push": [OBJECTS, OBJECT_PARITY],
    "envs/hgail_envs/tasks/pick_and_place": [OBJECTS, OBJECT_PARITY],
    "envs/hgail_envs/tasks/cubes": [CUBES, STACK, TOWER, GOALS, MODEL],
    "envs/hgail_envs/tasks/stack": [CUBES, STACK],
    "envs/hgail_envs/tasks/tower": [CUBES, TOWER],
}
"""What is run for a module, the quickest first."""

_SWAPS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn,
    ast.NotIn: ast.In, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
}  # fmt: skip
_BOUNDARIES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_NAMES = {"minimum": "maximum", "min": "max", "argmin": "argmax", "any": "all", "zeros_like": "ones_like"}
_NAMES |= {other: name for name, other in _NAMES.items()}
_NOT_CODE = {"annotation", "returns", "decorator_list", "type_params"}
_CHECKS = {"__post_init__", "validate", "_check"}


class Mutant(NamedTuple):
    """A module with one change."""

    module: str
    line: int
    text: str
    """The line as changed."""
    source: str


def mutants(module: str) -> list[Mutant]:
    """Returns the mutants of a module, in the order of its lines."""
    source = (ROOT / f"{module}.py").read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = {}
    for node in _code(ast.parse(source)):
        for change in _changes(node):
            start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            changed = (source[:start] + change.encode() + source[end:]).decode()
            text = changed.splitlines()[node.lineno - 1].strip()
            found[changed] = Mutant(module, node.lineno, text, changed)
    return sorted(found.values(), key=lambda mutant: mutant.line)


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Yields what is below a node, less types, messages, documentation and checks of what comes from outside."""
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and name not in _NOT_CODE and not _is_text(child):
                yield child
                yield from _code(child)


def _is_text(node: ast.AST) -> bool:
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.Expr(value=ast.Constant()) | ast.Import() | ast.ImportFrom():
            return True
        case ast.FunctionDef(name=name):
            return name in _CHECKS
        case ast.Assign(value=ast.Subscript(value=ast.Name(id="Callable"))) | ast.Call(func=ast.Name(id="isinstance")):
            return True
    return False


def _changes(node: ast.AST) -> Iterator[str]:
    """Yields what may stand in a node's place."""

    def but(**fields) -> str:
        changed = copy.copy(node)
        for name, value in fields.items():
            setattr(changed, name, value)
        return ast.unparse(changed)

    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in _SWAPS:
            yield f"({but(op=_SWAPS[type(op)]())})"
        case ast.Compare(ops=[op]):
            for swaps in (_SWAPS, _BOUNDARIES):
                if type(op) in swaps:
                    yield f"({but(ops=[swaps[type(op)]()])})"
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield f"({ast.unparse(operand)})"
        case ast.Constant(value=bool(value)):
            yield str(not value)
        case ast.Constant(value=int(value)):
            yield str({0: 1, 1: 0}.get(value, value - 1 if value < 10 else 2 * value))
        case ast.Constant(value=float(value)):
            yield str({0.0: 1.0, 1.0: 0.0}.get(value, 2.0 * value))
        case ast.Name(id=name) if name in _NAMES:
            yield _NAMES[name]
        case ast.Attribute(attr=name) if name in _NAMES:
            yield but(attr=_NAMES[name])
        case ast.Call(func=function, args=args, keywords=keywords):
            if ast.unparse(function) == "jnp.where":
                yield but(args=[args[0], args[2], args[1]])
            for index, keyword in enumerate(keywords):
                if keyword.arg is not None:
                    yield but(keywords=keywords[:index] + keywords[index + 1 :])
            for index, arg in enumerate(args):
                other = args[(index + 1) % len(args)]
                if all(isinstance(each, ast.Name | ast.Attribute) for each in (arg, other)) and other is not arg:
                    yield but(args=[*args[:index], other, *args[index + 1 :]])


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the mutant in its module's place."""

    def __init__(self, mutant: Mutant):
        self.path, self.source = f"{mutant.module}.py", mutant.source
        self.name = mutant.module.removeprefix("envs/").replace("/", ".")

    def find_spec(self, name, path, target=None):
        return importlib.util.spec_from_loader(name, self, origin=self.path) if name == self.name else None

    def exec_module(self, module):
        module.__file__ = str(ROOT / self.path)
        exec(compile(self.source, self.path, "exec"), module.__dict__)


def run(files: list[str], mutant: Mutant | None = None) -> str:
    """Runs tests in a separate process; returns "killed", "survived" or "timed out"."""
    import pytest

    child = os.fork()
    if child == 0:
        os.setsid()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        code = 1
        with contextlib.suppress(BaseException):
            if mutant is not None:
                import jax

                jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)  # mutants leave nothing behind
                sys.meta_path.insert(0, _Mutated(mutant))
            code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *files]))
        os._exit(code)
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return "survived" if status == 0 else "killed"
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "timed out"


def main() -> None:
    """Reads the command line, runs the mutants and reports."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", default=list(TESTS))
    parser.add_argument("--sample", type=int, help="so many mutants in all, spread over the modules; default all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))  # as in conftest.py
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"  # JAX reads both when it is imported
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for name in LIBRARIES:
        importlib.import_module(name)
    tests = {module: TESTS[module] for module in options.modules}
    broken = {file for file in sorted({*itertools.chain(*tests.values())}) if run([file]) != "survived"}
    for file in sorted(broken):
        print(f"left out, fails without a mutant: {file}", flush=True)
    chosen = [mutant for module in tests for mutant in mutants(module)]
    if options.sample is not None:
        picked = random.Random(options.seed).sample(range(len(chosen)), min(options.sample, len(chosen)))
        chosen = [chosen[index] for index in sorted(picked)]
    ends: dict[Mutant, str] = {}
    for mutant in chosen:
        start = time.monotonic()
        ends[mutant] = run([file for file in tests[mutant.module] if file not in broken], mutant)
        print(f"{ends[mutant]:9} {time.monotonic() - start:5.1f} s  {_at(mutant)}", flush=True)
    print()
    for module in (*tests, None):
        of_module = [end for mutant, end in ends.items() if module in (None, mutant.module)]
        killed = sum(end != "survived" for end in of_module)
        print(f"{module or 'in all':25} {killed:4} of {len(of_module):4} killed")
    print("\nSurvivors:", *(_at(mutant) for mutant, end in ends.items() if end == "survived"), sep="\n")


def _at(mutant: Mutant) -> str:
    return f"{mutant.module}.py:{mutant.line}: {mutant.text[:160]}"


if __name__ == "__main__":
    main()
