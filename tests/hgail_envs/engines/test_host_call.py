"""Functions of NumPy arrays within compiled programs, against the same functions called by hand."""

import ctypes
import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs.engines.host_call import host_call
from tests.support import ROOT

VECTOR = jax.ShapeDtypeStruct((3,), jnp.float32)
SCALAR = jax.ShapeDtypeStruct((1,), jnp.float32)


def spin(first, second):
    return np.cross(first, second), np.sum(first * second, axis=-1, keepdims=True)


def spun(first, second):
    return host_call("spin", spin, [VECTOR, SCALAR], first, second)


def random_vectors(*shape):
    return tuple(np.random.default_rng(0).normal(size=(2, *shape, 3)).astype(np.float32))


@pytest.mark.parametrize("shape", [(), (5,), (2, 4)])
def test_it_returns_what_the_function_does_for_any_batch(shape):
    call, vectors = spun, random_vectors(*shape)
    for _ in shape:
        call = jax.vmap(call)
    for ours, expected in zip(jax.jit(call)(*vectors), spin(*vectors), strict=True):
        np.testing.assert_array_equal(ours, expected)


def test_it_works_beside_packages_that_retype_what_python_offers(monkeypatch):
    """As Warp does, in a process that has both engines."""
    shared = ctypes.pythonapi.PyCapsule_New
    monkeypatch.setattr(shared, "argtypes", [ctypes.c_void_p, ctypes.c_char_p, ctypes.CFUNCTYPE(None, ctypes.c_void_p)])
    monkeypatch.setattr(shared, "restype", ctypes.c_void_p)
    first, second = random_vectors()
    sums = host_call("beside others", lambda one, other: (one + other,), [VECTOR], first, second)
    np.testing.assert_array_equal(sums[0], first + second)


def test_a_batch_is_one_call_and_an_argument_without_it_is_repeated():
    shapes = []

    def note(first, second):
        shapes.append((first.shape, second.shape))
        return (first + second,)

    call = jax.vmap(lambda one, other: host_call("note", note, [VECTOR], one, other), in_axes=(0, None))
    first, second = random_vectors(7)
    np.testing.assert_array_equal(jax.jit(call)(first, second[0])[0], first + second[0])
    assert shapes == [((7, 3), (7, 3))]


def test_a_loop_calls_it_in_turn():
    def double(values):
        return (2 * values,)

    def step(values, _):
        return host_call("double", double, [VECTOR], values)[0], values

    end, passed = jax.jit(lambda values: jax.lax.scan(step, values, length=10))(jnp.ones(3))
    np.testing.assert_array_equal(end, np.full(3, 1024.0))
    np.testing.assert_array_equal(passed[:, 0], 2.0 ** np.arange(10))


def test_what_the_function_raises_ends_the_program():
    def fail(values):
        raise ValueError("no such thing")

    with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError: no such thing"):
        jax.jit(lambda values: host_call("fail", fail, [VECTOR], values))(jnp.ones(3))


CACHED = """
import jax, jax.numpy as jnp
from jax import monitoring
from hgail_envs.engines.host_call import host_call

for option, value in {"compilation_cache_dir": "cache", "persistent_cache_min_compile_time_secs": 0}.items():
    jax.config.update(f"jax_{option}", value)
hits = []
monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
shape = jax.ShapeDtypeStruct((3,), jnp.float32)
call = jax.jit(lambda values: host_call("half", lambda values: (values / 2,), [shape], values)[0])
print(len(hits), *call(jnp.ones(3)), len(hits))
"""


def test_another_process_takes_the_program_from_the_cache(tmp_path):
    outputs = [
        subprocess.run(
            [sys.executable, "-c", CACHED],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert [output[1:4] for output in outputs] == [["0.5"] * 3] * 2
    assert int(outputs[1][-1]) > int(outputs[0][-1])


def test_a_thread_that_called_ends_in_silence(monkeypatch):
    complaints, found, vectors = [], [], random_vectors(5)
    monkeypatch.setattr(sys, "unraisablehook", lambda complaint: complaints.append(complaint.exc_value))
    thread = threading.Thread(target=lambda: found.extend(jax.jit(jax.vmap(spun))(*vectors)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(found[0], spin(*vectors)[0])
    assert not complaints


INTERRUPTED = """
import os, signal, threading
import jax, jax.numpy as jnp
from hgail_envs.engines.host_call import host_call

signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell may have made processes ignore

def count(values):
    if values[0] == 3.0:
        threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGINT]).start()
    return (values + 1.0,)

def step(values, _):
    busy = jax.lax.fori_loop(0, 100, lambda _, matrix: jnp.tanh(matrix @ matrix), jnp.ones((200, 200)) * values[0])
    return host_call("count", count, [jax.ShapeDtypeStruct((3,), jnp.float32)], values + 0.0 * busy[0, :3])[0], None

@jax.jit
def run(values, length):
    return jax.lax.fori_loop(0, length, lambda index, values: step(values, index)[0], values)

for length in (1_000_000, 2):
    try:
        print(*run(jnp.zeros(3), length))
    except jax.errors.JaxRuntimeError as error:
        print("KeyboardInterrupt" in str(error))
"""


def test_an_interrupt_that_comes_between_two_calls_ends_the_program(tmp_path):
    """Python raises it on the way into the next call; nothing of it stays behind."""
    process = subprocess.run(
        [sys.executable, "-c", INTERRUPTED],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert process.stdout.split() == ["True", "2.0", "2.0", "2.0"]
    assert process.stderr == ""


def test_what_is_not_in_single_precision_is_refused():
    with pytest.raises(ValueError, match="an argument of host_call is int32; it must be float32"):
        host_call("refused", lambda x: (x,), [jax.ShapeDtypeStruct((2,), jnp.float32)], jnp.zeros(2, jnp.int32))
