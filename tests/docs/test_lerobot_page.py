"""The commands of the page on LeRobot, as they stand there but for their sizes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import ROOT, SOURCES

PAGE = (ROOT / "docs" / "lerobot.md").read_text()
FEWER = {
    "--episodes 200": "--episodes 2",
    "--steps=10000": "--steps=2 --policy.device=cpu --num_workers=0",
    "--batch_size=64": "--batch_size=2",
    "--eval.n_episodes=100 --eval.batch_size=50\n": "--eval.n_episodes=2 --output_dir=act-eval --policy.device=cpu\n",
    "--method gail-demo": "--method gail-demo --rounds 1 --seeds 1 --evaluation-episodes 8",
}


@pytest.mark.slow
def test_the_commands_run(tmp_path):
    """Push is evaluated in full: its success is that of `hgail evaluate`."""
    pytest.importorskip("lerobot", reason="LeRobot is missing")
    blocks = re.findall(r"^```\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[1:]  # the first installs
    script = 'set -e\nhgail() { python -m hgail_jax "$@"; }\n' + "".join(blocks)
    for full, few in FEWER.items():
        assert full in script, full
        script = script.replace(full, few)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": SOURCES, "PATH": path, "HF_HUB_OFFLINE": "1"}
    ended = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr[-2000:]
    outcome = json.loads((tmp_path / "push-eval" / "eval_info.json").read_text())["overall"]
    assert outcome["n_episodes"] == 100
    assert outcome["pc_success"] >= 97.0
