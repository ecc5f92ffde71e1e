"""The page of a live view, drawn by viser. The only file that imports viser, an extra; it runs in a process of its own.

Handles are updated, never added again: a submap has one cloud and one set of lines for as long as it is there.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from contextlib import redirect_stdout
from html import escape
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray, FrameStatus
from dualslam.report.statuses import MEANING, count
from dualslam.viewer.colours import STATUS_COLOURS, rgb, submap_rgb
from dualslam.viewer.live import PAUSE, SAVE
from dualslam.viewer.live_scene import LEAST_EXTENT, LiveScene, draw_features, draw_timeline
from dualslam.viewer.messages import EventWords, Message

HOST = "127.0.0.1"
N_EVENTS = 8
"""Lines of the newest events."""
TOLD = {
    "initialised": "map started",
    "reinitialised": "new map started",
    "failed": "track lost",
    "gap_relocalised": "found again",
    "relocalised": "place found again",
    "recovery_started": "tracking in reverse",
    "recovery_failed": "no link found by reverse tracking",
    "linked": "maps joined",
    "relinked": "scale of a join measured again",
    "merged": "maps joined by a place that both show",
    "loop_closed": "loop closed",
    "link_refused": "link refused",
    "cut": "wrong start cut off",
    "connection_rejected": "connection rejected",
    "unreadable": "image unreadable",
    "interrupted": "interrupted",
}
"""Events that are listed as they pass, in words; the report has the others too."""
POINT_SHARE = 0.15
"""Size of a landmark, of a keyframe's."""
WHOLE, FOLLOW, FREE = "the whole map", "follow the camera", "free"
UP = (0.0, -1.0, 0.0)
WALK_RGB = (245, 245, 245)
"""Of the way of reverse tracking that is under way: no submap's."""
GROWN, SHRUNK = 1.1, 0.8
"""So many times as large as it was when it was shown whole, a map is shown whole again."""
NARROW_PX, COVERED = 640, 0.6
"""Windows up to this width have the panel below, over this part of the scene."""


def serve(pipe: Connection, port: int) -> None:
    """Show a run until the pipe is closed.

    - `pipe`: first it receives where the page is; then each message is answered with what was pressed since the one
      before.
    - `port`: 0: a free one.
    """
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):  # of viser: the run says where the page is
        _serve(pipe, port)


def _serve(pipe: Connection, port: int) -> None:
    try:
        server = viser.ViserServer(HOST, port or _free_port(), label="dualslam", verbose=False)
        if port and server.get_port() != port:
            server.stop()
            pipe.send(("no", f"port {port} is in use; give --live another one, or none."))
            return
    except OSError as error:
        pipe.send(("no", f"the live view cannot listen on port {port}: {error.strerror or error}."))
        return
    page = Page(server)
    pipe.send(("at", f"http://{HOST}:{server.get_port()}"))
    try:
        while True:
            message = pipe.recv()
            if isinstance(message, Message):
                page.show(message)
            pipe.send(page.pressed())
    except (EOFError, OSError):
        server.stop()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


class Page:
    """Contents of the page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._scene = LiveScene()
        self._clouds: dict[int, Any] = {}
        self._lines: dict[int, Any] = {}
        self._events: deque[tuple[EventWords, int]] = deque(maxlen=N_EVENTS)
        self._pressed: list[tuple[str, object]] = []
        self._was_at: FloatArray | None = None
        self._shown = LEAST_EXTENT
        server.gui.configure_theme(
            control_layout="collapsible", dark_mode=True, show_logo=False, show_share_button=False
        )
        server.gui.set_panel_label("dualslam")
        server.scene.set_up_direction("-y")  # the first camera's frame: x right, y down, z forward
        self._add_panel()
        blank = np.zeros((1, 2, 3), np.float32)
        self._links = server.scene.add_line_segments(
            "/links", blank, np.zeros((1, 2, 3), np.uint8), thickness=4.0, thickness_units="screen"
        )
        self._ways = server.scene.add_line_segments(
            "/walks", blank, WALK_RGB, thickness=3.0, thickness_units="screen", visible=False
        )
        self._camera = self._add_camera("/camera")
        self._walkers: dict[int, Any] = {}
        server.on_client_connect(lambda client: self._look(client))

    def _add_camera(self, name: str) -> Any:
        return self._server.scene.add_camera_frustum(
            name, fov=0.9, aspect=4 / 3, scale=0.1, thickness=3.0, thickness_units="screen", visible=False
        )

    def _add_panel(self) -> None:
        gui = self._server.gui
        grey = np.full((3, 4, 3), 235, np.uint8)
        self._state = gui.add_markdown("waiting for the first frame")
        self._image = gui.add_image(grey, format="jpeg", jpeg_quality=70)
        self._timeline = gui.add_image(grey, format="png")
        self._key = gui.add_html("")
        self._pause = gui.add_checkbox("pause the run", False)
        self._pause.on_update(lambda _: self._pressed.append((PAUSE, self._pause.value)))
        self._view = gui.add_dropdown("view", (WHOLE, FOLLOW, FREE), initial_value=WHOLE)
        self._view.on_update(lambda event: self._look(event.client) if self._view.value == WHOLE else None)
        self._landmarks = gui.add_checkbox("landmarks", True)
        self._landmarks.on_update(lambda _: self._show_landmarks())
        save = gui.add_button("save this map as a page")
        # The scene as HTML that needs nothing else, and opens on the whole map.
        save.on_click(lambda _: self._pressed.append((SAVE, str(self._server.scene.as_html(dark_mode=True)))))
        self._told = gui.add_markdown("")

    def pressed(self) -> list[tuple[str, object]]:
        """Return what was pressed since the last call."""
        pressed, self._pressed = self._pressed, []
        return pressed

    def show(self, message: Message) -> None:
        """Bring the page up to a message."""
        scene, server = self._scene, self._server
        scene.take(message)
        with server.atomic():
            for m in sorted(scene.stale):
                self._draw(m)
            scene.stale.clear()
            points, colours = scene.link_lines()
            self._links.visible = bool(len(points))
            if len(points):
                self._links.points, self._links.colors = points, _as_lines_are_lit(colours)
            self._move_camera(message)
            self._move_walkers()
            self._tell(message)
        server.flush()

    def _draw(self, m: int) -> None:
        drawn, scene = self._scene.drawn[m], self._server.scene
        if m not in self._lines:
            colour = np.array(submap_rgb(m), np.uint8)
            self._lines[m] = scene.add_line_segments(
                f"/submap {m}/keyframes",
                drawn.lines,
                _as_lines_are_lit(drawn.line_rgb),
                thickness=1.5,
                thickness_units="screen",
            )
            size = POINT_SHARE * self._scene.size
            self._clouds[m] = scene.add_point_cloud(
                f"/submap {m}/landmarks",
                drawn.points,
                colour,
                point_size=size,
                point_shape="circle",
                point_shading="flat",
            )
            self._show_landmarks()
            return
        self._lines[m].points, self._lines[m].colors = drawn.lines, _as_lines_are_lit(drawn.line_rgb)
        self._clouds[m].points = drawn.points
        self._clouds[m].point_size = POINT_SHARE * self._scene.size

    def _show_landmarks(self) -> None:
        for cloud in self._clouds.values():
            cloud.visible = self._landmarks.value

    def _move_camera(self, message: Message) -> None:
        T = self._scene.T_world_cam
        if T is None:
            return
        self._show_camera(self._camera, T, STATUS_COLOURS[message.status])
        step = np.zeros(3) if self._was_at is None else T[:3, 3] - self._was_at
        self._was_at = T[:3, 3].copy()
        first = self._server.initial_camera  # of pages that are opened from now on
        first.up, first.look_at, first.position = UP, *self._scene.viewpoint()
        outgrown = not SHRUNK * self._shown <= self._scene.extent <= GROWN * self._shown
        for client in self._server.get_clients().values():
            if self._view.value == FOLLOW:
                client.camera.position = client.camera.position + step
                client.camera.look_at = client.camera.look_at + step
            elif self._view.value == WHOLE and outgrown:
                self._look(client)

    def _show_camera(self, camera: Any, T_world_cam: FloatArray, colour: int) -> None:
        camera.visible = True
        R = T_world_cam[:3, :3]
        camera.position, camera.wxyz = T_world_cam[:3, 3], so3.quat_xyzw_from_matrix(R)[[3, 0, 1, 2]]
        camera.scale = 3.0 * self._scene.size
        camera.color = rgb(colour)

    def _move_walkers(self) -> None:
        """Show how far reverse tracking has come: its way, and a camera where it has posed a frame last."""
        lines = self._scene.walk_lines()
        self._ways.visible = bool(len(lines))
        if len(lines):
            self._ways.points = lines
        walks = {walk.submap_id: walk for walk in self._scene.walks}
        for m, walk in walks.items():
            if walk.T_world_cam is None:
                continue
            if m not in self._walkers:
                self._walkers[m] = self._add_camera(f"/walker of submap {m}")
            status = FrameStatus.RECOVERED if walk.is_posed else FrameStatus.LOST
            self._show_camera(self._walkers[m], walk.T_world_cam, STATUS_COLOURS[status])
        for m in set(self._walkers) - set(walks):
            self._walkers.pop(m).remove()

    def _look(self, client: viser.ClientHandle | None) -> None:
        """Show all of the map from behind and above its first camera."""
        if client is None:
            return
        self._shown = self._scene.extent
        client.camera.up_direction = UP
        window = client.camera
        covered = COVERED if window.image_width <= NARROW_PX else 0.0
        look_at, window.position = self._scene.viewpoint(window.fov, window.aspect, covered)
        window.look_at = look_at  # after the position, which moves it along

    def _tell(self, message: Message) -> None:
        for event in message.events:
            if event.kind in TOLD:
                self._note_event(event)
        submaps = [f"{count(len(message.components), 'map')} of {count(len(self._scene.drawn), 'submap')}"]
        at = {walk.submap_id: f" ({walk.words})" for walk in self._scene.walks}
        submaps += [f"tracking in reverse from submap {m}{at.get(m, '')}" for m in message.walking]
        if message.backlog:
            submaps.append(f"{count(message.backlog, 'job')} beside the tracking")
        lead = "the run is over" if message.over else f"frame {message.frame}, {message.timestamp_s:.2f} s"
        line = f"{message.status}: {MEANING[message.status]} ({message.latency_ms:.0f} ms)"
        self._state.content = f"**{lead}**\n\n{line}\n\n{'; '.join(submaps)}"
        if message.picture is not None:
            self._image.image = draw_features(message.picture)
        places = [walk.place for walk in self._scene.walks if walk.place is not None]
        self._timeline.image = draw_timeline(self._scene.statuses, places)
        self._key.content = _key(self._scene.statuses)
        self._told.content = "\n".join(_as_line(*event) for event in reversed(self._events))

    def _note_event(self, event: EventWords) -> None:
        """Add an event to the list, or to the newest line if that is of its kind: links may be refused by the dozen."""
        n = 1
        if self._events and (self._events[-1][0].kind, self._events[-1][0].submap) == (event.kind, event.submap):
            n += self._events.pop()[1]
        self._events.append((event, n))


def _as_line(event: EventWords, n: int) -> str:
    where = "" if event.submap is None else f", submap {event.submap}"
    times = "" if n == 1 else f" {n} times, last"
    return f"- **{TOLD[event.kind]}**{times} at frame {event.frame}{where}"


def _key(statuses: list[str]) -> str:
    """Return what the colours of the timeline mean, as HTML, for the statuses that are there."""
    items = []
    for status, colour in STATUS_COLOURS.items():
        if str(status) in statuses:
            square = f'<span style="color:rgb{rgb(colour)}">&#9632;</span>'
            items.append(f"{square} {escape(str(status))} {statuses.count(str(status))}")
    return f'<div style="font-size:0.75em;padding:0 1em">{" &nbsp; ".join(items)}</div>'


def _as_lines_are_lit(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours that come out right where a browser takes those of lines as linear light: 2.2 is sRGB's."""
    return np.asarray(255.0 * (colours / 255.0) ** 2.2, np.uint8)
