"""What a run waits for before it begins."""

import subprocess
import sys

DRAW_AND_ESTIMATE = ("matplotlib", "scipy.stats")
REPORT = f"import sys, hgail_jax.cli.train; print(*sys.modules.keys() & set({DRAW_AND_ESTIMATE}))"


def test_what_only_its_end_needs_is_not_imported_at_the_start():
    done = subprocess.run([sys.executable, "-c", REPORT], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
