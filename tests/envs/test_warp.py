"""The grasp scene on MJX-Warp, on a machine that has it: against C MuJoCo on the same MJCF, and its own limits."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import controllers
from envs.fetch import _DOWNWARD, ACCURATE_SUBSTEPS, CONTROL_PERIOD, LEAD, resolve_impl, settle
from envs.scenes import load_scene
from hgail_jax import Config, Hyperparameters
from hgail_jax.parallel import evaluate_seeds, init_seeds, seed_keys
from hgail_jax.rollout import rollout

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(resolve_impl("auto") != "warp", reason="needs an NVIDIA GPU and warp-lang"),
]
EPISODES = 256


class GraspOnC:
    """`envs.grasp.Grasp` stepped by C MuJoCo, one environment."""

    def __init__(self):
        self.model = load_scene("fetch/grasp")
        self.settled = settle(self.model)
        self.model.opt.timestep = CONTROL_PERIOD / ACCURATE_SUBSTEPS
        self.data = mujoco.MjData(self.model)
        self.fingers = self.model.jnt_qposadr[[self.model.joint(f"{side}_finger").id for side in ("right", "left")]]

    def reset(self, cube):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = self.settled.qpos, self.settled.qvel
        self.data.joint("cube").qpos[:3] = cube
        mujoco.mj_forward(self.model, self.data)

    def step(self, action):
        data, gripper = self.data, self.data.body("gripper")
        data.mocap_pos[0] = gripper.xpos + LEAD * action[:3]
        data.mocap_quat[0] = gripper.xquat + _DOWNWARD
        data.ctrl[:] = data.qpos[self.fingers] + action[3]
        mujoco.mj_step(self.model, data, ACCURATE_SUBSTEPS)
        mujoco.mj_kinematics(self.model, data)

    def lifts(self, controller, cube):
        """Runs an episode and its probe; returns whether the cube has risen by 5 cm."""
        self.reset(cube)
        for _ in range(50):
            # the controllers read the gripper's position and the goal alone
            observation = np.concatenate([self.data.site("grip").xpos, np.zeros(5), cube, [1.0]])
            action = np.asarray(controller(observation))
            self.step(action)
        height = self.data.body("cube").xpos[2]
        for _ in range(12):
            self.step(np.array([0.0, 0.0, 1.0, action[3]]))
        return self.data.body("cube").xpos[2] - height > 0.05


@pytest.mark.parametrize("name", ["from-above", "straight", "closed"])
def test_controllers_score_as_on_c_mujoco(name):
    env, controller = envs.make("grasp", worlds=EPISODES), controllers.CONTROLLERS["grasp"][name]

    def policy(observation, rng):
        return controller(observation), jnp.zeros(observation.shape[:-1])

    episodes = jax.jit(lambda rng: rollout(env, policy, rng, EPISODES, probe=True))(jax.random.key(0))
    on_c, compiled = GraspOnC(), jax.jit(controller, device=jax.devices("cpu")[0])
    theirs = np.mean([on_c.lifts(compiled, cube) for cube in np.asarray(episodes.desired[0, :, :3])])
    ours = float(episodes.outcome.success.mean())
    print(f"{name}: {ours:.3f} on MJX-Warp, {theirs:.3f} on C MuJoCo")
    assert ours == pytest.approx(theirs, abs=0.03)


@pytest.mark.parametrize("task", ["grasp", "reach"])
def test_a_million_random_steps_stay_finite(task):
    env = envs.make(task, substeps=8, worlds=4096)

    @jax.jit
    def run(rng):
        def step(state, rng):
            action = jax.random.uniform(rng, (4096, 4), minval=-1.0, maxval=1.0)
            state = jax.vmap(env.step)(state, action)
            return state, (jnp.isfinite(state.obs).all(), jnp.abs(state.obs).max(), state.pipeline_state.overflow.any())

        state = jax.vmap(env.reset)(jax.random.split(rng, 4096))
        return jax.lax.scan(step, state, jax.random.split(rng, 256))[1]

    finite, largest, overflow = run(jax.random.key(0))
    assert np.asarray(finite).all()
    assert np.max(largest) < env.observation_limit
    assert not np.asarray(overflow).any()


def test_an_overflow_of_the_contact_buffers_is_an_error():
    """Buffers for a single world, and 64 cubes on the table."""
    config = Config(num_envs=64, rounds=1, ppo_minibatches=2)
    env = envs.make("grasp", substeps=8, worlds=1)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 1))
    with pytest.raises(OverflowError, match="ran out of room for contacts"):
        evaluate_seeds(env, config, states, 64)


@pytest.mark.parametrize("task", ["grasp", "reach"])
def test_two_processes_make_the_same_program(task):
    """Else none of them finds it in the cache of compiled programs."""
    script = f"""
import jax, envs
env = envs.make("{task}", substeps=8, worlds=64)
state = jax.eval_shape(env.reset, jax.random.key(0))
print(jax.jit(env.step).lower(state, jax.ShapeDtypeStruct((4,), "float32")).as_text())
"""
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    first, second = (
        subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    programs = [process.stdout.partition("module @")[2] for process in (first, second)]
    assert "custom_call" in programs[0]
    assert programs[0] == programs[1]
