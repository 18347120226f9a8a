"""The distribution: its version, and its wheel in a project whose folders are named as this one's are."""

import os
import pathlib
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile

import pytest

import hgail_jax
from tests.support import ROOT

FOLDERS = ("assets", "docs", "envs", "experiments", "tests")
TRAINS = f"""
import sys
import hgail_envs.scenes, hgail_jax.cli.train

at_the_end = set(sys.modules) & {{"matplotlib", "scipy.stats"}}  # of the run, which starts the sooner without them
assert not at_the_end, at_the_end
import {", ".join(FOLDERS)}
assert {{{", ".join(f"{name}.OF" for name in FOLDERS)}}} == {{"this project"}}
print(hgail_jax.__file__, hgail_envs.__file__, hgail_envs.scenes.assets_directory(), sep="\\n")
print(hgail_envs.make("reach").model.nv)

from hgail_jax import PPO, Config, Hyperparameters, init_state, make, phase_table, train_step
import functools, jax

env, config = make("point"), Config(PPO(), num_envs=2, rounds=1)
state = jax.eval_shape(functools.partial(init_state, env, config, Hyperparameters()), jax.random.key(0))
state, metrics = jax.eval_shape(functools.partial(train_step, env, config), state, phase_table(config)[0])
print(metrics.evaluation.success.shape, state.learner.actor_critic.keys())

from hgail_jax.io.provenance import provenance
print(provenance()["commit"])
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT]
    subprocess.run(build, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_a_wheel_holds_two_packages_and_nothing_else(wheel):
    folders = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in folders if not name.endswith(".dist-info")} == {"hgail_envs", "hgail_jax"}
    assert len(folders) == 3
    assert not [name for name in wheel.namelist() if "__pycache__" in name or "/tests/" in name]


def test_a_project_with_folders_of_the_same_names_trains_with_it(wheel, tmp_path):
    project = tmp_path / "project"
    site = project / ".venv" / "site"
    wheel.extractall(site)
    for name in FOLDERS:
        (project / name).mkdir(parents=True)
        (project / name / "__init__.py").write_text('OF = "this project"\n')
    (project / "train.py").write_text(TRAINS)
    of_the_user = ["git", "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init"], ["add", "train.py"], ["commit", "-m", "first"]):
        subprocess.run([*of_the_user, *words], cwd=project, check=True, capture_output=True)
    done = subprocess.run(
        [sys.executable, "train.py"],
        cwd=project,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    *found, velocities, measured, commit = done.stdout.splitlines()
    assert found == [f"{site}/hgail_jax/__init__.py", f"{site}/hgail_envs/__init__.py", f"{site}/hgail_envs/assets"]
    assert velocities == "13"
    assert measured == "() dict_keys(['policy', 'value'])"
    assert commit == "None"  # HEAD is another project's


def test_the_citation_has_the_version_and_the_changelog_its_heading():
    citation = (ROOT / "CITATION.cff").read_text()
    fields = dict(re.findall(r"^(version|date-released): (\S+)$", citation, re.MULTILINE))
    assert fields["version"] == hgail_jax.__version__
    heading = re.search(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    if "dev" in hgail_jax.__version__:  # the version of a release has its date, and work towards one has none
        assert (heading, fields.get("date-released")) == ("Unreleased", None)
    else:
        assert heading == f"{hgail_jax.__version__} ({fields['date-released']})"


@pytest.fixture(scope="module")
def source_distribution(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sdist")
    build = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", folder, ROOT]
    subprocess.run(build, check=True, capture_output=True)
    (path,) = folder.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


def test_a_source_distribution_holds_what_its_readme_needs(source_distribution):
    readme = (ROOT / "README.md").read_text()
    links = set(re.findall(r"(?:\]\(|src=\"|href=\")(?!https?:)([^)\"#]+)", readme))
    assert {"docs/images/policies.webp", "docs/getting-started.md", "CITATION.cff"} <= links
    needed = links | {"Makefile", "requirements.lock", "pyproject.toml", "LICENSE", "assets/scenes/reach.xml"}
    held = source_distribution | {folder for name in source_distribution for folder in parents(name)}
    assert needed <= held, needed - held


def parents(name):
    return [str(folder) for folder in pathlib.PurePosixPath(name).parents]


def test_the_distribution_takes_the_version_from_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "hgail_jax/_version.py"
