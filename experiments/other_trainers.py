"""Trains other people's learners on reach until 98 % of test episodes succeed; docs/other-trainers.md has the figures.

Run as `python -m experiments.other_trainers sb3-sac-her`; the choices are the keys of `TRAINERS`.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from experiments import sac_her
from hgail_envs.fetch.arm import REFERENCE_SUBSTEPS
from hgail_envs.registry import GYMNASIUM_IDS

ENOUGH = 0.98
"""Success at which a training ends."""
TEST_ENVS = 100
"""Episodes of a test, at once."""
_TEST_EVERY = 1000  # environment steps

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]
Tested = Callable[[int, Policy], bool]
"""Called now and then with environment steps and a deterministic policy; returns true when the success is enough."""


def make_test(task: str = "reach", substeps: int = REFERENCE_SUBSTEPS) -> Callable[[Policy], float]:
    """Returns a test of policies: the success at the last step of `TEST_ENVS` episodes, always the same.

    Args:
      task: a Fetch task.
      substeps: physics steps per action.

    """
    env = gymnasium.make_vec(GYMNASIUM_IDS[task], num_envs=TEST_ENVS, substeps=substeps)

    def success(policy: Policy) -> float:
        observation, info = env.reset(seed=10_000)
        truncated = np.zeros(1, bool)
        while not truncated[0]:
            observation, _, _, truncated, info = env.step(policy(observation))
        return float(info["is_success"].mean())

    return success


def sb3_sac_her(
    tested: Tested, most_steps: int, num_envs: int = 8, task: str = "reach", substeps: int = REFERENCE_SUBSTEPS
) -> None:
    """Trains stable-baselines3's SAC with its `HerReplayBuffer`, a gradient step for each environment step."""
    from stable_baselines3 import SAC, HerReplayBuffer

    from hgail_envs.stable_baselines import GoalVecEnv

    name = GYMNASIUM_IDS[task]
    made: Any = gymnasium.make_vec(name, num_envs=num_envs, autoreset_mode="SameStep", substeps=substeps)
    env = GoalVecEnv(made)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=50 * num_envs,  # hindsight needs an episode of each environment
        gamma=0.95,
        gradient_steps=num_envs,
        learning_rate=1e-3,
        seed=0,
    )

    def goes_on(*_: object) -> bool:
        policy = lambda seen: model.predict(seen, deterministic=True)[0]  # noqa: E731
        return model.num_timesteps % _TEST_EVERY != 0 or not tested(model.num_timesteps, policy)

    model.learn(most_steps, callback=goes_on)


def measure(train: Callable[[Tested, int], None], most_steps: int = 40_000) -> dict[str, float]:
    """Trains, and returns the environment steps, seconds and success of the first test that is `ENOUGH`, or the last.

    The seconds count the compilation, but not the tests.
    """
    test, begin, testing = make_test(), time.perf_counter(), 0.0
    result: dict[str, float] = {}

    def tested(steps: int, policy: Policy) -> bool:
        nonlocal testing
        now = time.perf_counter()
        success = test(policy)
        result.update(steps=steps, seconds=round(now - begin - testing, 1), success=success)
        print(result, file=sys.stderr)
        testing += time.perf_counter() - now
        return success >= ENOUGH

    train(tested, most_steps)
    return result


TRAINERS: dict[str, Callable[[Tested, int], None]] = {"sb3-sac-her": sb3_sac_her, "sac-her": sac_her.train}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trainer", choices=TRAINERS)
    print(measure(TRAINERS[parser.parse_args().trainer]))
