"""Hooks of MkDocs: the page of `make demo`, and tables without cog's comments."""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from docs._generate import demo

_COG = re.compile(r"<!-- \[\[\[.*?\]\]\] -->\n")
_DEMO = re.compile(r"<div class=\"demo\">.*?</div>\n", re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Adds the page that a browser simulates to the site's files."""
    for path in sorted(path for path in demo.SITE.rglob("*") if path.is_file()):
        name = f"demo/{path.relative_to(demo.SITE).as_posix()}"
        if source := files.get_file_from_path(name):
            files.remove(source)
        files.append(File.generated(config, name, abs_src_path=str(path), inclusion=InclusionLevel.INCLUDED))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the page without comments, and without the demo where none was built."""
    markdown = _COG.sub("", markdown)
    return markdown if demo.SITE.is_dir() else _DEMO.sub("", markdown)
