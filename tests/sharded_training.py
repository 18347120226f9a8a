"""Trains tiny seeds over several devices, in a process that has them."""

import jax
import jax.numpy as jnp
import numpy as np

import hgail_envs
from hgail_jax import phase_table
from hgail_jax.devices.sharding import check_replicas, make_mesh, shard
from hgail_jax.learners import TD3
from hgail_jax.seeds import compile_train_step, init_seeds, trace_evaluation
from tests.support import TINY, four_devices

TINY_TD3 = TINY.replace(learner=TD3(rollouts=2, updates=2, batch=8, buffer_episodes=8), layer_norm=True)


def train(task, groups, devices, final=True, learner="ppo"):
    """Returns every number of the final states, of all metrics and of a final evaluation, `[seeds, ...]` each.

    `groups` lists equally many seeds each; those of a group train side by side, and one program trains all groups.
    """
    env = hgail_envs.make(task, substeps=4) if task == "reach" else hgail_envs.make(task)
    config = TINY_TD3 if learner == "td3" else TINY
    phases, mesh = phase_table(config), make_mesh(len(groups[0]), config.num_envs, jax.devices()[:devices])
    step, evaluate, results = None, None, []
    for seeds in groups:
        states = init_seeds(env, config, config.learner.hyperparameters(), jax.vmap(jax.random.key)(jnp.array(seeds)))
        step = step or compile_train_step(env, config, states, phases[0], mesh)
        if final:
            evaluate = evaluate or trace_evaluation(env, config, states, 8, mesh)()
        states, measured = shard(states, mesh), []
        for row in phases:
            states, metrics = step(states, row)
            measured.append(metrics)
        check_replicas(states)
        numbers = (states.replace(rng=jax.random.key_data(states.rng)), measured, evaluate(states) if final else ())
        results.append([np.asarray(leaf) for leaf in jax.tree.leaves(numbers)])
    return [np.concatenate(leaves) for leaves in zip(*results, strict=True)]


def write(trainings):
    """Writes what `train` returns for each of the arguments, by name, into the working directory."""
    leaves = {name: train(**training) for name, training in trainings.items()}
    np.savez(
        "trained.npz", **{f"{name} {index:03}": leaf for name, of in leaves.items() for index, leaf in enumerate(of)}
    )


def train_on_four_devices(forks, **trainings):
    """Returns what `train` returns for each of the keyword arguments."""
    ended = forks.run(f"from tests.sharded_training import write\nwrite({trainings!r})", four_devices())
    assert ended.returncode == 0, ended.stderr
    with np.load(ended.folder / "trained.npz") as content:
        return {name: [content[key] for key in content if key.split()[0] == name] for name in trainings}


def assert_close(ours, expected, **tolerance):
    for one, other in zip(ours, expected, strict=True):
        np.testing.assert_allclose(one, other, **tolerance)
