"""Shows a session in a browser, with a handle on the target and a panel of controls."""

import contextlib
import errno
import io
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterable

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from hgail_envs.validation import MOST_SEED
from hgail_jax.play.session import Phase, Session, Status

_FRAME_PERIOD = 0.02  # seconds
_IDLE_PERIOD = 0.2  # seconds between two looks for visitors
_STATUS_PERIOD = 0.1  # seconds
_MOST_BEHIND = 0.25  # seconds that the physics may fall behind before it lets time go
_SPEEDS = {"¼ ×": 0.25, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "4 ×": 4.0}

_BRAND = (22, 107, 184)
_RED = (226, 45, 45)
_CAMERA_POSITION, _CAMERA_TARGET = (2.87, -0.37, 1.32), (1.07, 0.9, 0.58)  # metres
_FARTHER, _HIGHER = 1.8, np.array([0.0, 0.0, 0.6])  # in a window higher than wide; the shown place is metres higher
_FIELD_OF_VIEW = np.radians(35.0)
_HANDLE_SIZE = 0.16  # metres
_LEAST_WIDTH = 1e-3  # metres, of the space along an axis of the handle
_MARK_RADIUS = 0.022  # metres
_ENLARGED = 3  # pixels for each that a policy sees

_MOST_TRIED = 100  # ports
_COLOURS = {"blue": "#166bb8", "green": "#1e8e4e", "red": "#c0392b", "grey": "#6b7280"}


def free_port(host: str, port: int | None, first: int) -> int:
    """Returns `port`, or if it is None the first free port from `first` on; a ValueError says that none is free."""
    tried = range(first, first + _MOST_TRIED) if port is None else (port,)
    reason: OSError | None = None
    for candidate in tried:
        try:
            family, *_, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.create_server(address, family=family):
                return candidate
        except OSError as error:
            reason = error
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                break
    other = "port" if reason and reason.errno in (errno.EADDRINUSE, errno.EACCES) else "host"
    raise ValueError(f"cannot serve on {host}:{tried[0]}: {reason and reason.strerror}; name another --{other}")


class Page:
    """A page that shows a session and lets visitors take part; all of them see the same.

    Visitors choose from `tasks`, of which the first is shown; `open_session` makes the session of a task's name and a
    seed. It runs in the thread of `run`. Visitors' requests reach it through a queue, between two actions.
    """

    def __init__(
        self, open_session: Callable[[str, int], Session], tasks: Iterable[str], seed: int, host: str, port: int
    ) -> None:
        self._open_session, self._tasks = open_session, list(tasks)
        self._task, self._seed = self._tasks[0], seed
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._paused, self._speed, self._dragged, self._due = False, 1.0, False, 0.0
        self._seen: viser.GuiImageHandle | None = None
        self.session = open_session(self._task, seed)
        with contextlib.redirect_stdout(io.StringIO()):  # without its banner
            self.server = viser.ViserServer(host=host, port=port, label="hgail_jax", verbose=False)
        self._configure()
        self._add_controls()
        self._show_scene()

    @property
    def port(self) -> int:
        """The port that the page is served on."""
        return self.server.get_port()

    def run(self) -> None:
        """Serves the page until `close`, or an exception such as that of Ctrl-C, ends it."""
        try:
            last = shown = time.perf_counter()
            rest = 0.0
            while not self._closed.wait(rest):
                self._answer_requests()
                now = time.perf_counter()
                if self.server.get_clients():
                    phase = self.session.phase
                    self.advance(now - last)
                    if now - shown >= _STATUS_PERIOD or self.session.phase is not phase:
                        self._show_status()
                        shown = now
                last = now
                period = _FRAME_PERIOD if self.server.get_clients() else _IDLE_PERIOD
                rest = max(0.0, period - (time.perf_counter() - now))
        finally:
            with contextlib.redirect_stdout(io.StringIO()):  # it says so
                self.server.stop()

    def close(self) -> None:
        """Ends `run`; may be called from any thread."""
        self._closed.set()

    def advance(self, seconds: float) -> None:
        """Runs the session for so many seconds, at the speed that is chosen, and shows the scene."""
        period = self.session.env.control_period
        if not self._paused:
            self._due = min(self._due + self._speed * seconds, self._speed * _MOST_BEHIND + period)
        while self._due >= period:
            self.session.step()
            self._due -= period
        self.session.pose(self._due / period)
        self._scene.update_from_mjdata(self.session.data)
        if not self._dragged and not np.allclose(self._handle.position, self.session.target, atol=1e-5):
            self._handle.position = self.session.target

    def _answer_requests(self) -> None:
        while not self._requests.empty():
            self._requests.get()()

    def _configure(self) -> None:
        server = self.server
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_BRAND)
        server.initial_camera.position, server.initial_camera.look_at = _CAMERA_POSITION, _CAMERA_TARGET
        server.initial_camera.fov = _FIELD_OF_VIEW

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            if client.camera.aspect < 1.0:  # as of a telephone, whose lower half the panel covers
                position, target = np.array(_CAMERA_POSITION), np.array(_CAMERA_TARGET)
                client.camera.position = target + _FARTHER * (position - target)
                client.camera.look_at = target - _HIGHER

        @server.on_client_disconnect
        def _(_) -> None:
            self._requests.put(lambda: self._drag("end", self.session.target))

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._instruction = gui.add_markdown("")
        self._status = gui.add_html("")
        # grey, so that the status stands out
        restart = gui.add_button("New start", color="gray", icon=viser.Icon.REFRESH)
        self._pause_button = gui.add_button("Pause", color="gray", icon=viser.Icon.PLAYER_PAUSE)
        speed = gui.add_dropdown("Speed", list(_SPEEDS), initial_value="1 ×")
        task = gui.add_dropdown("Task", self._tasks, initial_value=self._task)
        seed = gui.add_number("Seed", self._seed, min=0, max=MOST_SEED, step=1, hint="of the starts")
        restart.on_click(lambda _: self._requests.put(self._restart))
        self._pause_button.on_click(lambda _: self._requests.put(self._pause))
        speed.on_update(lambda _: self._requests.put(lambda: self._set_speed(_SPEEDS[speed.value])))
        task.on_update(lambda _: self._requests.put(lambda: self._set_task(task.value)))
        seed.on_update(lambda _: self._requests.put(lambda: self._set_seed(int(seed.value))))

    def _pause(self) -> None:
        self._paused = not self._paused
        self._pause_button.label = "Play" if self._paused else "Pause"
        self._pause_button.icon = viser.Icon.PLAYER_PLAY if self._paused else viser.Icon.PLAYER_PAUSE
        self._show_status()

    def _set_speed(self, speed: float) -> None:
        self._speed = speed

    def _set_seed(self, seed: int) -> None:
        self._seed = seed
        self._restart(seed)

    def _restart(self, seed: int | None = None) -> None:
        self.session.restart(seed)
        self._show_status()

    def _set_task(self, task: str) -> None:
        self._task = task
        self._status.content = _badge("grey", f"Loading {task} …", "")
        self.session = self._open_session(task, self._seed)
        self._show_scene()

    def _drag(self, phase: str, position: np.ndarray) -> None:
        self._dragged = phase != "end"
        if phase == "update":
            self.session.move_target(position)

    def _show_scene(self) -> None:
        scene, session = self.server.scene, self.session
        scene.reset()
        model = session.model
        model.site("target").group = 5  # hidden: the mark below moves with the handle
        self._scene = ViserMujocoScene(self.server, model, num_envs=1)
        self._scene.camera_tracking_enabled = False  # would move the world, but not the handle
        for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):  # drawn as endless grids
            scene.remove_by_name(f"/fixed_bodies/world/{model.geom(plane).name}")
        self._light()
        x, y, z = (bool(width > _LEAST_WIDTH) for width in session.bounds[1] - session.bounds[0])
        self._handle = scene.add_transform_controls(
            "/target",
            scale=_HANDLE_SIZE,
            active_axes=(x, y, z),
            disable_rotations=True,
            depth_test=False,
            line_width=4.0,
        )
        if session.env.target_body is None:
            scene.add_icosphere("/target/mark", radius=_MARK_RADIUS, color=_RED)
        scene.add_label("/target/label", "target", font_screen_scale=0.8)  # seen through whatever hides the ball
        target = session.env.target_body or "red ball"
        self._instruction.content = f"**Drag the {target}** by its arrows: the policy follows."
        self._handle.on_update(
            lambda event: self._requests.put(lambda: self._drag(event.phase, np.array(event.target.position)))
        )
        if self._seen is not None:
            self._seen.remove()
        seen, label = session.seen, "What the policy sees"
        self._seen = None if seen is None else self.server.gui.add_image(_side_by_side(seen), label=label, format="png")
        self._due = 0.0
        self.advance(0.0)
        self._show_status()

    def _light(self) -> None:
        scene = self.server.scene
        # mjviser's meshes are of metal, which reflects its surroundings.
        scene.configure_environment_map("warehouse", environment_intensity=0.65)
        scene.configure_default_lights(enabled=False)
        scene.add_light_directional("/light", intensity=1.2, cast_shadow=True, position=(1.9, 0.2, 3.0))
        scene.add_grid(
            "/floor",
            width=8.0,
            height=8.0,
            cell_size=0.25,
            section_size=1.0,
            position=(1.0, 0.75, 0.0),
            cell_color=(214, 219, 226),
            section_color=(190, 198, 208),
            plane_color=(238, 241, 245),
            plane_opacity=1.0,
            fade_distance=9.0,
            shadow_opacity=0.25,
        )

    def _show_status(self) -> None:
        env, status = self.session.env, self.session.status
        colour, words = ("grey", "Paused") if self._paused else _standing(status)
        distance = f"{100.0 * status.distance:.1f} cm away"
        if not env.lift_test_steps:  # success is a distance
            distance += f"; success within {100.0 * env.success_threshold:.0f} cm"
        counted = f"{status.successes} of {status.episodes} episodes succeeded" if status.episodes else "First episode"
        self._status.content = _badge(colour, words, f"{distance}<br>{counted}")
        if self._seen is not None and (seen := self.session.seen) is not None:
            self._seen.image = _side_by_side(seen)


def _side_by_side(seen: np.ndarray) -> np.ndarray:
    """Returns pictures `[cameras, size, size, 3]` as one, enlarged as they are, for a browser would blur them."""
    return np.hstack([picture.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1) for picture in seen])


def _standing(status: Status) -> tuple[str, str]:
    return {
        Phase.ACTING: ("green", "At the target") if status.reached else ("blue", "On its way"),
        Phase.LIFT_TEST: ("green", "Holding on") if status.success else ("blue", "Put to the test"),
        Phase.STAYING: ("green", "Success"),
        Phase.RESTING: ("green", "Success") if status.success else ("red", "Failed; once more"),
    }[status.phase]


def _badge(colour: str, title: str, text: str) -> str:
    style = f"margin:0 .6em .6em;padding:.7em .9em;border-radius:8px;color:white;background:{_COLOURS[colour]}"
    return (
        f'<div style="{style}">'
        f'<div style="font-size:1.25em;font-weight:600">{title}</div><div style="font-size:.9em">{text}</div></div>'
    )
