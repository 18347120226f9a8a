"""The house is as it is drawn: rooms on floors, short modules and functions."""

import ast
import functools
import graphlib

from tests.support import ROOT

ALGORITHM, TASKS = ROOT / "hgail_jax", ROOT / "envs" / "hgail_envs"
FLOORS = 9
MODULE_LINES, FUNCTION_LINES = 350, 50


@functools.cache
def parsed():
    """Returns the modules of both packages, by their paths."""
    return {path: ast.parse(path.read_text()) for path in [*ALGORITHM.rglob("*.py"), *TASKS.rglob("*.py")]}


def imported(tree):
    """Returns the full names that a module imports, also within functions, but for its types alone."""
    types = (node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
    for_types = {child for node in types for child in ast.walk(node)}
    nodes = [node for node in ast.walk(tree) if node not in for_types]
    modules = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return modules + [f"{n.module}.{a.name}" for n in nodes if isinstance(n, ast.ImportFrom) for a in n.names]


def used(tree, modules):
    """Returns the packages of these modules, and the functions that a module calls by a plain name."""
    calls = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    return calls | {module.split(".")[0] for module in modules}


def test_rooms_stand_on_one_another_and_on_few_floors():
    """The rooms are the files and folders of `hgail_jax/`, doors included; a circle is an error that names it."""
    rooms = {}
    for path in parsed():
        if path.is_relative_to(ALGORITHM):
            names = [f"{name}.__init__".split(".") for name in imported(parsed()[path])]
            room = path.relative_to(ALGORITHM).parts[0].removesuffix(".py")
            rooms.setdefault(room, set()).update(name for package, name, *_ in names if package == "hgail_jax")
    below = {room: {name if name in rooms else "__init__" for name in rooms[room]} - {room} for room in rooms}
    floors = {}
    for room in graphlib.TopologicalSorter(below).static_order():
        floors[room] = 1 + max((floors[other] for other in below[room]), default=0)
    assert max(floors.values()) <= FLOORS, sorted(floors.items(), key=lambda room: room[1])


def test_the_training_step_stands_on_few_modules_and_no_files():
    """Those of `hgail_jax` that `train.py` imports, and that those import."""
    by_name = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in parsed()}
    reached, ahead = set(), {"hgail_jax.train"}
    while ahead:
        name = ahead.pop()
        reached.add(name)
        modules = imported(parsed()[by_name[name]])
        assert not {"pathlib", "shutil", "signal", "subprocess", "tempfile", "open"} & used(
            parsed()[by_name[name]], modules
        )
        ahead |= {part for module in modules for part in (module, module.rpartition(".")[0])} & by_name.keys() - reached
    assert {"hgail_jax.rollout", "hgail_jax.config"} < reached
    assert len(reached) <= 15, sorted(reached)


def test_tasks_stand_below_the_algorithm():
    assert not [
        path for path in parsed() if path.is_relative_to(TASKS) and "hgail_jax" in str(imported(parsed()[path]))
    ]


def test_modules_and_functions_are_short():
    """Docstrings of functions are not counted."""
    long = [path for path in parsed() if len(path.read_text().splitlines()) > MODULE_LINES]
    for path, tree in parsed().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[ast.get_docstring(node) is not None :]
                if body and body[-1].end_lineno - body[0].lineno >= FUNCTION_LINES:
                    long.append(f"{path}: {node.name}")
    assert not long
