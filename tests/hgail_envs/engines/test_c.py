"""C MuJoCo as an engine, against `mujoco.mj_step` called by hand on the same scene."""

import os
import threading

import jax
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.engines import c, make_engine
from hgail_envs.engines.c import HostRollout
from tests.hgail_envs.engines.scene import (
    MODEL,
    PERIOD,
    engine_control,
    engine_state,
    random_states,
    step_by_hand,
)

SUBSTEPS = 10


def host(threads=2, substeps=SUBSTEPS):
    engine = make_engine("c", MODEL, PERIOD, substeps, worlds=1)
    return HostRollout(engine.model, substeps, threads)


def assert_same_bits(ours, expected):
    for one, other in zip(ours, expected, strict=True):
        assert one.dtype == other.dtype == np.float32
        np.testing.assert_array_equal(one, other)


def test_an_action_is_mujoco_s_own_steps_to_the_bit():
    states = random_states(32)
    ours, expected = host()(*states), step_by_hand(*states, SUBSTEPS)
    assert_same_bits(ours, expected)
    assert (np.ptp(expected[2], axis=0) > 0).all()  # some of the hands touch the cube with both pads, others do not
    assert np.abs(expected[0] - states[0]).max() > 0.05


@pytest.mark.slow  # many actions, nothing compiled; the scene of grasp is stepped as by hand above
@pytest.mark.parametrize("task", [task for task in hgail_envs.TASKS if task != "point"])
def test_the_scene_of_each_task_is_stepped_as_by_hand(task, monkeypatch):
    """Along an episode that goes for the object, one environment, nothing compiled."""
    env = hgail_envs.make(task, impl="c", substeps=5)
    step, model, checked = env.engine.step, env.engine.model, []

    def step_both(state, control):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.ctrl = state.qpos, state.qvel, control.ctrl
        data.mocap_pos, data.mocap_quat = control.mocap_pos, control.mocap_quat
        mujoco.mj_step(model, data, nstep=5)
        after = step(state, control)
        assert_same_bits((np.asarray(after.qpos),), (data.qpos.astype(np.float32),))
        checked.append(np.asarray(after.qpos))
        return after

    monkeypatch.setattr(env.engine, "step", step_both)
    controller = next(iter(env.controllers.values()))
    state = env.reset(jax.random.key(0))
    for _ in range(12):
        state = env.step(state, controller(state.obs))
    assert len(checked) == 12
    assert np.abs(checked[-1] - checked[0]).max() > 0.05


def test_an_action_is_the_same_where_jax_has_double_precision():
    engine, (qpos, qvel, control) = make_engine("c", MODEL, PERIOD, SUBSTEPS, worlds=1), random_states(8)
    expected = step_by_hand(qpos, qvel, control, SUBSTEPS)
    with jax.enable_x64(True):
        state = engine_state(qpos.astype(np.float64), qvel.astype(np.float64))
        assert state.qpos.dtype == np.float64
        ended = jax.jit(jax.vmap(engine.step))(state, engine_control(control.astype(np.float64)))
    np.testing.assert_array_equal(ended.qpos, expected[0])
    np.testing.assert_array_equal(ended.qvel, expected[1])


def test_the_solver_starts_anew_with_every_action():
    """A second action from where the first ended: also where MuJoCo would know how it solved the last one."""
    qpos, qvel, control = random_states(8)
    rollout = host()
    for _ in range(2):
        following = rollout(qpos, qvel, control)
        assert_same_bits(following, step_by_hand(qpos, qvel, control, SUBSTEPS))
        qpos, qvel, _ = following


@pytest.mark.parametrize("threads", [1, 4])
def test_the_number_of_threads_changes_no_bit(threads):
    states = random_states(37)
    assert_same_bits(host(threads)(*states), host(2)(*states))


def test_it_may_be_called_from_several_threads_at_once():
    rollout, inputs, outputs = host(), [random_states(64, seed) for seed in range(4)], {}

    def call(index):
        for _ in range(3):
            outputs[index] = rollout(*inputs[index])

    threads = [threading.Thread(target=call, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    for index in range(4):
        assert_same_bits(outputs[index], host()(*inputs[index]))


def spoil_position(qpos, qvel, control):
    qpos[5, 6] = np.nan


def spoil_velocity(qpos, qvel, control):
    qvel[5, 6] = 1e12


def push_the_base(qpos, qvel, control):
    """The base's damping is more than a step of 4 ms bears: the arm flies apart within the action."""
    qvel[5, 0] = 1.0


def spoil_control(qpos, qvel, control):
    control[5, 3] = np.nan


@pytest.mark.parametrize("spoil", [spoil_position, spoil_velocity, push_the_base, spoil_control])
def test_a_simulation_that_breaks_down_is_not_a_number_and_leaves_the_others_alone(spoil):
    rollout, states = host(), random_states(16)
    sound = rollout(*states)
    assert np.isfinite(sound[0]).all()
    broken = tuple(array.copy() for array in states)
    spoil(*broken)
    after = rollout(*broken)
    others = np.arange(16) != 5
    assert np.isnan(after[0][5]).all()
    assert_same_bits([array[others] for array in after], [array[others] for array in sound])
    assert_same_bits(rollout(*states), sound)  # nothing of it is left behind


@pytest.mark.parametrize("substeps", [1, 2, 20])
def test_a_breakdown_is_seen_however_many_steps_an_action_has(substeps):
    qpos, qvel, control = random_states(2)
    qvel[1, 6] = 1e12
    positions, _, _ = host(substeps=substeps)(qpos, qvel, control)
    np.testing.assert_array_equal(np.isnan(positions).any(axis=1), [False, True])


def test_a_full_arena_is_not_a_number():
    """MuJoCo warns that it left contacts out and continues; what comes of it is no simulation of the scene."""
    boxes = "".join(
        f'<body pos="{0.3 * index} 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>' for index in range(6)
    )
    positions = {}
    for memory in ("1M", "64K"):
        xml = (
            f"<mujoco><size memory='{memory}'/><worldbody><geom type='plane' size='9 9 1'/>{boxes}</worldbody></mujoco>"
        )
        model = mujoco.MjModel.from_xml_string(xml)
        rollout = HostRollout(model, SUBSTEPS, 1)
        positions[memory], _, _ = rollout(model.qpos0[None], np.zeros((1, model.nv)), np.zeros((1, 0)))
    assert np.isfinite(positions["1M"]).all()
    assert np.isnan(positions["64K"]).all()


def test_seeds_side_by_side_within_a_scan_are_the_steps_one_after_another():
    seeds, envs, actions = 3, 4, 5
    engine = make_engine("c", MODEL, PERIOD, SUBSTEPS, worlds=1)
    qpos, qvel, control = random_states(seeds * envs)
    controls = np.stack([np.roll(control, shift, axis=0) for shift in range(actions)])

    def of_seed(state, controls):
        def step(state, control):
            state = jax.vmap(engine.step)(state, engine_control(control))
            return state, (state.qpos, state.qvel, state.sensordata)

        return jax.lax.scan(step, state, controls)[1]

    def by_seed(array):
        return array.reshape(*array.shape[:-2], seeds, envs, array.shape[-1])

    state = engine_state(by_seed(qpos), by_seed(qvel))
    found = jax.jit(jax.vmap(of_seed, in_axes=(0, 1), out_axes=1))(state, by_seed(controls))
    rollout = host()
    for action in range(actions):
        qpos, qvel, sensordata = rollout(qpos, qvel, controls[action])
        assert_same_bits([np.asarray(array[action]) for array in found], map(by_seed, (qpos, qvel, sensordata)))


def test_what_a_task_adds_to_the_state_is_left_as_it_is():
    qpos, qvel, control = random_states(2)
    engine = make_engine("c", MODEL, PERIOD, SUBSTEPS, worlds=1)
    state = engine_state(qpos, qvel).replace(warmstart=np.full((2, MODEL.nv), 3.0))
    after = jax.vmap(engine.step)(state, engine_control(control))
    np.testing.assert_array_equal(after.warmstart, 3.0)
    assert not after.overflow.any()


def test_copies_of_a_model_have_their_numbers_and_are_made_once():
    copies, rng, made = c._Copies(MODEL, ["body_mass", "geom_size"]), np.random.default_rng(0), []
    for count in (3, 2, 5, 5):
        values = rng.uniform(1.0, 2.0, (count, MODEL.nbody + 3 * MODEL.ngeom)).astype(np.float32)
        models = copies.with_fields(values)
        for model, row in zip(models, values, strict=True):
            np.testing.assert_array_equal(np.append(model.body_mass, model.geom_size), row)
        made.append([id(model) for model in models])
    assert made[3] == made[2] and made[2][:3] == made[0] and made[1] == made[0][:2]
    assert len(copies._models) == 5


def test_another_number_of_steps_is_another_engine():
    states = random_states(4)
    state, control = engine_state(*states[:2]), engine_control(states[2])
    few = make_engine("c", MODEL, PERIOD, 4, worlds=1)
    many = few.with_substeps(20)
    for engine, substeps in ((few, 4), (many, 20), (many.with_substeps(4), 4)):
        after = jax.vmap(engine.step)(state, control)
        found = [np.asarray(array) for array in (after.qpos, after.qvel, after.sensordata)]
        assert_same_bits(found, step_by_hand(*states, substeps))
    assert MODEL.opt.timestep == 0.002  # the model that it was made of stays as it was


BREAKS_DOWN = """
import numpy as np
from tests.hgail_envs.engines.test_c import host, random_states
qpos, qvel, control = random_states(4)
qpos[0, 5], qvel[1, 5] = np.nan, 1e12
assert np.isnan(host()(qpos, qvel, control)[0][:2]).all()
"""

FORKS = """
import os
from tests.hgail_envs.engines.test_c import assert_same_bits, host, random_states
rollout, states = host(), random_states(8)
before = rollout(*states)
child = os.fork()
if child == 0:
    try:
        assert_same_bits(rollout(*states), before)
        os._exit(17)
    finally:
        os._exit(1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 17
assert_same_bits(rollout(*states), before)
"""


def test_a_breakdown_says_and_writes_nothing(forks):
    ended = forks.run(BREAKS_DOWN)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    assert not list(ended.folder.iterdir())  # MuJoCo's own handler writes MUJOCO_LOG.TXT


def test_a_process_that_was_forked_after_the_first_call_steps_too(forks):
    ended = forks.run(FORKS)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000"}, 8),
        ({"cpu.max": "200000 100000"}, 2),
        ({"cpu.max": "150000 100000"}, 2),
        ({"cpu.max": "10000 100000"}, 1),
        ({"cpu.max": "1600000 100000"}, 8),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ({"cpu/cpu.cfs_quota_us": "300000", "cpu/cpu.cfs_period_us": "100000"}, 3),
    ],
)
def test_a_container_s_limit_is_kept(tmp_path, monkeypatch, files, cores):
    (tmp_path / "cpu").mkdir()
    for name, content in files.items():
        (tmp_path / name).write_text(f"{content}\n")
    monkeypatch.setattr(c, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert c.usable_cores() == cores
