import jax
import jax.numpy as jnp
import numpy as np

from experiments import reward_map
from hgail_envs.tasks.push import Push
from hgail_jax.config import Config
from hgail_jax.discriminator import discriminate
from hgail_jax.learners import TD3
from hgail_jax.trainer.loop import Program


def test_each_step_is_rewarded_under_the_goal_nearest_to_the_middle():
    """Beside a loop over the steps of the episodes that stayed finite."""
    env = Push()
    config = Config(TD3(buffer_episodes=4), num_envs=1, discriminator_hidden=(8,))
    program = Program(env, config, (config.learner.hyperparameters(),), seeds=1)
    state = jax.jit(lambda states: jax.tree.map(lambda leaf: leaf[0], states))(program.init())
    rng = np.random.default_rng(0)
    drawn = jax.tree.map(lambda leaf: jnp.asarray(rng.uniform(size=leaf.shape), leaf.dtype), state.buffer)
    kind = jnp.asarray(rng.uniform(size=drawn.desired.shape[:2]) < 0.5, jnp.float32)
    desired = drawn.desired.at[..., 3].set(kind)
    buffer = drawn.replace(desired=desired, valid=jnp.array([True, False, True, True]))
    places, reward = reward_map.rewards(program, state.replace(buffer=buffer))
    of_cube = [goal for episode in (0, 2, 3) for goal in np.asarray(desired[episode]) if goal[3] == 1.0]
    goal = min(of_cube, key=lambda goal: np.linalg.norm(goal - np.mean(of_cube, axis=0)))

    @jax.jit
    def logit(features, action):
        observation = env.goal_observation(features, jnp.asarray(goal))
        return discriminate(config, state.discriminator, state.normalize(observation), action)

    expected, held = [], jax.device_get(buffer)
    for episode in (0, 2, 3):
        for step in range(0, env.episode_length, 10):
            found = logit(held.features[episode, step], held.action[episode, step])
            cube = held.features[episode, step + 1][env.features_layout["cube position"]]
            expected.append([*(cube[:2] - goal[:2]), 1.0 / (1.0 + np.exp(-found))])
    np.testing.assert_allclose(np.column_stack([places, reward])[::10], np.array(expected), atol=1e-5)
