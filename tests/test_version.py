"""One version, whoever says it."""

import re
import tomllib

import hgail_jax
from tests.support import ROOT


def test_the_citation_has_the_version_and_the_changelog_its_date():
    citation = (ROOT / "CITATION.cff").read_text()
    version, date = (re.search(rf"^{key}: (\S+)$", citation, re.MULTILINE)[1] for key in ("version", "date-released"))
    assert version == hgail_jax.__version__
    assert f"## {version} ({date})" in (ROOT / "CHANGELOG.md").read_text()


def test_the_distribution_takes_the_version_from_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "hgail_jax/__init__.py"
