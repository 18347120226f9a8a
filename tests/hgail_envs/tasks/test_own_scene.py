"""A user's own scene: a file beside the task's, and a line for each mistake in it."""

import importlib

import mujoco
import numpy as np
import pytest

from hgail_envs.scenes import assets_directory, open_scene
from hgail_envs.tasks.push import Push
from hgail_envs.tasks.reach import Reach

ROBOT = '<include file="robot.xml"/>'
ROOM = '<include file="room.xml"/>'
_GEOM = '<geom name="post" size=".02 .02 .1" type="box" pos="1.4 .75 .5" contype="0" conaffinity="0"/>'
POST = f"<worldbody>{_GEOM}</worldbody>"


def scene(*parts):
    return f"<mujoco>{''.join(parts)}</mujoco>"


@pytest.fixture
def task_in(tmp_path, monkeypatch):
    """Makes a task whose class and scene are files of their own in a folder, while another is the working folder."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()

    def make(content, name="'post.xml'", base="reach:Reach", file="post.xml"):
        module, base = base.split(":")
        text = f"from hgail_envs.tasks.{module} import {base}\nclass Own({base}):\n    scene = {name}\n"
        module = f"own_{abs(hash((str(tmp_path), content, name)))}"
        (tmp_path / f"{module}.py").write_text(text)
        if content is not None:
            (tmp_path / file).write_text(content)
        return importlib.import_module(module).Own

    return make


def test_a_scene_lies_beside_the_file_of_the_class_that_names_it(task_in, tmp_path):
    own = task_in(scene(ROBOT, ROOM, POST))
    expected = mujoco.MjModel.from_xml_string(POST.join(("<mujoco>", "</mujoco>"))).geom("post").size
    for each in (own, type("Below", (own,), {})):  # whose file is this one
        env = each()
        assert env.model.geom("post").size.tolist() == expected.tolist()
        assert open_scene(env)[0].ngeom > env.model.ngeom  # with those for pictures
    assert type("Here", (Reach,), {"scene": tmp_path / "post.xml"})().model.geom("post").size.tolist() == list(expected)
    assert "post" not in [Reach().model.geom(index).name for index in range(Reach().model.ngeom)]


def test_a_scene_of_a_class_without_a_file_lies_in_the_working_folder(task_in, tmp_path):
    task_in(scene(ROBOT, ROOM, POST), file="work/post.xml")
    names = {"__name__": "somewhere"}
    exec("from hgail_envs.tasks.reach import Reach\nclass Own(Reach):\n    scene = 'post.xml'\n", names)
    assert names["Own"]().model.geom("post").size[2] == 0.1


def test_a_part_beside_the_scene_is_taken_instead_of_the_package_s(task_in, tmp_path):
    room = (assets_directory() / "scenes" / "room.xml").read_text().replace('geom name="floor"', 'geom name="ground"')
    (tmp_path / "room.xml").write_text(room)
    model, _ = open_scene(task_in(scene(ROBOT, ROOM, POST))())
    assert model.geom("ground").id >= 0


@pytest.mark.parametrize(
    ("content", "name", "message"),
    [
        (None, "'gone.xml'", r"Own\.scene is 'gone\.xml', and there is no file /.*/gone\.xml$"),
        (None, "'puhs'", r"Own\.scene is 'puhs'; choose from grasp, push, .*, or name a file of your own, whose name"),
        (
            "<mujoco><worldbody><bdy/></worldbody></mujoco>",
            "'post.xml'",
            r"scene /.*/post\.xml: XML Error: Schema violation: .*line 1",
        ),
        ("no XML", "'post.xml'", r"scene /.*/post\.xml: "),
        (
            scene(ROBOT, ROOM, "<worldbody><body><freejoint/></body></worldbody>"),
            "'post.xml'",
            r"post\.xml: Error: mass",
        ),
        (scene(ROOM, POST), "'post.xml'", r"scene /.*/post\.xml has no site 'grip'; it has target$"),
        (scene(ROBOT, POST), "'post.xml'", r"scene /.*/post\.xml has no site 'target'; it has grip$"),
    ],
)
def test_a_mistake_in_a_scene_gets_one_line_that_names_it(task_in, content, name, message):
    with pytest.raises(ValueError, match=message) as error:
        task_in(content, name)()
    assert "\n" not in str(error.value)


def test_a_scene_without_the_task_s_object_is_refused(task_in):
    with pytest.raises(ValueError, match=r"post\.xml has no joint 'cube'; it has base_x, ") as error:
        task_in(scene(ROBOT, ROOM, POST), base="push:Push")()
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="has no joint 'puck'"):
        type("Odd", (Push,), {"object_name": "puck"})()


def test_geoms_that_touch_by_themselves_are_named(task_in):
    moving = '<worldbody><body name="b" pos="1 1 1"><freejoint/><geom name="ball" size=".02"/></body></worldbody>'
    touching = POST.replace(' contype="0" conaffinity="0"', "")
    with pytest.raises(ValueError, match="the geoms post and ball would touch without a <pair>"):
        task_in(scene(ROBOT, ROOM, touching, moving))()


def pairs_of(model):
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return sorted(tuple(sorted((model.geom(one).name, model.geom(other).name))) for one, other in pairs)


def test_colliding_geoms_touch_the_hand_without_a_pair_and_each_other_do_not(task_in):
    wall = '<geom size=".02 .02 .1" type="box" pos="1.4 .75 .5" friction=".3 .02 .001" condim="4" {}/>'
    door = '<body pos="1.5 .9 .5"><joint name="door"/><geom name="door" size=".2" {}/></body>'
    shown = '<geom name="shown" size=".1" group="2"/><geom name="no" size=".1" contype="0" conaffinity="0"/>'
    paired = '<contact><pair geom1="door" geom2="palm" friction=".7 .7 .1 .1 .1"/></contact>'
    expected = [("door", "left_pad"), ("door", "palm"), ("door", "right_pad")]
    for masks in ("", 'contype="0"', 'conaffinity="0"'):
        own = task_in(scene(ROBOT, ROOM, f"<worldbody>{wall}{door}{shown}</worldbody>".format(masks, masks), paired))
        model = own().model
        (name,) = {name for pair in pairs_of(model) for name in pair} - {"door", "palm", "left_pad", "right_pad"}
        of_wall = [tuple(sorted((name, part))) for part in ("palm", "left_pad", "right_pad")]
        assert pairs_of(model) == sorted(expected + of_wall)
        frictions = {
            tuple(np.round(model.pair_friction[number], 9)): int(model.pair_dim[number])
            for number, geom in enumerate(model.pair_geom1)
            if model.geom(geom).name == name
        }
        assert frictions == {(0.3, 0.3, 0.02, 0.001, 0.001): 4}
        assert np.count_nonzero(model.pair_friction[:, 0] == 0.7) == 1


def test_a_file_that_changes_gives_another_start(task_in, tmp_path):
    sensor = '<sensor><touch site="grip"/></sensor>'
    own = task_in(scene(ROBOT, ROOM, POST))
    assert own()._initial_physics.sensordata.shape == (0,)
    (tmp_path / "post.xml").write_text(scene(ROBOT, ROOM, POST, sensor))
    assert own()._initial_physics.sensordata.shape == (1,)
