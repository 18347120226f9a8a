"""Functions of NumPy arrays within compiled programs, against the same functions called by hand."""

import ctypes
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.engines import host_call as module
from hgail_envs.engines.host_call import host_call
from hgail_jax import Hyperparameters, phase_table
from hgail_jax.seeds import compile_train_step, init_seeds, seed_keys
from tests.support import TINY

VECTOR = jax.ShapeDtypeStruct((3,), jnp.float32)
SCALAR = jax.ShapeDtypeStruct((1,), jnp.float32)


def spin(first, second):
    return np.cross(first, second), np.sum(first * second, axis=-1, keepdims=True)


def spun(first, second):
    return host_call("spin", spin, [VECTOR, SCALAR], first, second)


def random_vectors(*shape):
    return tuple(np.random.default_rng(0).normal(size=(2, *shape, 3)).astype(np.float32))


@pytest.fixture
def refusal(monkeypatch):
    """XLA takes no functions, since these are written for another version of its structures than the installed."""
    monkeypatch.setattr(module, "_MAJOR_VERSION", 99)
    monkeypatch.setattr(module, "_registered", {})
    monkeypatch.setattr(module, "_refused", False)


@pytest.fixture(params=["taken", "refused"])
def either_way(request):
    if request.param == "refused":
        request.getfixturevalue("refusal")


@pytest.mark.filterwarnings("ignore:programs with impl 'c'")
@pytest.mark.parametrize("shape", [(), (5,), (0,), (2, 4)])
def test_it_returns_what_the_function_does_for_any_batch(shape, either_way):
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


@pytest.mark.filterwarnings("ignore:programs with impl 'c'")
def test_what_the_function_raises_ends_the_program(either_way):
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


def test_another_process_takes_the_program_from_the_cache(forks, tmp_path):
    script = f"import os\nos.chdir({str(tmp_path)!r})\n{CACHED}"
    outputs = [forks.run(script).stdout.split() for _ in range(2)]
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
jax.config.update("jax_cpu_enable_async_dispatch", False)  # as the command does: calls come in the main thread

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


def test_an_interrupt_that_comes_between_two_calls_ends_the_program(forks):
    """Python raises it on the way into the next call; nothing of it stays behind."""
    ended = forks.run(INTERRUPTED)
    assert ended.stdout.split() == ["True", "2.0", "2.0", "2.0"]
    assert ended.stderr == ""


def test_what_is_not_in_single_precision_is_refused():
    with pytest.raises(ValueError, match="an argument of host_call is int32; it must be float32"):
        host_call("refused", lambda x: (x,), [jax.ShapeDtypeStruct((2,), jnp.float32)], jnp.zeros(2, jnp.int32))


def test_where_xla_refuses_one_warning_says_so(refusal):
    vectors = random_vectors()
    with pytest.warns(UserWarning, match="impl 'c' are compiled anew in each process: .*99") as warned:
        for name in ("first", "second"):
            np.testing.assert_array_equal(host_call(name, lambda one, _: (one,), [VECTOR], *vectors)[0], vectors[0])
    assert len(warned) == 1
    assert "\n" not in str(warned[0].message)


def reach_after_five_actions():
    env = hgail_envs.make("reach", impl="c", substeps=4)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    actions = jax.random.uniform(jax.random.key(1), (5, 3, 4), minval=-1.0)
    scan = jax.jit(lambda states: jax.lax.scan(lambda s, a: (jax.vmap(env.step)(s, a), s.obs), states, actions))
    return scan(states)[1]


@pytest.mark.filterwarnings("ignore:programs with impl 'c'")
def test_where_xla_refuses_the_physics_is_the_same(request):
    usual = reach_after_five_actions()
    request.getfixturevalue("refusal")
    np.testing.assert_array_equal(reach_after_five_actions(), usual)


def tiny_training():
    env, config = hgail_envs.make("reach", impl="c", substeps=4), TINY.replace(rounds=1)
    states, phases = init_seeds(env, config, Hyperparameters(), seed_keys(0, 1)), phase_table(config)
    step = compile_train_step(env, config, states, phases[0])
    for row in phases:
        states, _ = step(states, row)
    return jax.tree.map(np.asarray, states.learner)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:programs with impl 'c'")
def test_where_xla_refuses_training_is_the_same(request):
    usual = tiny_training()
    request.getfixturevalue("refusal")
    jax.tree.map(np.testing.assert_array_equal, tiny_training(), usual)
