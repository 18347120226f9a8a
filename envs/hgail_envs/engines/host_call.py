"""Calls a function of NumPy arrays from within a compiled program on a CPU.

XLA finds the function by its name, through its foreign function interface, and hands over its own buffers. The
structures below are those of jaxlib's `xla/ffi/api/c_api.h`; XLA refuses functions for another major version of them.

`jax.pure_callback` and `jax.experimental.buffer_callback` need no such structures. But their programs refer to a
function of this process, so that JAX never keeps them in its compilation cache. With this call the training of reach
(one round, eight seeds) compiles in 11 s once it is cached, and in 83 s with nothing cached (two busy CPU cores, JAX
0.10.2). A step takes as long with `buffer_callback`, which takes over where XLA refuses.
"""

import ctypes
import functools
import math
import operator
import threading
import warnings
from collections.abc import Callable, Generator, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

HostFunction = Callable[..., Sequence[np.ndarray]]
"""Arrays in single precision to arrays in single precision. It must not use JAX, not even to convert an array: JAX may
wait for the program that waits for the function."""

_MAJOR_VERSION = 0
_METADATA = 1  # kind of extension with which XLA asks for the version
_INTERNAL = 13  # code of an error
_PREFIX = "hgail_jax."
_SLOWER = "programs with impl 'c' are compiled anew in each process: this version of XLA does not take its calls"


class _Struct(ctypes.Structure):
    _fields_: ClassVar[Any] = (("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p))


class _Version(_Struct):
    _fields_ = (("major", ctypes.c_int), ("minor", ctypes.c_int))


class _ErrorArguments(_Struct):
    _fields_ = (("message", ctypes.c_char_p), ("code", ctypes.c_int))


class _Api(_Struct):
    _fields_ = (
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("create_error", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))),
    )


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


class _Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("kind", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    )


class _Buffer(_Struct):
    _fields_ = (
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )

    def array(self) -> np.ndarray:
        """Returns the buffer as an array, without a copy."""
        shape = tuple(self.dims[: self.rank])
        size = math.prod(shape)
        if not size:
            return np.empty(shape, np.float32)  # whose address may be null
        return np.frombuffer((ctypes.c_float * size).from_address(self.data), np.float32).reshape(shape)


class _Buffers(_Struct):
    _fields_ = (
        ("count", ctypes.c_int64),
        ("kinds", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )

    def arrays(self) -> list[np.ndarray]:
        return [self.items[index].contents.array() for index in range(self.count)]


class _Frame(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension_start", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))
_registered: dict[str, Any] = {}  # never freed: a compiled program may call at any time
_api: _Api | None = None  # XLA's, one for the whole process
_refused = False  # whether XLA refused a function, as it does with structures of another version


def host_call(
    name: str, function: HostFunction, results: Sequence[jax.ShapeDtypeStruct], *arguments: jax.Array
) -> tuple[jax.Array, ...]:
    """Calls `function` when the program runs; under `jax.vmap` once for the whole batch.

    The function must be pure: its calls may be repeated or left out.

    Args:
      name: name of the function. Two processes give the same name to the same function and to no other, for cached
        programs hold it. The first function of a name is the one that is called.
      function: takes arrays `[..., n]` and returns arrays `[..., m]`, with all the batch's axes in front.
      results: shapes of its results for a single element of the batch, in single precision.
      *arguments: its arguments, in single precision.

    Raises:
      ValueError: an argument is not in single precision.
    """
    for dtype in {argument.dtype for argument in arguments} - {jnp.dtype(jnp.float32)}:
        raise ValueError(f"an argument of host_call is {dtype}; it must be float32")
    if _is_registered(name, function):
        call = jax.ffi.ffi_call(_PREFIX + name, tuple(results), vmap_method="broadcast_all")
    else:
        call = buffer_callback(functools.partial(_fill, function), tuple(results), vmap_method="broadcast_all")
    return tuple(call(*arguments))


def _is_registered(name: str, function: HostFunction) -> bool:
    """Registers a function with XLA, if it is not yet; returns False, after a warning, if XLA has refused one."""
    global _refused
    if name not in _registered and not _refused:
        handler = _Handler(_Entry(function))
        capsule = _new_capsule(ctypes.cast(handler, ctypes.c_void_p), None, None)
        try:
            jax.ffi.register_ffi_target(_PREFIX + name, capsule, platform="cpu")
            _registered[name] = handler
        except Exception as error:  # of a type that JAX does not document
            _refused = True
            warnings.warn(f"{_SLOWER} ({str(error).splitlines()[0]})", stacklevel=3)
    return name in _registered


def _fill(function: HostFunction, _: Any, results: Sequence[Any], *arguments: Any) -> None:
    """Calls a function with the buffers that `buffer_callback` hands over."""
    for buffer, values in zip(results, function(*map(np.asarray, arguments)), strict=True):
        np.asarray(buffer)[...] = values


_new_capsule = ctypes.pythonapi["PyCapsule_New"]  # our own: as an attribute it is shared, and Warp retypes that
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]


class _Entry(threading.local):
    """Entry point that XLA calls with the address of a frame. Returns the address of an error, or None; never raises.

    Python raises a signal's exception, e.g. KeyboardInterrupt for Ctrl-C, at the next line that it runs. In a function
    that C calls this is before any `try`; ctypes would print it and continue, with results that were never written. A
    generator resumes within its `try`, and on the way to it no line of Python runs. Each thread has a generator.
    """

    def __init__(self, function: HostFunction) -> None:
        calls = _answer_calls(function)
        next(calls)
        self.answer = calls.send

    __call__ = property(operator.attrgetter("answer"))


def _answer_calls(function: HostFunction) -> Generator[int | None, Any, None]:
    """Receives addresses of frames and calls the function for each; yields the results of `_Entry`."""
    error = None
    while True:
        try:
            pointer = yield error
            while True:  # not at the head of the `try`: Python 3.11 takes the jump back for one to before it
                _call(function, pointer)
                pointer = yield None
        except GeneratorExit:  # the thread ends
            return
        except BaseException as raised:  # a signal's exception too: none may pass through XLA's frames
            error = _make_error(f"{type(raised).__name__}: {raised}")


def _call(function: HostFunction, pointer: Any) -> None:
    """Calls the function with a frame's arguments and writes its results there, or gives XLA the version."""
    frame = pointer.contents
    extension = frame.extension_start
    if extension and extension.contents.kind == _METADATA:
        _describe(extension.contents.metadata.contents, frame.api.contents)
        return
    results = function(*frame.arguments.arrays())
    for buffer, result in zip(frame.results.arrays(), results, strict=True):
        buffer[...] = result


def _describe(metadata: _Metadata, api: _Api) -> None:
    """Gives XLA the version that the function was written for, and keeps XLA's functions to make errors."""
    global _api
    _api = api
    metadata.version.major = _MAJOR_VERSION
    metadata.version.minor = api.version.minor  # minor versions only add to the structures
    metadata.traits = 0


def _make_error(message: str) -> int:
    assert _api is not None, "XLA asks for the version first"
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message.encode(), _INTERNAL)
    return _api.create_error(ctypes.byref(arguments))
