"""What MkDocs asks for while it builds the pages: their figures, and the pictures of the results."""

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from docs._generate import pages, results

_PICTURES = re.compile(r"\]\(\.\./((?:\.\./)*experiments/results/)")
"""The results' pictures as a page of the repository names them: from one folder further up than in the site."""


def on_files(files: Files, config: Any) -> Files:
    """Adds the results' pictures to what is published."""
    for path in sorted(results.RESULTS.rglob("*.png")):
        name = path.relative_to(results.ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Returns the page with its figures, and with the pictures where they are published."""
    return _PICTURES.sub(r"](\1", pages.publish(markdown))
