"""The pages as a whole: the site builds, names what is public, has today's tables, and its examples run."""

import ast
import hashlib
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from mkdocs.commands import build as mkdocs
from mkdocs.config import load_config
from mkdocs.exceptions import Abort
from PIL import Image

import hgail_envs
import hgail_jax
from docs import tables
from experiments import film
from tests.support import PAGES, ROOT, files_of

_PYTHON = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?:\]\(|src=\")([^)\"#{]+)")


def build(folder, source=ROOT):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder]
    return subprocess.run(command, cwd=source, capture_output=True, text=True)


def build_here(folder, source):
    """Returns whether the pages of a folder are built without a warning, in this process."""
    settings = load_config(str(source / "mkdocs.yml"), site_dir=str(folder), strict=True)
    try:
        mkdocs.build(settings)
    except Abort:
        return False
    return True


def test_a_broken_link_is_an_error(tmp_path):
    """`make docs` builds the pages as they are; here the same settings meet a fault."""
    (tmp_path / "docs").mkdir()
    settings = (ROOT / "mkdocs.yml").read_text()
    settings = re.sub(r"(?ms)^(nav|hooks|plugins|extra_css|exclude_docs):.*?(?=^\S|\Z)", "", settings)
    (tmp_path / "mkdocs.yml").write_text(settings)
    page = tmp_path / "docs" / "index.md"
    built = []
    for link in ("[here](#title)", "[nowhere](nowhere.md)", "[nowhere](#nowhere)"):
        page.write_text(f"# Title\n\n{link}\n")
        built.append(build_here(tmp_path / "site", tmp_path))
    assert built == [True, False, False]


def test_the_picture_of_the_starts_has_a_panel_of_each_task():
    width, height = 300, 225 + 24  # with its name above it
    picture = np.asarray(Image.open(film.STARTS).convert("L"))
    rows, columns = picture.shape[0] // height, picture.shape[1] // width
    panels = picture[: rows * height].reshape(rows, height, columns, width).swapaxes(1, 2)
    shown = [task for task in hgail_envs.TASKS if hgail_envs.find_class(task).scene]
    assert (panels[:, :, 24:].std(axis=(2, 3)) > 1).sum() == len(shown)


def test_a_page_fetches_nothing(tmp_path):
    done = build(tmp_path)
    assert done.returncode == 0, done.stderr
    loaded = re.compile(r"<(?:script|img|iframe|link)[^>]+(?:src|href)=\"?(https?:[^\s\">]+)")
    for path in tmp_path.rglob("*.html"):
        assert not loaded.findall(path.read_text()), path.name


@pytest.mark.parametrize("path", [ROOT / "CONTRIBUTING.md", *PAGES], ids=lambda path: path.name)
def test_links_lead_somewhere_in_the_repository_too(path):
    for target in _LINK.findall(re.sub(r"```.*?```|`[^`]*`", "", path.read_text(), flags=re.DOTALL)):
        assert target.startswith("http") or (path.parent / target).exists(), target


def rows(path):
    """Returns the names of each row of a table of questions: the files and folders, and what is to be found there."""
    table = path.read_text().split("| question | file |\n|---|---|\n")[1].split("\n\n")[0]
    for row in table.splitlines():
        names = re.findall(r"`([\w./-]+)`", row)
        yield [name for name in names if "/" in name or name.endswith(".py")], [n for n in names if n.isidentifier()]


@pytest.mark.parametrize(
    "path", [ROOT / "CONTRIBUTING.md", ROOT / "experiments" / "README.md"], ids=lambda path: path.name
)
def test_questions_lead_to_files_that_have_the_answer(path):
    for names, identifiers in rows(path):
        found = [next((p / name for p in (ROOT, path.parent) if (p / name).exists()), None) for name in names]
        assert None not in found, names
        files = [file for each in found for file in ([each] if each.is_file() else each.rglob("*.py"))]
        text = " ".join(file.read_text() for file in files if file.suffix == ".py")
        for name in identifiers:
            assert re.search(rf"\b{name}\b", text), f"{name} is not in {names}"


def test_public_names_are_documented():
    written = (ROOT / "docs" / "api.md").read_text()
    for package in (hgail_jax, hgail_envs):
        for name in set(package.__all__) - {"__version__"}:
            assert re.search(rf"\b(hgail_jax|hgail_envs)\.{name}\b", written), name


QUICK = ["add-a-task", "add-a-method", "run-folder", "robust", "real-robot", "tasks", "add-a-robot"]
TRAINING = ["README", "concepts", "index", "getting-started", "sweeps", "off-policy"]


def blocks(page):
    """Returns the Python blocks of a page, parsed."""
    path = ROOT / ("README.md" if page == "README" else f"docs/{page}.md")
    return [ast.parse(block, str(path)) for block in _PYTHON.findall(path.read_text())]


def test_all_examples_are_among_those_that_run():
    have = {path.stem for path in PAGES if _PYTHON.search(path.read_text())}
    assert have == {*QUICK, *TRAINING}


@pytest.mark.parametrize("page", [*QUICK, *(pytest.param(page, marks=pytest.mark.slow) for page in TRAINING)])
def test_examples_run(page, tmp_path, monkeypatch):
    """The blocks of a page run one after another, in a folder where they may write."""
    monkeypatch.chdir(tmp_path)
    if page == "real-robot":
        pytest.importorskip("onnxruntime")
    if page == "add-a-robot":
        pytest.importorskip("gymnasium_robotics")
    for name in ("experiments", "assets"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.setitem(hgail_jax.METHODS, "mine", None)  # whatever the page sets is undone
    for name, content in files_of(ROOT / "docs" / f"{page}.md").items() if page != "README" else ():
        (tmp_path / name).write_text(content)
    names = {"__name__": "example"}
    for block in blocks(page):
        exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("page", TRAINING)
def test_examples_import_what_there_is(page):
    for block in blocks(page):
        imports = [node for node in block.body if isinstance(node, ast.Import | ast.ImportFrom)]
        assert imports
        exec(compile(ast.Module(imports, []), page, "exec"), {})


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
