"""How the kernels of MuJoCo Warp are built, with a stand-in for Warp; `test_warp.py` builds them on a GPU."""

import sys
import threading
from types import ModuleType, SimpleNamespace

import pytest

from envs.engines.warp_kernels import _load_side_by_side

_MODULES = 4


class Module:
    """A module whose code must be generated while no other's is, and compiled while all others' are."""

    generating = 0

    def __init__(self, build: ModuleType, breaks: bool = False) -> None:
        self._build, self._breaks, self.device = build, breaks, ""

    def load(self, device: str) -> None:
        self._generate()
        assert self._build.build_cuda("code", arch=90) == "compiled"
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
def build(monkeypatch):
    together = threading.Barrier(_MODULES, timeout=20)

    def build_cuda(source: str, arch: int) -> str:
        assert (source, arch) == ("code", 90)
        together.wait()
        return "compiled"

    build = SimpleNamespace(build_cuda=build_cuda)
    for name, module in {"warp": SimpleNamespace(), "warp._src": SimpleNamespace(), "warp._src.build": build}.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(Module, "generating", 0)
    return build


def test_modules_are_compiled_at_once_and_their_code_is_generated_one_at_a_time(build):
    modules, compile_cuda = [Module(build) for _ in range(_MODULES)], build.build_cuda
    _load_side_by_side(modules, "cuda:0")
    assert [module.device for module in modules] == ["cuda:0"] * _MODULES
    assert build.build_cuda is compile_cuda


def test_a_module_that_cannot_be_built_is_told_of(build):
    compile_cuda = build.build_cuda
    with pytest.raises(RuntimeError, match="cannot be built"):
        _load_side_by_side([Module(build, breaks=True)], "cuda:0")
    assert build.build_cuda is compile_cuda
