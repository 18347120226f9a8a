"""Fills measured figures into pages, so that a page reads well as it stands and no figure in it is typed.

A figure stands between two comments, the first of which is the Jinja expression that it comes from. A comment that
begins with `<!--%` is a Jinja statement:

    <!--% set row = trial("table1-reach", "HGAIL") -->
    HGAIL reaches <!--= success(row) -->1.000 ± 0.000<!----> of its goals.

`python -m docs._generate.pages` writes the figures of today's results into all pages, and says which it changed.
"""

import re
from pathlib import Path

import jinja2

from docs._generate import results, robust, suite, tables

_FIGURE = re.compile(r"(<!--= .*? -->)(.*?)(<!---->)", re.DOTALL)
_STATEMENT = re.compile(r"<!--% .*? -->\n?", re.DOTALL)
_KEEP = "\x00{}\x00"  # stands for a comment that is written back
_KEPT = re.compile("\x00(\\d+)\x00")


def pages() -> list[Path]:
    """Returns the pages that have figures: README and those of `docs`."""
    return [results.ROOT / "README.md", *sorted((results.ROOT / "docs").rglob("*.md"))]


def publish(page: str) -> str:
    """Returns a page with today's figures and without the comments.

    >>> publish("half is <!--= fixed(0.5, 2) -->?<!---->.")
    'half is 0.50.'
    """
    return _render(_FIGURE.sub(r"\1", page))


def refresh(page: str) -> str:
    """Returns a page as it is, with today's figures.

    >>> refresh("half is <!--= fixed(0.5, 2) -->?<!---->.")
    'half is <!--= fixed(0.5, 2) -->0.50<!---->.'
    """
    kept: list[str] = []

    def keep(comment: str) -> str:
        kept.append(comment)
        return _KEEP.format(len(kept) - 1)

    template = _STATEMENT.sub(lambda match: keep(match[0]) + match[0], page)
    template = _FIGURE.sub(lambda match: keep(match[1]) + match[1] + keep(match[3]), template)
    return _KEPT.sub(lambda match: kept[int(match[1])], _render(template))


def typed(page: str) -> str:
    """Returns a page without its figures, less code: what somebody typed.

    >>> typed("half is <!--= fixed(0.5, 2) -->0.50<!---->, or `0.5`.")
    'half is , or .'
    """
    return re.sub(r"```.*?```|`[^`]*`", "", _STATEMENT.sub("", _FIGURE.sub("", page)), flags=re.DOTALL)


def _render(template: str) -> str:
    """Renders a page; an unknown name, or a row that is not there, is an error."""
    environment = jinja2.Environment(
        variable_start_string="<!--= ",
        variable_end_string=" -->",
        block_start_string="<!--% ",
        block_end_string=" -->",
        comment_start_string="\x02",
        comment_end_string="\x03",
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    modules = (results, tables, suite, robust)
    names = {name: value for module in modules for name, value in vars(module).items() if callable(value)}
    return environment.from_string(template).render(names)


def main() -> None:
    """Writes today's figures into all pages."""
    for path in pages():
        before = path.read_text()
        if (after := refresh(before)) != before:
            path.write_text(after)
            print(path.relative_to(results.ROOT))


if __name__ == "__main__":
    main()
