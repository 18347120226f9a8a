"""Figures in README and pages: filled in from the results, or typed and listed with their source."""

import json
import re
import tomllib

import pytest

from docs._generate import pages, results, tables
from tests.support import ROOT

# A decimal, a power of ten, or a count with the unit of a measurement; versions and Python's are none.
_UNIT = r"(?:k|M|s|seconds|minutes|%|(?:env )?steps/s)"
_FIGURE = re.compile(rf"(?<![\w.,-])\d*\.\d+(?![\w.])|\b\d+e-\d+\b|(?<![\w.,])\d[\d,.]* {_UNIT}(?!\w)")
_NO_FIGURE = re.compile(r"\]\([^)]*\)|https?://\S+|Python 3\.\d+( (or|and|to) 3\.\d+)?|\d+\.\d+\.\d+(\.\d+)?")
SOURCES = tomllib.loads((ROOT / "docs" / "_generate" / "typed.toml").read_text())


def typed_figures(page):
    return set(_FIGURE.findall(_NO_FIGURE.sub("", pages.typed(page))))


@pytest.mark.parametrize("path", pages.pages(), ids=lambda path: path.name)
def test_pages_have_the_figures_of_today_s_results(path):
    page = path.read_text()
    assert pages.refresh(page) == page, "run `make docs`"


@pytest.mark.parametrize("path", pages.pages(), ids=lambda path: path.name)
def test_a_typed_figure_is_listed_with_its_source(path):
    listed = SOURCES.get(path.relative_to(ROOT).as_posix(), {})
    assert typed_figures(path.read_text()) == {figure for figures in listed.values() for figure in figures}


def test_the_list_of_typed_figures_names_pages():
    assert SOURCES.keys() <= {path.relative_to(ROOT).as_posix() for path in pages.pages()}


@pytest.mark.parametrize("text", ["0.98", ".98", "1.8 s", "23,781 env steps/s", "1.19 M", "3e-4", "13 minutes", "97 %"])
def test_what_counts_as_a_figure(text):
    found = typed_figures(f"it was {text} in the end")
    assert found, text
    assert not typed_figures(
        f"it was <!--= x -->{text}<!----> and `{text}`, with MuJoCo 3.11.0 and Python 3.11 or 3.12"
    )


@pytest.mark.parametrize("path", pages.pages(), ids=lambda path: path.name)
def test_a_figure_of_the_text_is_a_name_and_never_the_first_of_a_line(path):
    """There Markdown would take its comment for a block of HTML, to which the whole line belongs."""
    for line in path.read_text().splitlines():
        assert not re.match(r"\s*<!--= .*<!---->", line), line
        for expression in re.findall(r"<!--= (.*?) -->.*?<!---->", line):
            assert expression.isidentifier(), line


@pytest.mark.parametrize("path", pages.pages(), ids=lambda path: path.name)
def test_a_page_names_at_its_head_what_it_cites(path):
    page = path.read_text()
    assert "<!-- figures" not in page or page.startswith("<!-- figures\n")
    for name in (named := pages.names(page)):
        others = " ".join(expression for other, expression in named.items() if other != name)
        assert f"<!--= {name} -->" in page or re.search(rf"\b{name}\b", others), name


def test_names_of_a_page():
    head = '<!-- figures\nrow = trial(\n  "table1-reach", "HGAIL")\nsteps = count(row.env_steps_per_seed)\n-->\n\n'
    assert pages.publish(f"{head}in <!--= steps -->?<!----> steps") == "in 320,000 steps"
    assert pages.refresh(f"{head}in <!--= steps -->?<!----> steps") == f"{head}in <!--= steps -->320,000<!----> steps"
    assert pages.typed(f"{head}in <!--= steps -->320,000<!----> steps") == "in  steps"
    with pytest.raises(ValueError, match="twice"):
        pages.publish("<!-- figures\na = 1\na = 2\n-->\n")


def test_an_unknown_row_or_name_is_an_error():
    with pytest.raises(ValueError, match="0 rows"):
        pages.publish('<!--= reached("table1-reach", "no such setting") --><!---->')
    with pytest.raises(Exception, match="undefined"):
        pages.publish("<!--= no_such_name --><!---->")


def settings_of(study):
    return json.loads((ROOT / "experiments" / "results" / "paper" / f"{study}.json").read_text())["settings"]


def test_a_table_says_what_its_file_says():
    """Each row, read by other means: the last columns of a line are the file's."""
    rows = settings_of("table2-reach")
    lines = tables.study("table2-reach").strip().splitlines()[2:]
    assert len(lines) == len(rows) == 4
    for line, row in zip(lines, rows, strict=True):
        cells = [cell.strip() for cell in line.replace("\N{NO-BREAK SPACE}", " ").strip("|").split("|")]
        assert cells[0] == f"{row['setting']}, {row['panel']}"
        assert cells[1].replace("0.", ".") == row["paper_success"]
        mean, interval = map(float, cells[2].split(" ± "))
        assert mean == pytest.approx(row["success_rate"], abs=5e-4)
        assert interval == pytest.approx(row["success_ci95"], abs=5e-4)
        assert int(cells[6].replace(",", "")) == row["env_steps_per_seed"]


def test_curves_are_the_seeds_of_one_setting():
    (curves,) = (row["curves"] for row in settings_of("table1-reach") if row["setting"] == "HGAIL")
    found = results.curve("table1-reach", 166_400, "HGAIL")
    assert found == dict(zip(curves["env_steps"], curves["success"], strict=True))[166_400]
    assert len(found) == 8
