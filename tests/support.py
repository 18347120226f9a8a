"""What several test modules share."""

import contextlib
import dataclasses
import functools
import importlib
import os
import re
import resource
import socket
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import FEW_UPDATES
from hgail_jax import PPO, PRESETS, Config, Hyperparameters, Preset, init_state, phase_table, train_step
from hgail_jax.seeds import compile_train_step, init_sweep, trace_evaluation
from hgail_jax.settings.defaults import DEFAULTS, EVALUATION_EPISODES
from hgail_jax.trainer import loop, training

ROOT = Path(__file__).parent.parent
"""The project's folder."""
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
"""README and the pages of `docs`."""


def files_of(page):
    """Returns the files that a page gives, each after its name and a colon: content by name."""
    return dict(re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE))


@contextlib.contextmanager
def own_tasks(folder):
    """Writes the files of the page on own tasks to a folder, from which they can be imported."""
    files = files_of(ROOT / "docs" / "add-a-task.md")
    for name, content in files.items():
        (folder / name).write_text(content)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    yield folder
    sys.path.remove(str(folder))
    for name in files:
        sys.modules.pop(name.removesuffix(".py"), None)


def refused(main, arguments, message, capsys, code=2):
    """Asserts that a command ends with a code and one line with a message on stderr, and returns the line."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (code, 1)
    assert message in error
    return error


SOURCES = f"{ROOT}:{ROOT / 'envs'}"
"""PYTHONPATH of a process that imports this checkout, whichever is installed."""

TINY = Config(
    num_envs=4,
    rounds=2,
    learner=PPO(
        policy_phases=2,
        discriminator_phases=1,
        minibatches=2,
        pretrain_policy_minibatches=3,
        pretrain_policy_batch=8,
        pretrain_discriminator_minibatches=3,
    ),
    discriminator_minibatches=3,
    discriminator_batch=8,
)
"""Sizes that compile and run in seconds."""


def make_runs_tiny(monkeypatch=None):
    """Gives runs that ask for no others these sizes; in a process of its own for good."""
    tiny = Preset(TINY, Hyperparameters())
    changes = [(PRESETS, "parallel", tiny), (EVALUATION_EPISODES, "cpu", 8)]
    for learners in {id(learners): learners for learners in DEFAULTS.values()}.values():
        physics = {
            platform: dataclasses.replace(tiny, task_options=preset.task_options)
            for platform, preset in learners["ppo"].items()
        }
        changes.append((learners, "ppo", physics))
    for mapping, name, value in changes:
        if monkeypatch is None:
            mapping[name] = value
        else:
            monkeypatch.setitem(mapping, name, value)


def check_a_round(env, preset):
    """Trains a round of a preset, with few episodes and updates; nothing may break down."""
    few = FEW_UPDATES if preset.config.learner.name == "ppo" else {"updates": 2}
    config = preset.config.replace(num_envs=16, rounds=1, **few)
    state = init_state(env, config, preset.hyperparameters, jax.random.key(0))
    step = jax.jit(functools.partial(train_step, env, config))
    for phases in phase_table(config):
        state, metrics = step(state, phases)
        assert 0.0 <= metrics.evaluation.success <= 1.0
        assert metrics.dropped == metrics.diverged == 0.0


_compiled, _untrained = {}, {}
copied = jax.jit(functools.partial(jax.tree.map, jnp.copy))
"""Returns a state's copy, for a step that consumes it."""


def init_once(monkeypatch):
    """Has all runs of the same task, sizes, settings and seeds share their untrained states."""
    change = setattr if monkeypatch is None else monkeypatch.setattr
    change(loop, "init_sweep", _init_or_copy)


def _init_or_copy(env, config, settings, keys, demonstrations=None):
    pictures = getattr(env, "pictures", None)
    seen = (
        env.episode_length,
        env.feature_size,
        env.goal_observation_size,
        env.action_size,
        pictures and (pictures.shape, pictures.target),
    )
    key = (type(env), seen, config.replace(rounds=0), repr(settings), len(keys))
    if isinstance(keys, jax.core.Tracer):  # shapes alone are asked for
        found = None if demonstrations else _untrained.get(key)
        return found or init_sweep(env, config, settings, keys, demonstrations)
    numbers = np.asarray(jax.random.key_data(keys)).tobytes()
    if demonstrations is not None:
        return init_sweep(env, config, settings, keys, demonstrations)
    if (key, numbers) not in _untrained:
        _untrained[key, numbers] = _untrained[key] = init_sweep(env, config, settings, keys)
    return copied(_untrained[key, numbers])


def _trace_evaluation(*arguments):
    return functools.cache(trace_evaluation(*arguments))


def compile_once(monkeypatch):
    """Has all runs of the same task and sizes share their programs, whose compilation is most of a tiny run's time."""
    init_once(monkeypatch)

    def once(compile_program):
        def compile_or_find(env, config, states, *more):
            hashable = [value for value in more if isinstance(value, int)]
            physics = [getattr(env, name, None) for name in ("impl", "substeps", "success_threshold", "randomization")]
            key = (compile_program, type(env), *physics, config, states.rng.shape, *hashable)
            if key not in _compiled:
                _compiled[key] = compile_program(env, config, states, *more)
            return _compiled[key]

        return compile_or_find

    monkeypatch.setattr(loop, "compile_train_step", once(compile_train_step))
    monkeypatch.setattr(training, "trace_evaluation", once(_trace_evaluation))


TINY_RUN = """
import sys
from tests.support import make_runs_tiny
from hgail_jax.cli.train import main
make_runs_tiny()
main(sys.argv[1:])
"""
"""A script that does what `hgail train` does, in these sizes."""


def four_devices():
    """Returns the environment of a process in which XLA makes four devices of one processor."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    return os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": SOURCES}


def free_port():
    """Returns a port that no other process is given for a while, as tests of another process look for one too."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


@contextlib.contextmanager
def small_files_only(size):
    """No file may grow beyond `size` bytes: to whoever writes it, a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


HERE = {"device": {"platform": "cpu", "kind": "a", "count": 1}}
ELSEWHERE = {"device": {"platform": "gpu", "kind": "b", "count": 1}}
"""Places where rows of a benchmark were made."""


def starts_of(env, keys):
    """Returns starts of episodes to be measured and of episodes to learn from, `[keys, ...]`, as NumPy arrays."""
    reset = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    return [jax.tree.map(np.asarray, reset(keys, training_goals)) for training_goals in (False, True)]


def move(robot, actions):
    """Returns a robot's features after each action, from a start."""
    robot.reset(np.random.default_rng(0))
    seen = [robot.features()]
    for action in actions:
        robot.step(np.array(action))
        seen.append(robot.features())
    return np.array(seen)
