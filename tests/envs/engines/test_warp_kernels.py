"""How the kernels of MuJoCo Warp are built, with a stand-in for Warp; `test_warp.py` builds them on a GPU."""

import sys
import threading
from types import SimpleNamespace

import pytest

from envs.engines.warp_kernels import generate_code_in_turn, load_side_by_side

_MODULES = 4


class Module:
    """A module whose code must be generated while no other's is, and is compiled while all others' are."""

    generating = 0

    def __init__(self, warp: SimpleNamespace, breaks: bool = False) -> None:
        self._warp, self._breaks, self.device = warp, breaks, ""

    def load(self, device: str) -> None:
        self._generate()
        assert self._warp.build.build_cuda("code", arch=90) == "compiled"
        self._generate()
        self.device = device

    def _generate(self) -> None:
        Module.generating += 1
        threading.Event().wait(0.01)
        assert Module.generating == 1
        Module.generating -= 1
        if self._breaks:
            raise RuntimeError("cannot be built")


@pytest.fixture
def warp(monkeypatch):
    together = threading.Barrier(_MODULES, timeout=20)

    def build_cuda(source: str, arch: int) -> str:
        assert (source, arch) == ("code", 90)
        together.wait()
        return "compiled"

    warp = SimpleNamespace(build=SimpleNamespace(build_cuda=build_cuda), context=SimpleNamespace(Module=Module))
    for name, module in vars(warp).items():
        monkeypatch.setitem(sys.modules, f"warp._src.{name}", module)
    monkeypatch.setattr(Module, "generating", 0)
    monkeypatch.setattr(Module, "load", Module.load)  # is put back afterwards
    return warp


def test_code_is_generated_for_one_module_at_a_time_and_compiled_for_all_at_once(warp):
    for _ in range(2):  # once is enough
        generate_code_in_turn()
    modules = [Module(warp) for _ in range(_MODULES)]
    another = threading.Thread(target=modules[0].load, args=["cuda:0"])  # of the program that is traced meanwhile
    another.start()
    load_side_by_side(modules[1:], "cuda:0")
    another.join()
    assert [module.device for module in modules] == ["cuda:0"] * _MODULES


def test_a_warp_that_takes_turns_itself_is_left_as_it_is(warp):
    warp.context._codegen_lock = object()
    before = warp.build.build_cuda, Module.load
    generate_code_in_turn()
    assert (warp.build.build_cuda, Module.load) == before


def test_a_module_that_cannot_be_built_is_told_of(warp):
    generate_code_in_turn()
    with pytest.raises(RuntimeError, match="cannot be built"):
        load_side_by_side([Module(warp, breaks=True)], "cuda:0")
