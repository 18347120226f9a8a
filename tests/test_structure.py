"""The house is as it is drawn: rooms on floors, short modules and functions, plain words."""

import ast
import functools
import graphlib
import re

import pytest

from tests.support import ROOT

ALGORITHM, TASKS = ROOT / "hgail_jax", ROOT / "envs" / "hgail_envs"
MODULES = sorted([*ALGORITHM.rglob("*.py"), *TASKS.rglob("*.py")])
FLOORS = 11
MODULE_LINES, FUNCTION_LINES = 300, 50
WORDS_PER_WHAT = 1000


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


def imported(node):
    """Yields the full names that a tree imports, but for those that are imported for their types alone."""
    for child in ast.iter_child_nodes(node):
        match child:
            case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Attribute(attr="TYPE_CHECKING")):
                continue
            case ast.Import(names=names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module=module, names=names, level=0):
                yield from (f"{module}.{alias.name}" for alias in names)
        yield from imported(child)


def rooms():
    """Returns the files and folders of `hgail_jax/`, each with those that it imports."""
    found = {
        path.stem: set() for path in ALGORITHM.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    for door in ("__init__", "__main__"):
        del found[door]
    for path in ALGORITHM.rglob("*.py"):
        room = path.relative_to(ALGORITHM).parts[0].removesuffix(".py")
        if room in found:
            parts = (name.split(".") for name in imported(parsed(path)) if name.startswith("hgail_jax."))
            found[room] |= {second for _, second, *_ in parts if second in found and second != room}
    return found


def floors(rooms):
    """Returns the floor of each room, from 1: one above the highest that it imports."""
    numbers = {}
    for room in graphlib.TopologicalSorter(rooms).static_order():
        numbers[room] = 1 + max((numbers[below] for below in rooms.get(room, ())), default=0)
    return numbers


def test_rooms_stand_on_one_another_and_on_few_floors():
    """No room is below one that it stands on: a circle is an error that names it."""
    drawn = rooms()
    assert drawn["trainer"] >= {"config", "seeds"}
    numbers = floors(drawn)
    assert min(numbers.values()) == 1
    assert max(numbers.values()) <= FLOORS, sorted(numbers.items(), key=lambda room: room[1])


def test_a_circle_and_a_high_house_are_seen():
    with pytest.raises(graphlib.CycleError):
        floors({"cellar": {"roof"}, "roof": {"hall"}, "hall": {"cellar"}})
    assert floors({"roof": {"hall", "cellar"}, "hall": {"cellar"}}) == {"cellar": 1, "hall": 2, "roof": 3}


def test_tasks_stand_below_the_algorithm():
    names = {name for path in TASKS.rglob("*.py") for name in imported(parsed(path))}
    assert not {name for name in names if name.startswith("hgail_jax")}


def test_modules_are_short():
    lengths = {path.relative_to(ROOT).as_posix(): len(path.read_text().splitlines()) for path in MODULES}
    assert not {path: lines for path, lines in lengths.items() if lines > MODULE_LINES}


def test_functions_are_short():
    """Their docstrings are not counted."""
    long = {}
    for path in MODULES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[0]
                text = first.end_lineno - first.lineno + 1 if ast.get_docstring(node) is not None else 0
                if (lines := node.end_lineno - node.lineno + 1 - text) > FUNCTION_LINES:
                    long[f"{path.relative_to(ROOT)}: {node.name}"] = lines
    assert not long


def public_docstrings(node):
    """Yields the docstrings of a module, and of its public classes, functions, methods and attributes."""
    if (text := ast.get_docstring(node)) is not None:
        yield text
    for before, child in zip([None, *node.body], node.body, strict=False):
        match child:
            case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                if not name.startswith("_"):
                    yield from public_docstrings(child)
            case ast.Expr(value=ast.Constant(value=str(text))) if isinstance(before, ast.Assign | ast.AnnAssign):
                target = before.target if isinstance(before, ast.AnnAssign) else before.targets[0]
                if not ast.unparse(target).startswith("_"):
                    yield text


def test_documentation_names_things_of_the_field():
    """Where a sentence is about "what" something does, it could mostly have named it."""
    public = [path for path in MODULES if path.stem == "__init__" or not path.stem.startswith("_")]
    texts = {path: public_docstrings(parsed(path)) for path in public}
    words = {path: re.findall(r"[A-Za-z]+", " ".join(text).lower()) for path, text in texts.items()}
    whats = {path.relative_to(ROOT).as_posix(): found.count("what") for path, found in words.items()}
    assert sum(whats.values()) * WORDS_PER_WHAT < sum(map(len, words.values())), {
        path: count for path, count in sorted(whats.items(), key=lambda item: -item[1]) if count
    }
