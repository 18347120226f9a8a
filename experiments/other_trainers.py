"""Trains other people's learners on reach until 98 % of test episodes succeed; docs/other-trainers.md has the figures.

Run as `python -m experiments.other_trainers sac-her-sb3`; the choices are the keys of `TRAINERS`.
"""

import argparse
import time
from collections.abc import Callable

import gymnasium
import numpy as np

import hgail_envs  # noqa: F401  (registers the tasks)

REACH = "hgail_envs/FetchReach-v0"
ENOUGH = 0.98
"""Success at which a training ends."""
TEST_ENVS = 100
"""Episodes of a test, at once."""

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]
Tested = Callable[[int, Policy], bool]
"""Called now and then with environment steps and a deterministic policy; returns true when the success is enough."""


def make_test() -> Callable[[Policy], float]:
    """Returns a test of policies on reach: the success at the last step of `TEST_ENVS` episodes, always the same."""
    env = gymnasium.make_vec(REACH, num_envs=TEST_ENVS)

    def success(policy: Policy) -> float:
        observation, info = env.reset(seed=10_000)
        truncated = np.zeros(1, bool)
        while not truncated[0]:
            observation, _, _, truncated, info = env.step(policy(observation))
        return float(info["is_success"].mean())

    return success


def sb3_sac_her(tested: Tested, most_steps: int, num_envs: int = 8) -> None:
    """Trains stable-baselines3's SAC with its `HerReplayBuffer`, a gradient step for each environment step."""
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import EveryNTimesteps, LambdaCallback  # type: ignore[attr-defined]

    from hgail_envs.stable_baselines import GoalVecEnv

    env = GoalVecEnv(gymnasium.make_vec(REACH, num_envs=num_envs, autoreset_mode="SameStep"))
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=50 * num_envs,
        gamma=0.95,
        gradient_steps=num_envs,
        learning_rate=1e-3,
        seed=0,
    )
    test = LambdaCallback(
        lambda variables, _: not tested(model.num_timesteps, lambda seen: model.predict(seen, deterministic=True)[0])
    )
    model.learn(most_steps, callback=EveryNTimesteps(1000, test))
