"""The published results' settings against today's code: none would be trained again."""

import json

import pytest

from docs._generate.results import RESULTS
from experiments.paper.studies import STUDIES
from experiments.paper.study import choose_seeds
from experiments.paper.trials import Scale, work_out
from hgail_jax.config import LEARNERS, Config, Hyperparameters

OLDER = ("gasil-grasp.json", "table1-longer-grasp.json")  # made before some of the hyperparameters were there


def published(study):
    return [path for path in (RESULTS / "paper").glob(f"{study.name}-*.json") if path.name not in OLDER]


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_published_studies_have_the_settings_of_today(study):
    tasks = {path: path.stem.removeprefix(f"{study.name}-") for path in published(study)}
    for path, task in tasks.items():
        content = json.loads(path.read_text())
        if content.get("study") != study.name or "settings" not in content:  # another study, or means over tasks
            continue
        rows = {(row["setting"], row["panel"]): row for row in content["settings"]}
        assert len(study.settings) == len(rows), path.name
        for setting in study.settings:
            row = rows[setting.name, setting.panel]
            platform = "cpu" if row["made_by"]["device"]["platform"] == "cpu" else "gpu"
            there = row["identity"]
            seeds = choose_seeds(study.tuning, len(there["seeds"]))
            here = work_out(Scale(task, platform), setting, seeds, there["demonstrations"]).identity()
            here["physics"]["impl"] = there["physics"]["impl"]  # which is that of the device
            assert here == there, (path.name, setting.name)


def test_published_runs_can_be_read():
    for path in sorted((RESULTS / "runs").glob("*/config.json")):
        content = json.loads(path.read_text())
        sizes = dict(content["config"])
        learner = dict(sizes.pop("learner"))
        learner = LEARNERS[learner.pop("name")](**learner)
        config = Config(learner=learner, **{k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()})
        assert config.as_dict() == config.as_dict() | {k: v for k, v in sizes.items() if not isinstance(v, list)}
        Hyperparameters(**content["hyperparameters"]).validate()
