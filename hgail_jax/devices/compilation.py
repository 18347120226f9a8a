"""Compiles programs with physics in them: thousands of small kernels, for which XLA's usual options are slow."""

import gc
import os
from typing import Any

import jax


def compile_program(jitted: Any, *arguments: Any, tuned: bool = False) -> Any:
    """Returns a jitted function compiled for arguments of these shapes; see `compile_lowered` for `tuned`."""
    return compile_lowered(lower_program(jitted, *arguments), tuned)


def lower_program(jitted: Any, *arguments: Any) -> Any:
    """Returns a jitted function, traced for arguments of these shapes and lowered."""
    collecting = gc.isenabled()
    gc.disable()  # tracing makes millions of objects that stay: looking for garbage takes a fifth of its time
    try:
        return jitted.lower(*arguments)
    finally:
        if collecting:
            gc.enable()


def compile_lowered(lowered: Any, tuned: bool = False) -> Any:
    """Compiles at a low optimisation level, and on a GPU without autotuning unless the program is to be `tuned`.

    That took a third off the compilation on an H200, two thirds on a CPU, and nothing off the speed of programs without
    convolutions; those are to be tuned. Options that `XLA_FLAGS` names are left to it.
    """
    quickly = {"xla_backend_optimization_level": 1}
    # without autotuning XLA's own matrix products run with poor tiles: 4.1 ms for 1.3 ms an update of TD3 by cuBLAS
    on_gpu = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
    options = {"cpu": quickly, "gpu": quickly | ({} if tuned else on_gpu)}.get(jax.default_backend(), {})
    flags = os.environ.get("XLA_FLAGS", "")
    return lowered.compile(compiler_options={name: value for name, value in options.items() if name not in flags})
