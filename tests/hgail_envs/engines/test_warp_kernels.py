"""How the kernels of MuJoCo Warp are built, with a stand-in for Warp.

`tests/hgail_envs/fetch/test_warp.py` builds them on a GPU.
"""

import sys
import threading
from types import SimpleNamespace

import pytest

from hgail_envs.engines import warp_kernels
from hgail_envs.engines.warp_kernels import generate_code_in_turn, load_side_by_side, wanted_modules

_MODULES = 4


class Module:
    """A module whose code must be generated while no other's is, and is compiled and loaded while all others' are."""

    generating = 0

    def __init__(self, warp: SimpleNamespace, name: str = "sound") -> None:
        self._warp, self.name = warp, name
        self.kernels: dict[str, object] = {}
        self.functions: dict[str, object] = {}
        self.loaded: list[tuple[str, int | None]] = []

    def load(self, device: str, block_dim: int | None = None) -> "Module | None":
        self.get_module_hash()
        assert self._warp.build.build_cuda(self.name, arch=90, use_precompiled_headers=True) == "compiled"
        self._generate()
        assert self._warp.build.load_cuda(self.name, device) == "handle"
        self.loaded.append((device, block_dim))
        return None if self.name == "failed before" else self

    def get_module_hash(self) -> None:
        self._generate()

    def _generate(self) -> None:
        Module.generating += 1
        threading.Event().wait(0.01)
        assert Module.generating == 1
        Module.generating -= 1


@pytest.fixture
def warp(monkeypatch):
    together = threading.Barrier(_MODULES, timeout=20)

    def build_cuda(name: str, arch: int, use_precompiled_headers: bool) -> str:
        assert arch == 90
        warp.precompiled.add(use_precompiled_headers)
        if name == "broken":
            raise ArithmeticError("cannot be compiled")
        if name == "sound":
            together.wait()
        return "compiled"

    def load_cuda(name: str, device: str) -> str:
        assert device == "cuda:0"
        if name == "sound":
            together.wait()
        return "handle"

    warp = SimpleNamespace(
        build=SimpleNamespace(build_cuda=build_cuda, load_cuda=load_cuda),
        context=SimpleNamespace(Module=Module),
        get_suggested_block_size=lambda kernel, device=None: (768, 132),
        precompiled=set(),
    )
    monkeypatch.setitem(sys.modules, "warp", warp)
    for name in ("build", "context"):
        monkeypatch.setitem(sys.modules, f"warp._src.{name}", getattr(warp, name))
    monkeypatch.setattr(Module, "generating", 0)
    for name in ("load", "get_module_hash"):
        monkeypatch.setattr(Module, name, getattr(Module, name))  # which are put back afterwards
    return warp


def patched(warp):
    return warp.build.build_cuda, warp.build.load_cuda, Module.load, Module.get_module_hash


def test_code_is_generated_for_one_module_at_a_time_and_compiled_and_loaded_for_all_at_once(warp):
    generate_code_in_turn()
    modules = [Module(warp) for _ in range(_MODULES)]
    others = [  # of the program that is traced meanwhile
        threading.Thread(target=modules[0].load, args=["cuda:0"]),
        threading.Thread(target=Module(warp).get_module_hash),
    ]
    for thread in others:
        thread.start()
    load_side_by_side({module: [] for module in modules[1:]}, "cuda:0")
    for thread in others:
        thread.join()
    assert [module.loaded for module in modules] == [[("cuda:0", None)]] * _MODULES
    assert Module.generating == 0
    assert warp.precompiled == {False}  # headers, which each thread would have of its own


def test_a_warp_that_takes_turns_is_left_as_it_is(warp):
    generate_code_in_turn()
    before = patched(warp)
    generate_code_in_turn()
    assert patched(warp) == before


def test_a_newer_warp_is_left_as_it_is(warp):
    warp.context._codegen_lock = object()
    before = patched(warp)
    generate_code_in_turn()
    assert patched(warp) == before


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [("broken", ArithmeticError, "cannot be compiled"), ("failed before", RuntimeError, "'failed before'")],
)
def test_a_module_that_cannot_be_built_is_told_of_and_keeps_no_other_from_it(warp, name, error, message):
    generate_code_in_turn()
    with pytest.raises(error, match=message):
        load_side_by_side({Module(warp, name): []}, "cuda:0")
    load_side_by_side({Module(warp, "alone"): []}, "cuda:0")


def test_what_is_compiled_out_of_turn_leaves_the_turn_alone(warp):
    generate_code_in_turn()
    assert warp.build.build_cuda("alone", arch=90, use_precompiled_headers=True) == "compiled"
    load_side_by_side({Module(warp, "alone"): []}, "cuda:0")


def test_what_a_step_wants_is_noted_and_neither_built_nor_launched(warp):
    one, other = Module(warp, "alone"), Module(warp, "alone")

    def step() -> None:
        assert one.load("cuda:0") is None
        for block_dim in (64, 32, 64):
            assert other.load("cuda:0", block_dim) is None
        assert warp.get_suggested_block_size("kernel of a module that is not built") != (768, 132)

    assert wanted_modules(step) == {one: [], other: [64, 32]}
    assert one.loaded == other.loaded == []


def test_a_module_is_built_for_each_size_of_its_blocks(warp):
    generate_code_in_turn()
    module = Module(warp, "alone")
    load_side_by_side({module: [64, 32]}, "cuda:0")
    assert module.loaded == [("cuda:0", 64), ("cuda:0", 32)]


def test_large_modules_come_first_and_factorisations_which_hold_up_all_others_last(warp, monkeypatch):
    monkeypatch.setattr(warp_kernels, "_COMPILERS", 1)
    built = []
    monkeypatch.setattr(Module, "load", lambda self, device, block_dim: built.append(self.name) or self)
    modules = []
    for name, kernels, functions in [
        ("_friction_dof", 1, 0),
        ("forward", 15, 0),
        ("_update_gradient_cholesky", 1, 0),
        ("_tile_cholesky", 1, 30),
        ("smooth", 47, 3),
        ("sensor", 18, 37),
    ]:
        modules.append(Module(warp, name))
        modules[-1].kernels = dict.fromkeys(map(str, range(kernels)))
        modules[-1].functions = dict.fromkeys(map(str, range(functions)))
    load_side_by_side({module: [] for module in modules}, "cuda:0")
    assert built == ["sensor", "smooth", "forward", "_friction_dof", "_tile_cholesky", "_update_gradient_cholesky"]


def test_no_more_modules_are_loaded_at_a_time_than_there_are_compilers(warp, monkeypatch):
    monkeypatch.setattr(warp_kernels, "_COMPILERS", 2)
    both, under_way, most = threading.Barrier(2, timeout=20), [], []

    def load(module: Module, device: str, block_dim: int | None) -> Module:
        under_way.append(module)
        both.wait()
        threading.Event().wait(0.05)  # for a third to come
        most.append(len(under_way))
        both.wait()
        under_way.remove(module)
        return module

    monkeypatch.setattr(Module, "load", load)
    load_side_by_side({Module(warp, "alone"): [] for _ in range(6)}, "cuda:0")
    assert most == [2] * 6


def test_what_other_threads_load_meanwhile_is_loaded(warp):
    module, suggested = Module(warp, "alone"), []

    def load_and_launch() -> None:
        module.load("cuda:0", 64)
        suggested.append(warp.get_suggested_block_size("kernel"))

    def step() -> None:
        other = threading.Thread(target=load_and_launch)
        other.start()
        other.join()

    assert wanted_modules(step) == {}
    assert module.loaded == [("cuda:0", 64)]
    assert suggested == [(768, 132)]


def test_after_a_step_that_fails_warp_is_as_it_was(warp):
    before = patched(warp), warp.get_suggested_block_size

    def step() -> None:
        raise ArithmeticError("no step")

    with pytest.raises(ArithmeticError, match="no step"):
        wanted_modules(step)
    assert (patched(warp), warp.get_suggested_block_size) == before


def test_of_two_threads_that_note_at_once_none_leaves_warp_changed(warp):
    before, others = (patched(warp), warp.get_suggested_block_size), []

    def step() -> None:
        others.append(threading.Thread(target=wanted_modules, args=[lambda: None]))
        others[0].start()
        others[0].join(timeout=0.1)  # it waits for this one

    wanted_modules(step)
    others[0].join()
    assert (patched(warp), warp.get_suggested_block_size) == before
