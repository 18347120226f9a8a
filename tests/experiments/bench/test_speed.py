"""Rates of a row follow from the seconds of its calls."""

from experiments.bench.speed import Stepping
from experiments.bench.workload import Workload


def test_a_row_of_stepping_has_the_rate_that_its_seconds_say():
    workload = Workload("reach", "c", num_envs=2, substeps=4, quick=True)
    stepping = Stepping(workload)
    ends = stepping.calls["raw"]()
    assert (
        ends.pipeline_state.qpos.shape[0] == 2
        and (ends.pipeline_state.qpos != workload.reset().pipeline_state.qpos).any()
    )
    row = stepping.row({"raw": 0.5})
    assert row["raw_env_steps_per_second"] == 2 * workload.env.episode_length / 0.5
