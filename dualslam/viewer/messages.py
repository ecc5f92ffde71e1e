"""The messages to a live view: arrays and words, and of the map only what has changed since the last message.

Made in the tracking thread: a message costs a millisecond or two, five times a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dualslam.core.events import Event
from dualslam.core.jobs import JobKind
from dualslam.core.types import BoolArray, FloatArray, Frame, FrameStatus, IntArray, Track
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_records import FrameResult
from dualslam.map.submap import Submap
from dualslam.report.samples import shrunk
from dualslam.report.statuses import event_words

if TYPE_CHECKING:
    from dualslam.system.system import System

WIDTH_PX = 480
"""Of the picture: what a side panel shows."""
MAX_LANDMARKS = 20_000
"""Of one submap: the newest; FACTS of viser: 1.5 ms, and a browser draws ten times as many."""


@dataclass(frozen=True, slots=True, eq=False)
class SubmapArrays:
    """A submap's geometry in its own frame."""

    submap_id: int
    kf: IntArray  # (K,): keyframes, ascending
    T_submap_kf: NDArray[np.float32]  # (K, 4, 4)
    condemned: BoolArray  # (K,): keyframes marked invalid
    landmarks_xyz: NDArray[np.float32]  # (L, 3)


@dataclass(frozen=True, slots=True, eq=False)
class LinkLine:
    """A connection, between two keyframes."""

    kind: str
    a: int
    kf_a: int
    b: int
    kf_b: int
    rejected: bool


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The newest frame, small."""

    pixels: NDArray[np.uint8]  # (H, W, 3): RGB
    uv_px: NDArray[np.float32]  # (N, 2): its features, in pixels of the picture
    matched: BoolArray  # (N,): those that show a landmark


@dataclass(frozen=True, slots=True, eq=False)
class EventWords:
    """An event as a line."""

    kind: str
    frame: int
    submap: int | None
    words: str


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """Reverse tracking that is under way. `place`: where its frame stands among all statuses; None where nowhere."""

    news: WalkNews
    place: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A run as it stands after a frame."""

    frame: int
    timestamp_s: float
    status: FrameStatus
    latency_ms: float
    submap_id: int | None
    T_submap_cam: FloatArray | None  # (4, 4)
    picture: Picture | None  # none where there is no image
    changed: tuple[SubmapArrays, ...]  # submaps of which anything but their place is new
    components: tuple[dict[int, FloatArray], ...]
    """tuple of dict of int to (4, 4): by linked set, each submap's similarity into the frame of the set's first."""
    links: tuple[LinkLine, ...]
    statuses: tuple[str, ...]  # of all frames so far, or of those after `n_statuses_before`
    n_statuses_before: int  # 0 where frames may have been posed later: then `statuses` has all
    events: tuple[EventWords, ...]  # new ones
    walking: tuple[int, ...]  # submaps that are being tracked from in reverse
    walks: tuple[Walk, ...]  # those walks of which anything is known
    backlog: int  # background jobs that wait or are under way
    over: bool = False  # the run has ended


class Teller:
    """Makes the messages of a run, each with what is new since the one before.

    `system`: its `on_pose` is taken, in front of one that is there.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._track: Track | None = None
        self._n_events = 0
        self._n_statuses = 0
        self._places: dict[int, int] = {}  # of frames, among the rows
        self._walks: dict[int, WalkNews] = {}
        self._sent: dict[int, tuple[object, ...]] = {}
        earlier = system.on_pose

        def keep(track: Track) -> None:
            self._track = track
            if earlier is not None:
                earlier(track)

        system.on_pose = keep

    def note_walk(self, news: WalkNews) -> None:
        """Keep the progress of reverse tracking, for the next message."""
        self._walks[news.submap_id] = news

    def tell(self, frame: Frame, result: FrameResult, over: bool = False, within_step: bool = False) -> Message:
        """Return the message after a frame; `within_step`: while the next one is in its step."""
        system = self._system
        events = self._new_events()
        arrays = tuple(_arrays(s) for s in system.atlas.submaps.values() if self._has_changed(s))
        before = 0 if events or over else self._n_statuses
        n_statuses = len(system.rows) - within_step  # what becomes of the newest is not known yet
        statuses = tuple(str(row.status) for row in islice(system.rows.values(), before, n_statuses))
        self._n_statuses = n_statuses
        walking = tuple(m for m in system.atlas.submaps if system.is_tracking_in_reverse(m))
        return Message(
            result.index,
            frame.timestamp_s,
            result.status,
            result.latency_ms,
            result.submap_id,
            result.T_submap_cam,
            self._picture(frame),
            arrays,
            tuple(system.atlas.S_world_submap(component) for component in system.atlas.components()),
            tuple(_lines(system)),
            statuses,
            before,
            events,
            walking,
            self._walks_of(walking),
            sum(system.desk.n_open(kind) for kind in JobKind),
            over,
        )

    def _walks_of(self, walking: tuple[int, ...]) -> tuple[Walk, ...]:
        """Forget the walks that have ended, and return the others."""
        self._walks = {m: news for m, news in self._walks.items() if m in walking}
        rows, numbers = self._system.rows, self._system.numbers
        self._places |= {number: n for n, number in enumerate(islice(rows, len(self._places), None), len(self._places))}
        return tuple(Walk(news, self._places.get(numbers.number_of(news.frame))) for news in self._walks.values())

    def _new_events(self) -> tuple[EventWords, ...]:
        numbers = self._system.numbers
        new = list(islice(self._system.events, self._n_events, None))
        self._n_events += len(new)

        def words(event: Event) -> EventWords:
            told = numbers.told(event)
            return EventWords(str(told.event), told.frame, told.submap, event_words(told.as_dict()))

        return tuple(map(words, new))

    def _has_changed(self, submap: Submap) -> bool:
        """Whether keyframes came, went or moved; the newest few tell of a move, as nothing moves by itself."""
        newest = [T[:3, 3].tobytes() for T in list(submap.T_submap_kf.values())[-8:]]
        stamp = (len(submap.keyframes), len(submap.landmarks), len(submap.condemned), *newest)
        if self._sent.get(submap.id) == stamp:
            return False
        self._sent[submap.id] = stamp
        return True

    def _picture(self, frame: Frame) -> Picture | None:
        if frame.image is None:
            return None
        small, factor = shrunk(frame.image, WIDTH_PX)
        if small.ndim == 2:
            small = np.repeat(small[..., None], 3, axis=2)
        track = self._track
        if track is None or track.view.timestamp_s != frame.timestamp_s:
            return Picture(small, np.zeros((0, 2), np.float32), np.zeros(0, bool))
        uv = (track.view.features.uv_px * factor).astype(np.float32)
        return Picture(small, uv, track.landmark_ids >= 0)


def _arrays(submap: Submap) -> SubmapArrays:
    ids = sorted(submap.keyframes)
    T = np.array([submap.T_submap_kf[k] for k in ids], np.float32).reshape(-1, 4, 4)
    condemned = np.isin(ids, list(submap.condemned))
    xyz = submap.landmarks["xyz_mu"][submap.landmarks["alive"]][-MAX_LANDMARKS:]
    return SubmapArrays(submap.id, np.array(ids, np.int64), T, condemned, xyz.astype(np.float32))


def _lines(system: System) -> list[LinkLine]:
    lines = []
    for link in system.atlas.links:
        kf_a, kf_b = link.attached(system.atlas)
        lines.append(LinkLine(str(link.kind), link.a, kf_a, link.b, kf_b, link.rejected))
    return lines
