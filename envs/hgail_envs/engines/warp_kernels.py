"""Builds the kernels of MuJoCo Warp side by side, before the first step needs them.

By itself Warp builds a module of kernels when one of them is first launched, one module after another, on a fresh
machine most of a minute. It has no public function for more, so that its internals are wrapped here. On two CPU cores
reach's kernels compile in 13 s eight at a time and in 21 s one by one (`docs/lab/starts.md`). Without precompiled
headers they took 13 s instead of 22 s on two CPU cores, in 32 threads of NVRTC alone (commit 7782f36).
"""

import functools
import importlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import mujoco

_PACKAGE = "mujoco.mjx.third_party.mujoco_warp"
_CALLED_BY_JAX = "mujoco.mjx.warp.ffi"  # has no kernels, but Warp builds it all the same
_SOME_BLOCK = 256  # threads
_COMPILERS = 8  # at a time, each with memory of its own; on 32 cores 16 may be a little faster, 32 are not
_PATCHING = threading.Lock()


def build_kernels(model: mujoco.MjModel, sizes: dict[str, int]) -> None:
    """Builds the kernels of a model's physics step, or finds them in Warp's cache.

    A step of one world, outside of any program, first only records the modules that it launches. They are built side by
    side, and then the step is taken.

    Args:
      model: the scene.
      sizes: bounds of the buffers, see `hgail_envs.engines.mjx.buffer_sizes`; the number of rows is in the kernels.

    Raises:
      Exception: Warp's own, if a module cannot be built.

    """
    warp, mujoco_warp = importlib.import_module("warp"), importlib.import_module(_PACKAGE)
    with warp.ScopedDevice(warp.device_from_jax(jax.local_devices()[0])) as device:
        warp_model, data = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=1, **sizes)

        def step() -> None:
            mujoco_warp.step(warp_model, data)

        # A conditional graph ends when a kernel says so, and none is launched yet: the solver would wait for ever.
        warp_model.opt.graph_conditional = False
        wanted: dict[Any, list[int]] = {warp.get_module(_CALLED_BY_JAX): []} | wanted_modules(step)
        warp_model.opt.graph_conditional = True
        load_side_by_side(wanted, device)
        step()
        warp.synchronize_device(device)


def wanted_modules(function: Callable[[], None]) -> dict[Any, list[int]]:
    """Returns the modules of a function's launches, with the sizes of their blocks; nothing is launched."""
    warp: Any = importlib.import_module("warp")
    module_class: Any = importlib.import_module("warp._src.context").Module
    wanted: dict[Any, list[int]] = {}
    own_thread = threading.get_ident()

    def note(module: Any, device: Any, block_dim: int | None = None, **options: Any) -> Any:
        if threading.get_ident() != own_thread:  # another's launch, which must happen
            return load(module, device, block_dim, **options)
        block_dims = wanted.setdefault(module, [])
        if block_dim is not None and block_dim not in block_dims:
            block_dims.append(block_dim)
        return None  # for which Warp launches nothing

    def suggest_some(kernel: Any, device: Any = None) -> tuple[int, int]:  # without its module, which is not built yet
        return suggest(kernel, device) if threading.get_ident() != own_thread else (_SOME_BLOCK, 1)

    with _PATCHING:
        load, suggest = module_class.load, warp.get_suggested_block_size
        module_class.load, warp.get_suggested_block_size = note, suggest_some
        try:
            function()
        finally:
            module_class.load, warp.get_suggested_block_size = load, suggest
    return wanted


def generate_code_in_turn() -> None:
    """Has Warp generate code for one module at a time, while others may be compiled or loaded onto the GPU.

    Warp 1.14 keeps its state of a function in one place for all modules that call it. Of two threads that build such
    modules at once, one now and then writes code that does not compile (NVIDIA/warp#1474). Call it before there are
    such threads; a second call changes nothing. Later versions, which take turns themselves, are left as they are.
    Modules compiled from then on have no precompiled headers, see `_without_precompiled_headers`.
    """
    context: Any = importlib.import_module("warp._src.context")
    compiler: Any = importlib.import_module("warp._src.build")
    with _PATCHING:
        if hasattr(context, "_codegen_lock") or hasattr(compiler.build_cuda, "turn"):
            return
        turn = _Turn()
        compiler.build_cuda = turn.given_up_in(_without_precompiled_headers(compiler.build_cuda))
        compiler.load_cuda = turn.given_up_in(compiler.load_cuda)
        for name in ("load", "get_module_hash"):  # either may generate code
            setattr(context.Module, name, turn.taken_in(getattr(context.Module, name)))


def _without_precompiled_headers(build: Callable) -> Callable:
    """Returns Warp's compilation of a module without precompiled headers.

    Warp precompiles headers for each thread, and several threads map and unmap so much memory then that all wait for
    it. Warp's own setting for it would change the modules' hashes, and cached kernels would be built again.
    """

    @functools.wraps(build)
    def build_plainly(*args: Any, **options: Any) -> Any:
        return build(*args, **options | {"use_precompiled_headers": False})

    return build_plainly


class _Turn:
    """Lock that some functions take, and that others give up while they are called from these."""

    def __init__(self) -> None:
        self._lock, self._of_this_thread = threading.Lock(), threading.local()

    def taken_in(self, function: Callable) -> Callable:
        """Returns a function that takes the turn, unless its thread has it already."""

        @functools.wraps(function)
        def in_turn(*args: Any, **options: Any) -> Any:
            if self._is_mine():
                return function(*args, **options)
            with self._lock:
                self._of_this_thread.turn = True
                try:
                    return function(*args, **options)
                finally:
                    self._of_this_thread.turn = False

        return in_turn

    def given_up_in(self, function: Callable) -> Callable:
        """Returns a function during which others may have the turn, if its thread has it."""

        @functools.wraps(function)
        def beside(*args: Any, **options: Any) -> Any:
            if not self._is_mine():
                return function(*args, **options)
            # The flag is the thread's own: set before the lock is free, cleared after, it is never wrong for another.
            self._of_this_thread.turn = False
            self._lock.release()
            try:
                return function(*args, **options)
            finally:
                self._lock.acquire()
                self._of_this_thread.turn = True

        beside.turn = self  # type: ignore[attr-defined]
        return beside

    def _is_mine(self) -> bool:
        return getattr(self._of_this_thread, "turn", False)


def load_side_by_side(wanted: Mapping[Any, Sequence[int]], device: Any) -> None:
    """Loads Warp's modules in several threads, each for the block sizes in `wanted`.

    Modules with the most kernels and functions are the first, so that no large one is left for the end. Those with a
    Cholesky factorisation come after all others: Warp compiles that, for seconds, while it generates the module's code,
    which one thread does at a time.

    Raises:
      Exception: Warp's own, or a RuntimeError, if a module cannot be built, on which `warp.force_load` is silent.

    """

    def load(module: Any) -> None:
        block_dims: Sequence[int | None] = wanted[module] or [None]
        for block_dim in block_dims:
            if module.load(device, block_dim) is None:
                raise RuntimeError(f"Warp cannot build its module {module.name!r}")

    def turn(module: Any) -> tuple[bool, int]:
        return "cholesky" in module.name, -len(module.kernels) - len(module.functions)

    with ThreadPoolExecutor(_COMPILERS) as threads:
        list(threads.map(load, sorted(wanted, key=turn)))
