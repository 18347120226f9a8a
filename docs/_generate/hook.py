"""Hooks of MkDocs: the figures of the pages, and the pictures of the results."""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from docs._generate import pages, results

_PICTURES = re.compile(r"\]\(\.\./((?:\.\./)*experiments/results/)")
"""Links to the results' pictures in the repository, one folder further up than in the site."""


def on_files(files: Files, config: Any) -> Files:
    """Adds the results' pictures to the site's files."""
    for path in sorted(results.RESULTS.rglob("*.png")):
        name = path.relative_to(results.ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the page with its figures and the site's links to pictures."""
    return _PICTURES.sub(r"](\1", pages.publish(markdown))
