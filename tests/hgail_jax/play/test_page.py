"""The page: its thread, and what a visitor sees and does in a real browser."""

import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import imageio.v3 as imageio
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import KINDS, Pictures
from hgail_jax.io.policy import load_policy
from hgail_jax.play.session import Phase, Session
from tests.support import ROOT, SOURCES, free_port

pytest.importorskip("mjviser", reason="the extra web is not installed")

from hgail_jax.play import page as web

_BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_VIEW = {"width": 900, "height": 560}
_PATIENCE = 120.0  # seconds: a browser without a GPU draws slowly


@pytest.fixture
def page(shipped_policy, grasp_policy):
    policies = {"reach": shipped_policy, "grasp": grasp_policy}

    def open_session(task, seed):
        return Session(hgail_envs.make(task, impl="c"), load_policy(policies[task]), seed)

    page = web.Page(open_session, ["reach", "grasp"], 0, "127.0.0.1", free_port())
    yield page
    page.server.stop()


@pytest.mark.parametrize(
    ("host", "port", "said"),
    [("127.0.0.1", None, "name another --port"), ("no.such.host.invalid", 8080, "host"), ("192.0.2.1", None, "host")],
)
def test_a_place_that_cannot_be_served_on_names_what_to_change(host, port, said):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1] if "port" in said else port
        with pytest.raises(ValueError, match=rf"cannot serve on {host}:\d+: .*{said}$"):
            web.free_port(host, number, 8080)


def test_a_page_may_be_served_on_ipv6():
    if not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    assert web.free_port("::1", None, 8080) >= 8080


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_shows_what_a_policy_with_cameras_sees(kind, page, monkeypatch, rendering):
    env = hgail_envs.make("push", impl="c")
    seeing = CameraEnv(env, Pictures(env, ["front", "side"], 16, target="seen", kind=kind))
    sessions = {"push": lambda: Session(seeing, lambda _: np.ones(4)), "reach": lambda: page_session}
    page_session = page.session
    monkeypatch.setattr(page, "_open_session", lambda task, seed: sessions[task]())
    assert page._seen is None
    page._set_task("push")
    assert page._seen.image.shape == (48, 96, 3)
    for _ in range(5):
        page.session.step()
    page._show_status()
    np.testing.assert_array_equal(page._seen.image[1::3, 1::3], np.hstack(page.session.seen))
    page._set_task("reach")
    assert page._seen is None


def test_time_passes_at_the_speed_that_is_chosen(page):
    period, clocks = page.session.env.control_period, []
    page.session.step = lambda: clocks.append(1)
    page.advance(period * 2.5)
    page.advance(period * 0.6)
    assert len(clocks) == 3
    page._set_speed(0.5)
    page.advance(period * 2)
    assert len(clocks) == 4
    page._pause()
    page.advance(period * 3)
    assert len(clocks) == 4
    page._pause()
    page.advance(1000.0)  # a browser that slept: time is let go
    assert len(clocks) < 12


def test_the_page_says_that_it_is_paused(page):
    page._pause()
    assert "Paused" in page._status.content
    page._show_status()
    assert "Paused" in page._status.content
    page._pause()
    assert "Paused" not in page._status.content
    assert "On its way" in page._status.content


def test_the_handle_is_the_target(page):
    np.testing.assert_allclose(page._handle.position, page.session.target, atol=1e-4)
    assert page._handle.active_axes == (True, True, True)
    far = np.array([9.0, 0.7, 0.5])
    page._handle.position = far
    page._drag("update", far)
    page.advance(0.04)
    np.testing.assert_allclose(page._handle.position, far)  # stays in the visitor's hand
    page._drag("end", far)
    page.advance(0.04)
    np.testing.assert_allclose(page._handle.position, page.session.target, atol=1e-4)
    np.testing.assert_allclose(page.session.target, [page.session.bounds[1][0], 0.7, 0.5], atol=1e-6)
    page._set_task("grasp")
    assert page.session.env.target_body == "cube"
    assert page._handle.active_axes == (True, True, False)  # stays on the table
    np.testing.assert_allclose(page._handle.position, page.session.target, atol=1e-4)


def test_a_port_that_is_taken_is_refused_and_another_is_found():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=rf"cannot serve on 127\.0\.0\.1:{port}: .*; name another --port"):
            web.free_port("127.0.0.1", port, 1)
        assert port < web.free_port("127.0.0.1", None, port) <= port + 100


def test_ctrl_c_ends_the_command_in_one_line(tmp_path):
    port = free_port()
    command = "import sys; from hgail_jax.cli import main; main(sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", command, "play", "--web", "--task", "reach", "--port", str(port)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": SOURCES, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    lines = [process.stdout.readline() for _ in range(3)]
    policy = ROOT / "assets" / "policies" / "reach.npz"
    assert lines[1] == f"policy {policy}, nominal\n"
    assert lines[::2] == ["compiling reach ...\n", f"http://127.0.0.1:{port} shows reach; Ctrl-C stops\n"]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}") as answer:
        assert answer.status == 200
    process.send_signal(signal.SIGINT)
    printed, errors = process.communicate(timeout=60)
    assert (process.returncode, printed, errors) == (130, "", "hgail play: stopped by SIGINT\n")
    assert not list(tmp_path.iterdir())


def project(point):
    """Returns the pixel at which the page's first camera shows a point, by its pose and field of view alone."""
    position, target = np.array(web._CAMERA_POSITION), np.array(web._CAMERA_TARGET)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = point - position
    focal = _VIEW["height"] / 2 / np.tan(web._FIELD_OF_VIEW / 2)
    across, up = (focal * (offset @ axis) / (offset @ forward) for axis in (right, np.cross(right, forward)))
    return _VIEW["width"] / 2 + across, _VIEW["height"] / 2 - up


def wait_for(condition):
    deadline = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.1)


def height_of_the_ball(png):
    """How far from the top the lowest red point of a picture is, as a share of its height; infinity without one."""
    picture = imageio.imread(io.BytesIO(png))[..., :3].astype(int)
    red = (picture[..., 0] > 150) & (picture[..., 1:].max(axis=-1) < 90)
    return np.flatnonzero(red.any(axis=1)).max(initial=-1) / len(picture) if red.any() else np.inf


def shows_the_arm(png):
    """Whether blue is on more than a hundredth of the half without the panel, and the rest is not of one colour."""
    picture = imageio.imread(io.BytesIO(png))[:, : _VIEW["width"] // 2, :3].astype(int)
    blue = (picture[..., 2] > 90) & (picture[..., 0] < 60)
    return blue.mean() > 0.01 and picture.std(axis=(0, 1)).min() > 10.0


@pytest.mark.slow
def test_a_visitor_drags_the_target_and_the_policy_follows(page):
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if _BROWSER is None:
        pytest.skip("chromium is not installed")
    session = page.session
    session.move_target((session.bounds[0] + session.bounds[1]) / 2)
    before = session.target
    runner = threading.Thread(target=page.run)
    runner.start()
    try:
        with (
            playwright.sync_playwright() as driver,
            driver.chromium.launch(executable_path=_BROWSER, args=_FLAGS) as browser,
        ):
            visitor = browser.new_page(viewport=_VIEW)
            visitor.set_default_timeout(1000 * _PATIENCE)
            requested = []
            visitor.on("request", lambda request: requested.append(request.url))
            visitor.goto(f"http://127.0.0.1:{page.port}")
            visitor.get_by_text("Drag the red ball").wait_for()
            wait_for(lambda: session.status.phase is Phase.STAYING)
            wait_for(lambda: shows_the_arm(visitor.screenshot()))
            arrow = before + np.array([0.0, 0.0, 0.7 * web._HANDLE_SIZE])
            visitor.mouse.move(*project(arrow))
            visitor.mouse.down()
            for share in np.linspace(0.1, 1.0, 10):
                visitor.mouse.move(*project(arrow + np.array([0.0, 0.0, 0.1 * share])))
            visitor.mouse.up()
            wait_for(lambda: session.target[2] > before[2] + 0.05)
            np.testing.assert_allclose(session.target[:2], before[:2], atol=1e-3)
            wait_for(lambda: session.status.phase is Phase.STAYING)
            visitor.get_by_text("Success", exact=True).wait_for()
            session.pose()
            assert np.linalg.norm(session.data.site("grip").xpos - session.target) < 0.05
            own = f"127.0.0.1:{page.port}"  # a page that needs nothing of the internet
            assert [url for url in requested if own not in url and not url.startswith("data:")] == []
            telephone = browser.new_page(viewport={"width": 400, "height": 800})
            telephone.goto(f"http://127.0.0.1:{page.port}")
            telephone.get_by_text("Drag the red ball").wait_for(timeout=1000 * _PATIENCE)
            wait_for(lambda: height_of_the_ball(telephone.screenshot()) < 0.5)  # above the panel
            assert telephone.evaluate("document.documentElement.scrollWidth") == 400
    finally:
        page.close()
        runner.join()
