"""The live view: what is told of a run is what its map holds, and nothing that the viewer does takes the run along."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import socket
import sys
import time
import urllib.request
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dualslam.cli import main
from dualslam.core import walk_news
from dualslam.core.errors import InputError, OutputError, how_to_install
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray, Frame, FrameStatus
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_records import FrameResult
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, system_in
from dualslam.viewer import live
from dualslam.viewer.colours import STATUS_COLOURS, rgb
from dualslam.viewer.live import PAUSE, SAVE, LiveView
from dualslam.viewer.live_scene import FILLED, TIMELINE_PX, LiveScene, draw_features, draw_timeline
from dualslam.viewer.messages import Message, Picture, Teller
from tests.cli.test_usage import one_sentence
from tests.places.worlds import N, lap

COVERED = frozenset(range(60, 80))
"""Nothing to see: the first map is lost, and a second one starts."""


class Run:
    """A run that was told of after every frame, and all that was told; another tells of reverse tracking besides."""

    def __init__(self) -> None:
        self.world: PointWorld = lap(N + 12, covered=COVERED)
        self.system: System = system_in(self.world, recovery={"enabled": True}, buffer={"duration_s": 0.3})
        teller, self.messages = Teller(self.system), []
        self._steps, self.with_walks = Teller(self.system), []
        self.system.watch_walks(self._on_walk)
        self._done: list[tuple[Frame, FrameResult]] = []
        for frame in self.world.frames():
            result = self.system.step(frame)
            self._done.append((frame, result))
            self.messages.append(teller.tell(frame, result))
            self.with_walks.append((len(self._done), self._steps.tell(frame, result)))
        self.system.finish()
        self.messages.append(teller.tell(frame, result, over=True))
        self.with_walks.append((len(self._done), self._steps.tell(frame, result, over=True)))

    def _on_walk(self, news: WalkNews) -> None:
        self._steps.note_walk(news)
        if self._done:
            self.with_walks.append((len(self._done), self._steps.tell(*self._done[-1], within_step=True)))


@pytest.fixture(scope="module")
def told() -> Run:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walk_news, "EVERY_S", 0.0)
        return Run()


@pytest.fixture(scope="module")
def scene(told: Run) -> LiveScene:
    scene = LiveScene()
    for message in told.messages:
        scene.take(message)
    return scene


def test_the_scene_is_the_atlas(told: Run, scene: LiveScene) -> None:
    atlas = told.system.atlas
    (component,) = atlas.components()
    S_world = atlas.S_world_submap(component)
    assert set(scene.drawn) == set(atlas.submaps)
    for m, submap in atlas.submaps.items():
        drawn = scene.drawn[m]
        T = np.array([submap.T_submap_kf[k] for k in sorted(submap.keyframes)])
        assert np.allclose(drawn.centres, sim3.act(S_world[m], T[:, :3, 3]), atol=1e-4)
        alive = submap.landmarks["xyz_mu"][submap.landmarks["alive"]]
        assert np.allclose(drawn.points, sim3.act(S_world[m], alive), atol=1e-3)
        assert len(drawn.lines) == 8 * len(T) + len(T) - 1
    assert scene.statuses == [str(row.status) for row in told.system.rows.values()]
    lines, _ = scene.link_lines()
    assert len(lines) == len(atlas.links)


def test_what_is_not_linked_stands_beside(told: Run) -> None:
    """Between the start of the second map and the merge: two sets, which do not overlap from left to right."""
    scene = LiveScene()
    for message in told.messages:
        scene.take(message)
        if len(message.components) == 2 and len(scene.drawn) == 2:
            break
    first, second = scene.drawn[0], scene.drawn[1]
    assert second.centres[:, 0].min() > first.centres[:, 0].max()
    assert not told.messages[-1].components[1:], "it was linked later"


def test_events_are_told_once_in_order(told: Run) -> None:
    kinds = [event.kind for message in told.messages for event in message.events]
    assert kinds == [str(event.event) for event in told.system.events]
    assert {"initialised", "failed", "merged"} <= set(kinds)


def test_only_what_changed_is_told_again(told: Run) -> None:
    sizes = [len(message.changed) for message in told.messages]
    assert sum(sizes) < len(sizes) / 2, "most frames are no keyframes"
    lost = [m for m in told.messages if m.status is FrameStatus.LOST]
    assert lost
    assert not any(message.changed for message in lost[1:5])


# --- reverse tracking as it happens


def test_a_walk_is_drawn_beside_the_lost_map_and_goes_when_it_ends(told: Run) -> None:
    scene, frames, lengths = LiveScene(), [], []
    for n_done, message in told.with_walks:
        scene.take(message)
        assert len(scene.statuses) == n_done, "what becomes of the frame in its step is not known yet"
        over_the_gap = [walk for walk in message.walks if walk.news.submap_id == 1]
        if not over_the_gap:
            continue
        (walk,), (drawn,) = over_the_gap, scene.walks
        S = scene.S_world[1]
        assert np.allclose(drawn.way, sim3.act(S, walk.news.way.astype(float)), atol=1e-4)
        assert drawn.way[-1, 0] > scene.drawn[0].centres[:, 0].max(), "where the new map stands, not in the lost one"
        assert walk.place == walk.news.frame, "no frame was left out"
        assert str(walk.news.frame) in drawn.words
        if frames and walk.news.frame > frames[-1]:
            frames, lengths = [], []  # the next attempt
        frames.append(walk.news.frame)
        lengths.append(len(scene.walk_lines()))
    assert len(frames) > len(COVERED)
    assert lengths == sorted(lengths)
    assert not scene.walks
    assert scene.statuses == [str(row.status) for row in told.system.rows.values()]


@pytest.mark.parametrize(("aspect", "covered"), [(1.17, 0.0), (2.4, 0.0), (0.46, 0.6)])
def test_a_window_shows_the_whole_map_beside_what_covers_it(scene: LiveScene, aspect: float, covered: float) -> None:
    """By a pinhole camera of our own, where every camera of the run appears."""
    fov_rad = np.radians(75)
    look_at, position = scene.viewpoint(fov_rad, aspect, covered)
    z = (look_at - position) / np.linalg.norm(look_at - position)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    R_cam_world = np.stack([x, np.cross(z, x), z])
    corners = np.array(list(product(*zip(*scene.bounds(), strict=True))))
    seen = np.concatenate([drawn.centres for drawn in scene.drawn.values()] + [corners])
    right, down, depth = R_cam_world @ (seen - position).T
    assert (depth > 0).all()
    half = np.tan(fov_rad / 2)
    across, below = right / depth / (half * aspect), down / depth / half
    middle = -covered  # of what is not covered, from the upper rim at -1
    fullest = max(np.abs(across).max(), np.abs(below - middle).max() / (1 - covered))
    assert fullest == pytest.approx(FILLED, rel=0.01), "all of it, and as large as it can be"


@pytest.mark.parametrize("place", [0, 7, 99])
def test_the_timeline_marks_where_a_walk_is(place: int) -> None:
    strip = draw_timeline([str(FrameStatus.TRACKED)] * 100, [place])
    columns = np.flatnonzero((strip == 255).all(axis=(0, 2)))
    assert 1 <= len(columns) <= 4
    assert abs(columns.mean() - (place + 0.5) * TIMELINE_PX[0] / 100) < 2


def test_features_on_the_picture() -> None:
    picture = Picture(
        np.zeros((20, 30, 3), np.uint8),
        np.array([[5, 6], [20, 9], [29.6, -0.4]], np.float32),
        np.array([1, 0, 1], bool),
    )
    image = draw_features(picture)
    assert tuple(image[6, 5]) != tuple(image[9, 20]) != (0, 0, 0)
    assert tuple(image[0, 29]) == tuple(image[6, 5]), "at the rim what is inside is drawn"
    assert not picture.pixels.any(), "the frame itself stays"


@pytest.mark.parametrize("n", [1, 7, 480, 5000])
def test_the_timeline_has_every_status_in_its_place(n: int) -> None:
    statuses = [str(FrameStatus.TRACKED)] * n + [str(FrameStatus.LOST)] * n
    strip = draw_timeline(statuses)
    half = TIMELINE_PX[0] // 2
    assert (strip[:, : half - 1] == rgb(STATUS_COLOURS[FrameStatus.TRACKED])).all()
    assert (strip[:, half + 1 :] == rgb(STATUS_COLOURS[FrameStatus.LOST])).all()


# --- the process


class Still:
    """A system of which there is nothing new; `LiveView` asks its teller alone."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self.n_told = 0

    def tell(self, frame: Frame, result: FrameResult, over: bool = False, within_step: bool = False) -> Message:
        self.n_told += 1
        return self.message

    def note_walk(self, news: WalkNews) -> None:
        """Nothing is made of it."""


@pytest.fixture
def view(told: Run, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveView]:
    monkeypatch.setattr(live, "EVERY_S", 0.01)
    monkeypatch.setattr(live, "END_S", 1.0)
    monkeypatch.setattr(live, "Teller", lambda system: Still(told.messages[-1]))
    view = LiveView()
    view.begin(told.system)
    yield view
    view.close()


def test_a_walk_is_told_to_the_viewer_at_once(view: LiveView, told: Run) -> None:
    """Inline the run waits for it: no frame comes that would tell."""
    assert isinstance(view._teller, Still)
    step(view, told)
    n_told, noted = view._teller.n_told, []
    view._teller.note_walk = noted.append  # type: ignore[method-assign]
    for _ in range(20):
        view._on_walk(told)  # type: ignore[arg-type]
        time.sleep(0.02)
    assert len(noted) == 20
    assert view._teller.n_told > n_told


HELD_UP_S = 5.0
"""A full pipe that nobody reads holds up for ever, a busy machine for a second."""


def step(view: LiveView, told: Run) -> float:
    """Let the view look at a frame; return how long the run was held up."""
    began = time.monotonic()
    view.after(Frame(0, 0.0, None), None)  # type: ignore[arg-type]
    return time.monotonic() - began


def test_a_page_is_served_to_this_machine_alone(view: LiveView, told: Run) -> None:
    step(view, told)
    with urllib.request.urlopen(view.url, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    assert view.url.startswith("http://127.0.0.1:")


@pytest.mark.parametrize(
    "sign", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)], ids=["killed", "hung"]
)
def test_a_viewer_that_is_killed_or_hangs_holds_nothing_up(view: LiveView, told: Run, sign: signal.Signals) -> None:
    assert view._idle.wait(10)
    step(view, told)
    assert view._process.pid is not None
    os.kill(view._process.pid, sign)
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        assert step(view, told) < HELD_UP_S
        time.sleep(0.01)
    if sign is signal.SIGKILL:
        assert not view.alive
    began = time.monotonic()
    view.end()
    view.close()
    assert time.monotonic() - began < 10


def test_a_pause_ends_with_the_viewer(view: LiveView, told: Run) -> None:
    step(view, told)
    view._paused = True
    assert view.is_paused()
    view._process.kill()
    deadline = time.monotonic() + 10
    while view.is_paused() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not view.is_paused(), "nobody could let it go on"


def test_what_is_pressed_is_done_between_two_frames(view: LiveView, told: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[str] = []
    view.on_save = pages.append
    monkeypatch.setattr(view, "_pipe", Pressing(view._pipe, [[(SAVE, "<html>")], [(PAUSE, True)], [(PAUSE, False)]]))
    for _ in range(20):
        step(view, told)
        time.sleep(0.02)
    assert pages == ["<html>"]
    assert not view._paused


class Pressing:
    """A pipe whose other end presses what it is told to."""

    def __init__(self, pipe: object, pressed: list[list[tuple[str, object]]]) -> None:
        self._pipe, self._pressed = pipe, pressed

    def send(self, message: object) -> None:
        self._pipe.send(message)  # type: ignore[attr-defined]

    def recv(self) -> list[tuple[str, object]]:
        self._pipe.recv()  # type: ignore[attr-defined]
        return self._pressed.pop(0) if self._pressed else []

    def close(self) -> None:
        self._pipe.close()  # type: ignore[attr-defined]


def test_a_port_that_is_taken_is_one_sentence() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(OutputError, match=f"port {port} is in use"):
            LiveView(port)


def test_without_the_extra_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else find(name))
    with pytest.raises(InputError, match=re.escape(how_to_install("live"))):
        LiveView()


@pytest.mark.slow
def test_the_view_of_a_whole_run(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The trajectory is what it is without a view, and viser is not imported by the run's process."""
    loaded_before = "viser" in sys.modules  # by another test of this process
    assert main(["run", str(folder), "--out", str(tmp_path / "plain"), "--quiet"]) in (0, 1)
    assert main(["run", str(folder), "--out", str(tmp_path / "seen"), "--quiet", "--live"]) in (0, 1)
    assert "live view: http://127.0.0.1:" in capsys.readouterr().out
    seen, plain = (tmp_path / name / "trajectory.txt" for name in ("seen", "plain"))
    assert seen.read_bytes() == plain.read_bytes()
    assert loaded_before or "viser" not in sys.modules


def test_a_port_that_is_none(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), "--live", "99999"]) == 2
    assert "99999" in one_sentence(capsys)


class Window:
    """A camera of viser's: to move it moves what it looks at along."""

    fov, aspect, image_width, up_direction = 1.3, 1.5, 1400, (0.0, 1.0, 0.0)

    def __init__(self) -> None:
        self._position, self.look_at = np.array([3.0, 3.0, 3.0]), np.zeros(3)

    @property
    def position(self) -> FloatArray:
        return self._position

    @position.setter
    def position(self, position: FloatArray) -> None:
        self.look_at = self.look_at + position - self._position
        self._position = np.asarray(position)


def test_a_page_that_is_opened_late_shows_the_whole_map() -> None:
    pytest.importorskip("viser", reason="viser, an extra, is not installed")
    from dualslam.viewer.live_page import Page

    page = Page.__new__(Page)
    page._scene = LiveScene()
    window = Window()
    page._look(SimpleNamespace(camera=window))  # type: ignore[arg-type]
    look_at, position = page._scene.viewpoint(window.fov, window.aspect)
    np.testing.assert_allclose(window.look_at, look_at)
    np.testing.assert_allclose(window.position, position)
