import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import _platform
from envs.scenes import load_scene


def test_reach_observation_and_reward():
    env = envs.make("reach")
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.obs.shape == (env.observation_size,) == (9,)
    np.testing.assert_array_equal(state.obs[:6], state.info["observation"])
    np.testing.assert_array_equal(state.obs[6:], state.info["desired_goal"])
    np.testing.assert_array_equal(state.obs[:3], state.info["achieved_goal"])
    assert state.reward == -1.0
    assert state.done == 0.0


def test_goal_interface_rebuilds_the_observation():
    env = envs.make("reach")
    state = jax.jit(env.reset)(jax.random.key(0))
    other = jnp.array([1.0, 2.0, 3.0])
    rebuilt = env.goal_observation(state.info["observation"], other)
    np.testing.assert_array_equal(rebuilt, jnp.concatenate([state.obs[:6], other]))


def test_success_is_within_the_threshold():
    env = envs.make("point")
    goal = jnp.zeros(3)
    achieved = jnp.array([[0.0, 0.0, 0.049], [0.0, 0.0, 0.051], [0.04, 0.04, 0.0]])
    np.testing.assert_array_equal(env.success(achieved, goal), [True, False, False])


def test_actions_are_clipped():
    env = envs.make("point")
    state = env.reset(jax.random.key(0))
    np.testing.assert_allclose(env.step(state, jnp.full(3, 9.0)).info["achieved_goal"], 0.03)


def test_random_steps_stay_finite():
    env = envs.make("reach", substeps=4)

    def step(state, rng):
        action = jax.random.uniform(rng, (64, 4), minval=-1.5, maxval=1.5)
        state = jax.vmap(env.step)(state, action)
        return state, jnp.isfinite(state.obs).all()

    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64))
    scan = jax.jit(lambda state, rngs: jax.lax.scan(step, state, rngs)[1])
    assert scan(state, jax.random.split(jax.random.key(1), 200)).all()


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_no_product_of_the_physics_is_left_to_a_gpu_s_default_precision(task):
    env = envs.make(task, impl="jax")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    program = str(jax.make_jaxpr(env.step)(state, jax.ShapeDtypeStruct((4,), jnp.float32)))
    assert program.count("precision=(Precision.HIGH") == program.count("dot_general[") > 100


def test_accurate_physics_is_the_default_and_can_be_asked_for():
    assert envs.make("reach").substeps == 20
    fast = envs.make("reach", substeps=4)
    assert fast.accurate().substeps == 20
    assert float(fast.accurate().engine_model.opt.timestep) == pytest.approx(0.002)
    assert float(fast.engine_model.opt.timestep) == pytest.approx(0.01)


def test_pictures_change_no_dynamics():
    physics, pictures = load_scene("fetch/reach"), load_scene("fetch/reach", visual=True)
    assert pictures.ngeom > physics.ngeom
    np.testing.assert_array_equal(physics.body_mass, pictures.body_mass)
    np.testing.assert_array_equal(physics.body_inertia, pictures.body_inertia)
    assert physics.npair == pictures.npair


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("poke", {}, "choose from point, reach"),
        ("no.such.module:Task", {}, "cannot load task"),
        ("envs.fetch.arm:CONTROL_PERIOD", {}, "not a GoalEnv"),
        ("point", {"substeps": 4}, "no option 'substeps'"),
        ("reach", {"substeps": 3}, "from 4 to 20"),
        ("reach", {"substeps": 21}, "from 4 to 20"),
        ("reach", {"impl": "warp"}, "needs warp-lang and an NVIDIA GPU"),
        ("reach", {"impl": "cuda"}, "choose from auto, jax, warp"),
    ],
)
def test_bad_tasks_are_refused(task, options, message):
    with pytest.raises(ValueError, match=message):
        envs.make(task, **options)


def test_a_task_of_one_s_own_is_found_by_its_path():
    assert envs.make("envs.point:Point").episode_length == 50


def test_xla_flags_only_where_the_fault_is():
    for version in ("0.7.2", "0.10.2"):
        assert _platform.xla_flags("--a=1", version) == "--a=1 --xla_cpu_use_fusion_emitters=false"
        assert _platform.thread_pool_size(2, version) == 8
    for version in ("0.6.2", "0.11.2", "0.12.0.1"):
        assert _platform.xla_flags("--a=1", version) == "--a=1"
        assert _platform.thread_pool_size(2, version) is None
    assert _platform.thread_pool_size(16, "0.10.2") is None


def test_batched_cholesky_does_not_hang():
    """Three factorisations at once, each large enough to be spread over XLA's threads."""
    matrices = jnp.eye(13) * 2.0 + jnp.zeros((2000, 13, 13))

    @jax.jit
    def factorise(matrices):
        return sum(jnp.linalg.cholesky(matrices + shift * jnp.eye(13)).sum() for shift in (0.0, 1.0, 2.0))

    expected = 2000 * 13 * sum(np.sqrt([2.0, 3.0, 4.0]))
    assert float(factorise(matrices)) == pytest.approx(expected, rel=1e-4)
