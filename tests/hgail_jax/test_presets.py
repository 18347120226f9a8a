import pytest

from hgail_jax.cli import train as run
from hgail_jax.distributed.seeds import evaluation_episodes


@pytest.mark.parametrize(
    ("task", "platform", "num_envs", "rounds", "substeps", "episodes"),
    [
        ("reach", "cpu", 64, 6, 4, 128),
        ("reach", "gpu", 256, 4, 4, 512),
        ("grasp", "cpu", 128, 50, 8, 128),
        ("grasp", "gpu", 1024, 40, 8, 1024),
    ],
)
def test_a_run_takes_what_the_readme_says(task, platform, num_envs, rounds, substeps, episodes):
    prepared = run.prepare(run.Options(task=task), platform)
    assert (prepared.config.num_envs, prepared.config.rounds, prepared.env.substeps) == (num_envs, rounds, substeps)
    assert evaluation_episodes(prepared.config, prepared.evaluation_episodes) == episodes
    assert prepared.seeds == 8
