"""Tables of the pages: those of today's results, row by row."""

import hashlib
import json
import re

import pytest

from docs import tables
from tests.support import PAGES, ROOT

RUNS = {run["name"]: run for run in json.loads((ROOT / "experiments" / "results" / "runs.json").read_text())}


def test_pages_have_the_tables_of_today_s_results(capsys):
    assert tables.main(["--check"]) == 0, "run `make docs`"


def test_all_pages_with_tables_are_written():
    having = {
        path.relative_to(ROOT).as_posix() for path in PAGES if re.search(r"^<!-- \[\[\[cog", path.read_text(), re.M)
    }
    assert having == set(tables.PAGES)


def rows_of(page, function):
    """Returns the rows of a table as a page has them."""
    block = (ROOT / page).read_text().split(f"cog show({function}) ]]] -->")[1].split("<!-- [[[end]]] -->")[0]
    lines = block.replace("\N{NO-BREAK SPACE}", " ").strip().splitlines()
    header, _, *body = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [dict(zip(header, row, strict=True)) for row in body]


@pytest.mark.parametrize(("page", "function"), [("docs/suite.md", "suite"), ("docs/off-policy.md", "off_policy")])
def test_a_row_has_the_figures_of_its_run(page, function):
    """Each row, read by other means: some run has all of its numbers."""
    for row in rows_of(page, function):
        rate = f"{row['success'].split()[0]}, {row['worst seed']}"
        steps = int(row.get("env steps", row.get("all steps")).replace(",", ""))
        alike = [
            run
            for run in RUNS.values()
            if (run["task"], run["learner"], run["env_steps"]) == (row["task"], row["learner"].lower(), steps)
            and round(run["seconds"]["total"]) == int(row["whole run"].removesuffix(" s"))
            and f"{sum(each := run['success']['per_seed']) / len(each):.3f}, {min(each):.3f}" == rate
        ]
        assert len(alike) == 1, row
        assert row["method"] == alike[0]["method"].upper()


def test_a_run_without_a_discriminator_is_her():
    """TD3 by the goal test alone has none."""
    for run in RUNS.values():
        assert (run["method"] == "her") == (run["learner"] == "td3" and run["environment_reward"] == 1.0), run["name"]


def test_every_row_says_what_made_it():
    results = ROOT / "experiments" / "results"
    studies, table4 = (json.loads((results / f"{name}.json").read_text()) for name in ("studies", "table4"))
    for row in [*RUNS.values(), *studies["made_by"].values(), *table4["made_by"].values()]:
        assert row["command"] and row["commit"] and row["device"]["kind"] and row["versions"]["jax"]
    assert all(row["made_by"] in studies["made_by"] and row["seeds"] for row in studies["rows"])


def test_the_archive_is_the_one_of_the_readme():
    (archive,) = (ROOT / "experiments" / "results").glob("*.tar.xz")
    readme = (archive.parent / "README.md").read_text()
    assert archive.name in readme and hashlib.sha256(archive.read_bytes()).hexdigest() in readme
