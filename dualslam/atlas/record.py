"""A run's record, written by tracking and recovery between two frames; and the clock of its stages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.trajectory import FramePose
from dualslam.core.decisions import Gate
from dualslam.core.events import EventKind, EventLog
from dualslam.core.types import BoolArray, FrameMethod, FrameStatus
from dualslam.map.frame_observations import Change, FrameObservations
from dualslam.map.frame_records import FrameRow

MAX_OBSERVED = 10_000
"""Frames of which observations are kept, 24 bytes a landmark: some 60 MB. Those posed earlier are not posed anew."""


@dataclass
class StageTime:
    """CPU seconds, calls and wall seconds of one stage; `longest_s`: wall time of its longest call."""

    seconds: float = 0.0
    calls: int = 0
    wall_s: float = 0.0
    longest_s: float = 0.0


class StageTimer:
    """Adds up CPU seconds of the calling thread by stage name: what other threads decode meanwhile is not in."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTime] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count what runs inside to a stage."""
        start, wall_start = time.thread_time(), time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, time.thread_time() - start, time.perf_counter() - wall_start)

    def add(self, stage: str, seconds: float, wall_s: float = 0.0) -> None:
        """Count CPU seconds that were measured elsewhere, and the wall time, where that is known."""
        total = self.stages.setdefault(stage, StageTime())
        total.seconds += seconds
        total.calls += 1
        total.wall_s += wall_s
        total.longest_s = max(total.longest_s, wall_s)


class FrameStamp(Protocol):
    """A frame, a view, or a row: what has its place in the sequence."""

    @property
    def index(self) -> int:
        """In the source."""
        ...

    @property
    def timestamp_s(self) -> float:
        """Seconds."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Maps, rows, poses, events and times of a run."""

    atlas: Atlas = field(default_factory=Atlas)
    rows: dict[int, FrameRow] = field(default_factory=dict)  # every frame that was given to the system, by its index
    poses: dict[int, FramePose] = field(default_factory=dict)
    observations: dict[int, FrameObservations] = field(default_factory=dict)
    """What they saw of their submaps, of the frames that were posed last."""
    events: EventLog = field(default_factory=EventLog)
    timer: StageTimer = field(default_factory=StageTimer)

    def pose(
        self,
        pose: FramePose,
        n_matches: int | None = None,
        n_inliers: int = 0,
        observations: FrameObservations | None = None,
        method: FrameMethod | None = None,
    ) -> None:
        """Enter where a frame is, and what it saw; without numbers or method, its row keeps those that it has."""
        self.poses[pose.index] = pose
        self.observations.pop(pose.index, None)
        if observations is not None:
            self.observations[pose.index] = observations
            if len(self.observations) > MAX_OBSERVED:
                del self.observations[next(iter(self.observations))]
        row = self.rows[pose.index]
        row.status, row.submap = FrameStatus.TRACKED, pose.submap_id
        if n_matches is not None:
            row.n_matches, row.n_inliers = n_matches, n_inliers
        if method is not None:
            row.method = method

    def change_pixels(self, submap_id: int, change_of: Callable[[int], Change | None]) -> None:
        """Let what a submap's frames have seen follow its pixels: `change_of` tells how those of a frame change."""
        for i, seen in self.observations.items():
            if seen.submap_id == submap_id and (change := change_of(i)) is not None:
                self.observations[i] = seen.with_change(change)

    def own_poses(self) -> Iterator[FramePose]:
        """Yield the poses of this run's frames: those of earlier runs, in a saved map, go by another clock."""
        return (pose for i, pose in self.poses.items() if i in self.rows)

    def are_refound(self, indices: Iterable[int]) -> BoolArray:
        """Return which frames (N,) were found by wide matching, beyond a gap: not by those before them."""
        refound = {event.frame for event in self.events.of_kind(EventKind.GAP_RELOCALISED)}
        return np.array([index in refound for index in indices], bool)

    def event(
        self,
        kind: EventKind,
        at: FrameStamp,
        submap_id: int | None = None,
        gates: tuple[Gate, ...] = (),
        /,
        **data: Any,
    ) -> None:
        """Enter what happened at a frame; `gates`: the comparisons behind it."""
        self.events.add(kind, at.index, at.timestamp_s, submap_id, gates, **data)
