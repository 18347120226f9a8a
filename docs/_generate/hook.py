"""Fills in the figures of the pages while MkDocs builds them, and brings along the pictures of the results.

A page is a Jinja template whose names are the functions of `results` and `tables`; an unknown name, or a row that is not
there, ends the build.
"""

import sys
from pathlib import Path
from typing import Any

import jinja2
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from docs._generate import results, tables

_PICTURES = "../experiments/results/"  # as GitHub finds them from a page


def on_files(files: Files, config: Any) -> Files:
    """Adds the results' pictures to what is published."""
    for path in sorted(results.RESULTS.rglob("*.png")):
        name = path.relative_to(results.ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the page with its figures, and with the pictures where they are published."""
    return render(markdown).replace(f"]({_PICTURES}", "](experiments/results/")


def render(template: str) -> str:
    """Returns a template with its figures.

    >>> render("{{ fixed(1.234, 1) }}")
    '1.2'
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    names = {name: value for module in (results, tables) for name, value in vars(module).items() if callable(value)}
    return environment.from_string(template).render(**names, mean=lambda values: sum(values) / len(values))
