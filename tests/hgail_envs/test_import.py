"""What a process is like after it imports the packages and makes tasks, against what it was like before."""

import os
import subprocess
import sys

from tests.support import SOURCES

IMPORT = """
import os, sys, warnings
import jax

warnings.simplefilter("error")

def settings():
    return dict(os.environ), dict(jax.config.values), tuple(sys.flags), list(sys.path), sys.stdout, sys.excepthook

before = settings()
import hgail_envs, hgail_jax
changed = [(one, other) for one, other in zip(before, settings()) if one != other]
from jax._src import xla_bridge
print(changed, xla_bridge.backends_are_initialized())
warnings.resetwarnings()  # of what follows
"""

MAKE = """
from hgail_envs.randomized import randomize

def refused(make):
    try:
        make()
    except ValueError as error:
        return str(error)

for task in hgail_envs.TASKS:
    for impl in ("auto", "c", "jax"):
        env = hgail_envs.make(task, **{} if task == "point" else {"impl": impl})
        randomize(env, "none" if task == "point" else "full")
        assert not xla_bridge.backends_are_initialized(), (task, impl)
env, unavailable = hgail_envs.make("reach"), hgail_envs.make("reach", impl="warp")
print(refused(lambda: hgail_envs.make("reach", impl="bullet")))
print(env.impl, xla_bridge.backends_are_initialized())
print(refused(lambda: unavailable.engine))
print(refused(lambda: hgail_envs.make("reach", impl="warp")))
"""


def run(lines):
    """Runs a script in a process with the settings of a user who has none, and returns what it prints."""
    own = ("XLA_FLAGS", "NPROC", "MUJOCO_GL")
    # Gymnasium, where it is installed, sets this one for pygame.
    environment = {name: value for name, value in os.environ.items() if name not in own}
    environment |= {"PYTHONPATH": SOURCES, "PYGAME_HIDE_SUPPORT_PROMPT": "hide", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", lines], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


HIDDEN = """
import sys
sys.modules["glfw"] = sys.modules["gymnasium"] = None
import hgail_envs, mujoco
print(hasattr(mujoco, "Renderer"), hgail_envs.make("point").goal_size)
"""


def test_the_package_is_imported_without_gymnasium_and_where_mujoco_finds_no_renderer():
    assert run(HIDDEN) == ["False 3"]


def test_importing_changes_nothing_and_making_a_task_starts_no_jax_and_finds_its_engine_at_first_use():
    missing = "impl 'warp' needs warp-lang and an NVIDIA GPU; use 'jax', 'c' or 'auto'"
    unknown = "unknown impl 'bullet'; choose from auto, warp, c, jax"
    assert run(IMPORT + MAKE) == ["[] False", unknown, "c True", missing, missing]
