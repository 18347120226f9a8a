"""Meta-World's drawer, unchanged, in the scene of the page on own tasks; the package is not among the requirements."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

import hgail_envs
from tests.support import own_tasks

found = importlib.util.find_spec("metaworld")
pytestmark = pytest.mark.skipif(found is None, reason="needs pip install --no-deps metaworld")


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    with own_tasks(tmp_path_factory.mktemp("own")) as folder:
        (folder / "packages").symlink_to(Path(found.submodule_search_locations[0]).parent)
        yield hgail_envs.make("metaworld_drawer:Drawer", robot="franka", substeps=8)


@pytest.fixture(scope="module")
def other():
    """Returns the drawer as Meta-World has it."""
    assets = Path(found.submodule_search_locations[0]) / "assets"
    return mujoco.MjModel.from_xml_path(str(assets / "sawyer_xyz" / "sawyer_drawer.xml"))


def test_the_drawer_moves_as_in_meta_world(env, other):
    for field in ("mass", "inertia", "ipos"):
        np.testing.assert_allclose(
            getattr(env.model.body("drawer_link"), field), getattr(other.body("drawer_link"), field), atol=1e-9
        )
    for field in ("range", "damping", "frictionloss", "armature", "axis"):
        np.testing.assert_allclose(
            getattr(env.model.joint("goal_slidey"), field), getattr(other.joint("goal_slidey"), field)
        )


def test_the_hand_touches_what_collides_there(env, other):
    touched = {int(geom) for geom in env.model.pair_geom1} | {int(geom) for geom in env.model.pair_geom2}
    for body in ("drawercase_link", "drawer_link"):
        theirs = other.geom_contype[other.geom_bodyid == other.body(body).id] > 0
        ours = [geom in touched for geom in np.flatnonzero(env.model.geom_bodyid == env.model.body(body).id)]
        assert sum(ours) == sum(theirs) > 4


def test_the_part_is_the_handle(env):
    data = mujoco.MjData(env.model)
    data.qpos[:] = env.robot.settle().qpos
    data.joint("goal_slidey").qpos = -0.1
    mujoco.mj_forward(env.model, data)
    place = env._chain.site(data.qpos.astype(np.float32))
    np.testing.assert_allclose(place, data.geom("objGeom").xpos, atol=1e-5)
