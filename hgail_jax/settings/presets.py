"""Settings that several tasks share, and the presets of `--preset`; a task's own numbers are in `defaults`."""

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

from hgail_envs.validation import check_name
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners import CRL, PPO, TD3
from hgail_jax.learners.asymmetric import AsymmetricTD3
from hgail_jax.learners.student import Student


@dataclasses.dataclass(frozen=True)
class Preset:
    """Settings that belong together."""

    config: Config = dataclasses.field(default_factory=lambda: Config(PPO()))
    hyperparameters: Hyperparameters = dataclasses.field(default_factory=Hyperparameters)
    method: str = "hgail"
    """Name of the default method, see `hgail_jax.settings.methods.METHODS`."""
    task_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class, e.g. `substeps` of the Fetch tasks."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next."""


PRESETS = {
    "parallel": Preset(),
    # The paper's sizes: batches of 128 for the policy and 64 for the discriminator, each update one pass over a
    # roll-out of 64 episodes of 50 steps. One thing is not as we read it in the paper, see `AS_WRITTEN`: one update of
    # the policy to three of the discriminator, where it has 16.
    "paper": Preset(
        Config(
            PPO(
                policy_phases=1,
                discriminator_phases=3,
                epochs=1,
                minibatches=25,
                pretrain_policy_minibatches=100,
                pretrain_policy_batch=128,
                pretrain_discriminator_minibatches=500,
                final_learning_rate=1.0,
            ),
            num_envs=64,
            rounds=40,
            discriminator_minibatches=50,
            discriminator_batch=64,
        ),
        Hyperparameters(exploration_noise=1.0, policy_learning_rate=1e-3, discriminator_learning_rate=4e-4),
    ),
}
"""`parallel` is the default: wide roll-outs and few, large updates. `paper` has the paper's sizes."""
AS_WRITTEN: dict[str, Any] = {"policy_phases": 16}
"""Changes to the `Config` of `paper` that make it the paper's, as we read it. With them the policy unlearns its
pre-training: it is updated 16 times against a discriminator that stays as it is."""


OBJECT_SUBSTEPS = {"substeps": 8}
"""Options of a task with an object, whose contacts need shorter physics steps than the arm alone."""


def wide(width: int, layers: int) -> dict[str, Any]:
    """Returns the hidden layers of all networks."""
    return {"policy_hidden": (width,) * layers, "discriminator_hidden": (width,) * layers}


def ppo_with_object(
    num_envs: int, rounds: int, hidden: int | None, evaluate_every: int = 5, **hyperparameters: Any
) -> Preset:
    """Returns the settings that the tasks with an object share: BC beside PPO, few and large updates.

    They were chosen on grasp (docs/lab/ppo.md) and kept for the others.
    """
    widths = {} if hidden is None else wide(hidden, layers=2)
    shared: dict[str, Any] = {
        "exploration_noise": (0.2, 0.2, 0.2, 0.5),  # the hand must open and close by chance, the arm be exact
        "bc_weight": 0.3,  # of .1, .3 and 1 the best on grasp (docs/lab/ppo.md, what was tried)
        "policy_learning_rate": 1e-3,
        "discriminator_learning_rate": 2e-4,  # at 1e-3 it wins against the policy: slide .34 for .56
    }
    return Preset(
        Config(
            PPO(
                # four policy phases to one of the discriminator: with as many of either fewer seeds learn grasp
                policy_phases=4,
                discriminator_phases=1,
                # 51,200 samples of 1,024 episodes make minibatches of 3,200; this and the batches below were tried in
                # no other size
                minibatches=16,
                bc_batch=2048,
                pretrain_policy_batch=1024,
            ),
            num_envs=num_envs,
            rounds=rounds,
            discriminator_batch=1024,
            **widths,
        ),
        Hyperparameters(**(shared | hyperparameters)),
        task_options=OBJECT_SUBSTEPS,
        evaluate_every=evaluate_every,
    )


# Off-policy each step is used forty times on a GPU, where half of 256 environments need a third of the steps for push,
# and twenty times on a CPU, slide ten. There gradient steps are four fifths of the time, and a third layer makes them
# half as slow again (docs/lab/off-policy.md, on two cores). A discriminator of 16 or 32 steps after a roll-out is
# behind one of 64 on push, or alike.
_TD3_SIZES: dict[str, tuple[dict[str, Any], TD3]] = {
    "gpu": (
        {"num_envs": 128, "discriminator_minibatches": 64, "discriminator_batch": 1024} | wide(256, layers=3),
        TD3(),
    ),
    "cpu": (
        {"num_envs": 64, "discriminator_minibatches": 64, "discriminator_batch": 256} | wide(128, layers=2),
        TD3(rollouts=10, batch=256),
    ),
}


def td3(
    sizes: Mapping[str, Mapping[str, Any]] | None = None,
    task_options: Mapping[str, Any] | None = None,
    method: str | Mapping[str, str] = "hgail",
    on_cpu: Mapping[str, Any] | None = None,
    **hyperparameters: Any,
) -> dict[str, Preset]:
    """Returns the settings that tasks share with the learner TD3, by platform, with changes to them.

    Args:
      sizes: changes to the `Config`, by platform.
      task_options: see `Preset`.
      method: the default method, for both platforms or by platform.
      on_cpu: hyperparameters that a CPU has instead.
      hyperparameters: on either platform.
    """
    shared: dict[str, Any] = {
        "p_ht": 0.8,  # at 1, where the critics hardly see a goal that is missed, picking is not learnt
        "bc_weight": 0.0,
        "exploration_noise": 0.2,
        # fewer random actions and less noise on target actions than HER and TD3 have, .3 and .2: pick and place
        # reaches .95 after 198 k steps instead of 326 k
        "epsilon": 0.2,
        "target_noise": 0.1,
        "policy_learning_rate": 1e-3,  # at half of it push and picking are learnt later
        "tau": 0.02,  # at .01 push learns later, at .05 picking does not learn sooner
        # at 3e-4, with the paper's samples, picking without the goal test has .81 for .93
        "discriminator_learning_rate": 1e-3,
        "discriminator_horizon": 1,  # a learned goal test, to which the critics add the horizon; see docs/off-policy.md
        # The adversary's samples (docs/adversary.md): negatives are drawn as the critics' samples are, and all but a
        # twentieth then get the goal of another; a positive's goal is anywhere within half of what counts as reached.
        "shuffled_goals": 0.95,
        "goal_jitter": 0.5,
        "negative_p_ht": 0.8,
    }
    presets = {}
    for platform, (usual, learner) in _TD3_SIZES.items():
        config = Config(learner, layer_norm=True, **usual)  # untried without the norm
        own = hyperparameters | (dict(on_cpu or {}) if platform == "cpu" else {})
        presets[platform] = Preset(
            config.replace(**(sizes or {}).get(platform, {})),
            TD3.hyperparameters(**shared | own),
            method if isinstance(method, str) else method[platform],
            task_options or {},
        )
    return presets


def contrastive(preset: Preset) -> Preset:
    """Returns the settings of contrastive RL, made of those of TD3: the same networks, roll-outs and gradient steps."""
    config = preset.config.replace(learner=CRL(**vars(preset.config.learner)))
    return dataclasses.replace(preset, config=config, method="crl")


def student(rounds: int) -> dict[str, Preset]:
    """Returns the settings that tasks share whose policy sees pictures and is taught, by platform."""
    config = Config(
        Student(), rounds=rounds, training_goals=False, discriminator_minibatches=0, policy_hidden=(256, 256)
    )
    hyperparameters = Hyperparameters(exploration_noise=0.1, policy_learning_rate=1e-3, environment_reward=1.0)
    # A picture takes a CPU a hundredth of a second, a gradient step of 64 samples five: enough to try it out, no more.
    sizes: dict[str, dict[str, Any]] = {
        "cpu": {"num_envs": 16, "updates": 8, "batch": 64},
        "gpu": {"num_envs": 512},
    }
    return {
        platform: Preset(config.replace(**size), hyperparameters, "camera", OBJECT_SUBSTEPS, evaluate_every=5)
        for platform, size in sizes.items()
    }


# Two pictures of 64 x 64 are 24.6 kB, 4,096 episodes of 50 steps 5 GB a seed. The states are donated, but XLA copies
# the buffer in the branch of the update that writes to it, and one seed's once more in the loop over seeds: four seeds
# take 45 GB. On a GPU each step is used twenty times.
_ASYMMETRIC_SIZES: dict[str, dict[str, Any]] = {
    "gpu": {"batch": 512, "buffer_episodes": 4096},
    "cpu": {"num_envs": 16, "rollouts": 5, "updates": 64, "batch": 64, "buffer_episodes": 512},
}
_ASYMMETRIC_METHODS = ("hgail", "her", "hgail-no")  # others keep episodes to learn from, without their pictures
_ASYMMETRIC_ROUNDS = 3  # times those of a policy that observes positions; not measured


def asymmetric(positions: Preset, platform: str) -> Preset:
    """Returns the settings of TD3 from pictures, made of those from `positions` on a platform.

    Raises:
      ValueError: pictures are not for this learner or method.
    """
    config = positions.config
    check_name("learner of pictures without a teacher", config.learner.name, [TD3.name])
    check_name("method of pictures without a teacher", positions.method, _ASYMMETRIC_METHODS)
    learner = AsymmetricTD3(**vars(cast(TD3, config.learner)))
    config = config.replace(learner=learner, rounds=_ASYMMETRIC_ROUNDS * config.rounds)
    return dataclasses.replace(positions, config=config.replace(**_ASYMMETRIC_SIZES[platform]))
