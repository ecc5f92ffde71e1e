"""When a map's start is audited, and how a start that was found to be wrong is cut off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import takewhile

from dualslam.calibration.lens import Calibration
from dualslam.core.events import EventKind
from dualslam.core.types import Failure, FrameStatus
from dualslam.map.record import FrameStamp, Record
from dualslam.map.submap import Submap
from dualslam.recovery.audit import (
    AUDIT_KEYFRAMES,
    BUFFER_SHARE,
    CHANGED,
    MIN_KEYFRAMES,
    Verdict,
    cut_start,
    frames_before,
    judge_start,
    split_for_audit,
    without_start,
)
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.job import RecoveryJob, RecoveryResult

TakeIn = Callable[[RecoveryJob, RecoveryResult], bool]
"""Merges what a walk has found into its submap and solves it; False where it could not be solved."""


class Audits:
    """Knows which maps were audited, and cuts off the start of one where it is the start that is wrong.

    Parameters
    ----------
    record : Record
    buffer : FrameBuffer
    calibration : Calibration
    enabled : bool
    """

    def __init__(self, record: Record, buffer: FrameBuffer, calibration: Calibration, enabled: bool) -> None:
        self._record = record
        self._buffer = buffer
        self._calibration = calibration
        self._enabled = enabled
        self.asked: set[int] = set()
        """Submaps that have been, or whose start is not buffered any more."""

    def due(self, submap: Submap, now: FrameStamp) -> RecoveryJob | None:
        """Return the walk over the start of a map, where it has come of age.

        Not where it is linked: what stands on its start is then no longer its own, and the link was verified.
        """
        if not self._enabled or submap.id in self.asked:
            return None
        oldest, first_id = next(iter(self._buffer), None), min(submap.keyframes)
        if oldest is None or oldest.index > first_id or self._is_linked(submap.id):
            self.asked.add(submap.id)
            return None
        n, held_s = len(submap.keyframes), abs(now.timestamp_s - oldest.timestamp_s)
        if n < AUDIT_KEYFRAMES and (n < MIN_KEYFRAMES or held_s < BUFFER_SHARE * self._buffer.duration_s):
            return None
        self.asked.add(submap.id)
        split = split_for_audit(submap)
        base = without_start(submap, split)
        return RecoveryJob(
            submap=base,
            newest_id=split,
            lost={},
            onsets={},
            views=tuple(takewhile(lambda view: view.index >= first_id, self._buffer.backwards_from(split))),
            own=tuple(view for view in self._buffer if view.index in base.keyframes),
            camera=self._calibration.camera,
            camera_covariance=self._calibration.covariance,
            is_audit=True,
        )

    def take(self, job: RecoveryJob, result: RecoveryResult | Failure, now: FrameStamp, take_in: TakeIn) -> None:
        """Compare a map's start with reverse tracking over it, and act on the verdict."""
        record, submap = self._record, self._record.atlas.submaps[job.submap.id]
        if isinstance(result, Failure):
            record.event(EventKind.AUDITED, now, submap.id, verdict=str(Verdict.UNDECIDED), detail=result.detail)
            return
        record.timer.add("audit", result.cpu_s)
        n_inliers = {i: row.n_inliers for i, row in record.rows.items()}
        report = judge_start(submap, record.poses, n_inliers, job, result)
        verdict, detail = report.verdict, report.detail
        if verdict is Verdict.CUT and not self._cut(job, result, now, take_in):
            verdict, detail = Verdict.UNDECIDED, CHANGED
        told = {"verdict": str(verdict), "detail": detail, "parted_until": report.parted_until}
        record.event(EventKind.AUDITED, now, submap.id, **told, seconds=result.cpu_s, **report.numbers)

    def _is_linked(self, submap_id: int) -> bool:
        return any(submap_id in (link.a, link.b) for link in self._record.atlas.links)

    def _cut(self, job: RecoveryJob, result: RecoveryResult, now: FrameStamp, take_in: TakeIn) -> bool:
        """Make the start a submap of its own, and give its frames the poses of the walk; return whether it was done."""
        record, submap, first = self._record, self._record.atlas.submaps[job.submap.id], min(job.submap.keyframes)
        same_camera = bool((submap.K == job.submap.K).all())
        if self._is_linked(submap.id) or not same_camera:
            return False
        before, frames = submap.copy(), frames_before(record.poses.values(), submap.id, first)
        rows = {i: (record.poses[i], record.rows[i].status, record.observations.get(i)) for i in frames}
        start = before.copy()
        start.id = len(record.atlas.submaps)
        cut_start(submap, first)
        for i in frames:
            del record.poses[i]
        if not take_in(job, result):
            submap.take_over(before)
            for i, (pose, status, seen) in rows.items():
                record.pose(pose, observations=seen)
                record.rows[i].status = status
            return False
        start.condemn(start.keyframes)
        record.atlas.add(start)
        left = [i for i in frames if i not in record.poses]
        for i in frames:
            if i in left:
                pose, _, seen = rows[i]
                seen = None if seen is None else replace(seen, submap_id=start.id)
                record.pose(replace(pose, submap_id=start.id), observations=seen)
            record.rows[i].status = FrameStatus.BYPASSED
        told = {"old_submap": start.id, "before": first, "reposed": len(frames) - len(left), "left": left}
        record.event(EventKind.CUT, now, submap.id, **told)
        return True
