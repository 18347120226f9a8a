import importlib.metadata
import subprocess
from types import SimpleNamespace

import jax
import pytest

import hgail_jax
from hgail_jax.io import provenance


@pytest.mark.parametrize(("platform", "driver"), [("gpu", "580.1"), ("cpu", None)])
def test_what_ran_on_a_gpu_names_its_driver(monkeypatch, platform, driver):
    monkeypatch.setattr(provenance, "driver_version", lambda: "580.1")
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(platform=platform, device_kind="a chip")])
    assert provenance.provenance()["versions"]["driver"] == driver


def test_a_checkout_that_is_not_installed_has_its_own_version(monkeypatch):
    def version(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert provenance.installed("hgail-jax", "jax") == {"hgail-jax": hgail_jax.__version__, "jax": None}


def git(folder, *words):
    of_a_user = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", *of_a_user, *words], cwd=folder, check=True, capture_output=True)


@pytest.mark.parametrize(
    ("place", "tracked", "project", "known"),
    [
        (".", True, "hgail-jax", True),  # the project's own checkout
        (".venv", False, "mine", False),  # installed within another's repository
        ("third_party/hgail_jax", True, "hgail-jax", False),  # a copy in it
        (".", True, "mine", False),  # a copy of the package alone
    ],
)
def test_the_commit_is_that_of_this_project_s_own_checkout_alone(tmp_path, monkeypatch, place, tracked, project, known):
    root = tmp_path / place
    (root / "hgail_jax" / "io").mkdir(parents=True)
    for name, content in (("hgail_jax/io/provenance.py", ""), ("pyproject.toml", f'name = "{project}"\n')):
        (root / name).write_text(content)
    (tmp_path / "of_the_user.py").touch()
    git(tmp_path, "init")
    git(tmp_path, "add", "." if tracked else "of_the_user.py")
    git(tmp_path, "commit", "-m", "first")
    monkeypatch.setattr(provenance, "_ROOT", root)
    monkeypatch.setattr(provenance, "_commit", provenance._commit.__wrapped__)
    commit = provenance.provenance()["commit"]
    assert (commit is not None and len(commit) == 7) == known, commit
