"""Several seeds and settings side by side."""

import functools
import types

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_envs.point import Point
from hgail_jax import Hyperparameters, init_state, phase_table, rollout
from hgail_jax import seeds as seeds_module
from hgail_jax.devices.compilation import compile_program
from hgail_jax.learners import PPO, TD3
from hgail_jax.learners.student import Student
from hgail_jax.seeds import compile_train_step, init_seeds, init_sweep, seed_keys, split_sweep
from tests.support import TINY

ENV = hgail_envs.make("point")
HYPER = Hyperparameters()


def test_a_sweep_starts_every_setting_with_every_seed():
    settings = [HYPER, HYPER.replace(p_ht=0.2, strategy=1), HYPER.replace(exploration_noise=0.7, reward=2)]
    keys = seed_keys(3, 2)
    swept = split_sweep(init_sweep(ENV, TINY, settings, keys), 3)
    start = jax.jit(functools.partial(init_state, ENV, TINY))
    pick = jax.jit(lambda states, i, j: jax.tree.map(lambda leaf: leaf[i, j], states))
    for index, setting in enumerate(settings):
        for seed in range(2):
            found = pick(swept, index, seed)
            expected = start(setting, keys[seed])
            jax.tree.map(np.testing.assert_array_equal, found.replace(rng=None), expected.replace(rng=None))
            assert found.rng == expected.rng


def test_a_sweep_refuses_what_a_run_refuses():
    with pytest.raises(ValueError, match=r"p_ht is 1\.5"):
        init_sweep(ENV, TINY, [HYPER, HYPER.replace(p_ht=1.5)], seed_keys(0, 2))
    with pytest.raises(ValueError, match="number of settings is 0"):
        init_sweep(ENV, TINY, [], seed_keys(0, 2))


def test_more_environments_than_the_physics_has_room_for_are_refused(monkeypatch):
    """Those of all seeds together, on each of the devices; before anything is compiled."""
    few, states = Point(), jax.eval_shape(lambda: init_seeds(ENV, TINY, HYPER, seed_keys(0, 3)))
    monkeypatch.setattr(seeds_module, "compile_program", lambda *arguments, **options: "compiled")
    monkeypatch.setattr(seeds_module, "jit_per_device", lambda *arguments, **options: None)
    few.max_worlds = 12
    assert compile_train_step(few, TINY, states, phase_table(TINY)[0]) == "compiled"
    few.max_worlds = 11
    message = "3 seeds of 4 environments make 12 on a device; the task was made for 11: make it with worlds=12"
    with pytest.raises(ValueError, match=message):
        compile_train_step(few, TINY, states, phase_table(TINY)[0])
    few.max_worlds = 6
    two_devices = types.SimpleNamespace(size=2)
    assert compile_train_step(few, TINY, states, phase_table(TINY)[0], two_devices) == "compiled"


def test_a_roll_out_of_more_environments_than_the_physics_has_room_for_is_refused():
    few = Point()
    few.max_worlds = 3
    with pytest.raises(ValueError, match="the number of environments on a device is 4; it must be at most 3"):
        rollout(few, None, jax.random.key(0), 4)


@pytest.mark.parametrize(("flags", "level"), [("", 1), ("--a=2 --xla_backend_optimization_level=3", None)])
def test_programs_are_compiled_quickly_unless_xla_s_flags_say_how(monkeypatch, flags, level):
    monkeypatch.setenv("XLA_FLAGS", flags)
    options = []
    lowered = types.SimpleNamespace(compile=lambda compiler_options: options.append(compiler_options))
    compile_program(types.SimpleNamespace(lower=lambda: lowered))
    assert options[0].get("xla_backend_optimization_level") == level


def test_on_a_gpu_programs_with_convolutions_alone_are_tuned(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    options = []
    lowered = types.SimpleNamespace(compile=lambda compiler_options: options.append(compiler_options))
    for tuned in (False, True):
        compile_program(types.SimpleNamespace(lower=lambda: lowered), tuned=tuned)
    assert ["xla_gpu_autotune_level" in given for given in options] == [True, False]
    assert Student.convolves and not TD3.convolves and not PPO.convolves
