"""Hooks of MkDocs: the figures of the pages, the pictures of the results, and the page of `make demo`."""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from docs._generate import demo, pages, results

_PICTURES = re.compile(r"\]\(\.\./((?:\.\./)*experiments/results/)")
"""Links to the results' pictures in the repository, one folder further up than in the site."""
_DEMO = re.compile(r"<div class=\"demo\">.*?</div>\n", re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Adds the results' pictures to the site's files, and the page that a browser simulates."""
    for path in sorted(results.RESULTS.rglob("*.png")):
        name = path.relative_to(results.ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    for path in sorted(path for path in demo.SITE.rglob("*") if path.is_file()):
        name = f"demo/{path.relative_to(demo.SITE).as_posix()}"
        if source := files.get_file_from_path(name):
            files.remove(source)
        files.append(File.generated(config, name, abs_src_path=str(path), inclusion=InclusionLevel.INCLUDED))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the page with its figures and the site's links to pictures."""
    markdown = _PICTURES.sub(r"](\1", pages.publish(markdown))
    return markdown if demo.SITE.is_dir() else _DEMO.sub("", markdown)
