"""Fills measured figures into pages, so that a page reads well as it stands and no figure in it is typed.

A comment at the head of a page names its figures, one a line; an indented line continues the one above it:

    <!-- figures
    hgail = trial("table1-reach", "HGAIL")
    reach = success(hgail)
    -->

The text cites a name, and the figure is written between two comments. A table stands apart, and is a call:

    HGAIL reaches <!--= reach -->1.000 ± 0.000<!----> of its goals.

    <!--= suite() -->

    <!---->

`python -m docs._generate.pages` writes the figures of today's results into all pages, and prints which it changed.
Expressions are Jinja's: `row.success_rate` is an entry of a row, `values | min` the least of a list.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2

from docs._generate import claims, off_policy, results, robots, robust, speed, suite, tables, task_pages

_NAMES = re.compile(r"<!-- figures\n(.*?)\n-->\n+", re.DOTALL)
_FIGURE = re.compile(r"(<!--= (.*?) -->).*?(<!---->)", re.DOTALL)

_jinja = jinja2.Environment(undefined=jinja2.StrictUndefined)


def pages() -> list[Path]:
    """Returns the pages that have figures: README and those of `docs`."""
    return [results.ROOT / "README.md", *sorted((results.ROOT / "docs").rglob("*.md"))]


def publish(page: str) -> str:
    """Returns a page with today's figures and without the comments.

    >>> publish("half is <!--= fixed(0.5, 2) -->?<!---->.")
    'half is 0.50.'
    """
    figure = _figures(page)
    return _FIGURE.sub(lambda match: figure(match[2]), _NAMES.sub("", page))


def refresh(page: str) -> str:
    """Returns a page as it is, with today's figures.

    >>> refresh("half is <!--= fixed(0.5, 2) -->?<!---->.")
    'half is <!--= fixed(0.5, 2) -->0.50<!---->.'
    """
    figure = _figures(page)
    return _FIGURE.sub(lambda match: match[1] + figure(match[2]) + match[3], page)


def typed(page: str) -> str:
    """Returns the typed text of a page, without its figures and code.

    >>> typed("half is <!--= fixed(0.5, 2) -->0.50<!---->, or `0.5`.")
    'half is , or .'
    """
    return re.sub(r"```.*?```|`[^`]*`", "", _FIGURE.sub("", _NAMES.sub("", page)), flags=re.DOTALL)


def names(page: str) -> dict[str, str]:
    r"""Returns the expressions that a page names, in their order.

    >>> names("<!-- figures\nrow = trial(\n  \"table1-reach\", \"HGAIL\")\nreach = success(row)\n-->\n\n# Title")
    {'row': 'trial( "table1-reach", "HGAIL")', 'reach': 'success(row)'}
    """
    lines = "\n".join(_NAMES.findall(page))
    pairs = [line.split(" = ", 1) for line in re.sub(r"\n +", " ", lines).splitlines()]
    if len({name for name, _ in pairs}) < len(pairs):
        raise ValueError(f"a name stands twice: {[name for name, _ in pairs]}")
    return dict(pairs)


def _figures(page: str) -> Callable[[str], str]:
    """Returns the evaluator of a page's expressions; unknown names and rows are errors."""
    modules = (results, tables, speed, suite, robots, robust, claims, off_policy, task_pages)
    known = {name: value for module in modules for name, value in vars(module).items() if callable(value)}

    def value(expression: str) -> Any:
        return _jinja.compile_expression(expression, undefined_to_none=False)(known)

    for name, expression in names(page).items():
        known[name] = value(expression)
    return lambda expression: str(value(expression))


def main() -> None:
    """Writes today's figures into all pages."""
    for path in pages():
        before = path.read_text()
        if (after := refresh(before)) != before:
            path.write_text(after)
            print(path.relative_to(results.ROOT))


if __name__ == "__main__":
    main()
