"""What a run has found out so far: the one book that tracking and recovery both write in, between two frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from dualslam.core.events import EventKind, EventLog
from dualslam.core.stage_timer import StageTimer
from dualslam.core.types import BoolArray, FrameStatus
from dualslam.map.atlas import Atlas
from dualslam.map.frame_records import FrameRow
from dualslam.map.trajectory import FramePose


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
    """Maps, rows, poses, events and times of a run.

    Attributes
    ----------
    atlas : Atlas
    rows : dict of int to FrameRow
        Every frame that was given to the system, by its index.
    poses : dict of int to FramePose
    events : EventLog
    timer : StageTimer
    """

    atlas: Atlas = field(default_factory=Atlas)
    rows: dict[int, FrameRow] = field(default_factory=dict)
    poses: dict[int, FramePose] = field(default_factory=dict)
    events: EventLog = field(default_factory=EventLog)
    timer: StageTimer = field(default_factory=StageTimer)

    def pose(self, pose: FramePose, n_matches: int | None = None, n_inliers: int = 0) -> None:
        """Enter where a frame is; without numbers, its row keeps those that it has."""
        self.poses[pose.index] = pose
        row = self.rows[pose.index]
        row.status, row.submap = FrameStatus.TRACKED, pose.submap_id
        if n_matches is not None:
            row.n_matches, row.n_inliers = n_matches, n_inliers

    def own_poses(self) -> Iterator[FramePose]:
        """Yield the poses of this run's frames: those of earlier runs, in a saved map, go by another clock."""
        return (pose for i, pose in self.poses.items() if i in self.rows)

    def are_refound(self, indices: Iterable[int]) -> BoolArray:
        """Return which frames (N,) were found by wide matching, beyond a gap: not by those before them."""
        refound = {event.frame for event in self.events.of_kind(EventKind.GAP_RELOCALISED)}
        return np.array([index in refound for index in indices], bool)

    def event(self, kind: EventKind, at: FrameStamp, submap_id: int | None = None, **data: Any) -> None:
        """Enter what happened at a frame."""
        self.events.add(kind, at.index, at.timestamp_s, submap_id, **data)
