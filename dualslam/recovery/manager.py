"""The lost submaps that wait for a link, the walks that look for it, and how their results come into the live map."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, takewhile
from typing import Any

import numpy as np

from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.trajectory import Path
from dualslam.core.config.settings import RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.jobs import Desk, Ended, JobKind
from dualslam.core.types import Failure, FailureReason, LateFrame, View
from dualslam.linking.join_test import judge_motion
from dualslam.linking.motion import gaps_of, join_slack, seam_motions, step_motions
from dualslam.map.lens import Calibration, rectified_where_possible
from dualslam.map.split import sound_copy
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame, solve
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.fusion import fuse, gauge_at_overlap, note_refused, pose_frames, tighten
from dualslam.recovery.job import FoundLink, RecoveryJob, RecoveryResult, path_of
from dualslam.recovery.merge import merge_recovery
from dualslam.recovery.schedule import LinkTries, RetrySchedule, as_far_as_it_leads, way_to_gaps


@dataclass(frozen=True, slots=True)
class Loss:
    """How a submap was lost: suspected from frame `onset` on, why, and the first frame without a pose."""

    onset: int
    cause: str
    first_frame: int


@dataclass(frozen=True, slots=True)
class _UnderWay:
    """A walk that has begun: when, with how many live keyframes, and whether it is not the submap's first."""

    began_s: float
    n_live: int
    again: bool
    gone_on: set[int] = field(default_factory=set)  # submaps that were found again since


class Recoveries:
    """Starts reverse tracking for each new submap, and merges what it found at a frame boundary.

    - `desk`: where the walks are made.
    - `front_ends`: gives those that go on, or may go on, in a submap of the atlas.

    - `in_real_time`: whether frames come by a clock. Then the first attempt is made alone: the next lost map waits.
    """

    def __init__(
        self,
        record: Record,
        buffer: FrameBuffer,
        desk: Desk,
        new_graph: Callable[[], SubmapGraph],
        calibration: Calibration,
        connections: Connections,
        config: RecoveryConfig,
        front_ends: Callable[[], Iterable[VisualOdometry]],
    ) -> None:
        self._record = record
        self._buffer = buffer
        self._desk = desk
        self._new_graph = new_graph
        self._calibration = calibration
        self._connections = connections
        self._config = config
        self._front_ends = front_ends
        self.in_real_time = False
        self._lost: dict[int, Loss] = {}  # not linked yet, or too loosely, until the newer map is lost as well
        self._under_way: dict[int, _UnderWay] = {}  # by the new submap's id
        self._circumstances: dict[int, dict[str, Any]] = {}  # of the walk, by the new submap's id
        self._retries = RetrySchedule(config.retry_keyframes)
        self._tries = LinkTries()  # at linking lost submaps

    @property
    def waiting(self) -> list[int]:
        """The lost submaps that are not linked yet, or too loosely to be relied on."""
        return sorted(self._lost)

    def declare_lost(self, submap_id: int, onset: int, cause: str, first_lost: int) -> None:
        """Let the walks to come look for a submap: lost at frame `first_lost`, suspected from `onset` on."""
        if self._config.enabled:
            self._lost = self._apart_from(submap_id)
            self._lost[submap_id] = Loss(onset, cause, first_lost)

    def is_under_way(self, submap: Submap) -> bool:
        """Whether reverse tracking from a submap has not come to its end yet."""
        return submap.id in self._under_way

    def found_again(self, submap: Submap) -> None:
        """Let no walk look for a submap that is live again; from its next keyframe one poses the frames of the gap."""
        self._lost.pop(submap.id, None)
        for walk in self._under_way.values():
            walk.gone_on.add(submap.id)
        self._retries.start_of(submap, min(submap.keyframes))
        self._retries.leave_open(submap.id, 0, self._calibration.camera)

    def settle(self, live: VisualOdometry) -> None:
        """Let no walk look any more for what has become one map with the live one."""
        settled = self._record.atlas.component_of(live.submap.id, sure=True)
        self._lost = {m: loss for m, loss in self._lost.items() if m not in settled}

    def start(self, submap: Submap, newest: View, now: FrameStamp | None = None) -> None:
        """Start reverse tracking from a new submap: over the frames without a pose, then on into the lost submaps.

        It begins at its keyframe `newest`, also where it is made again later (`now`).
        """
        lost = self._apart_from(submap.id)
        if lost:
            self._circumstances[submap.id] = self._circumstances_of_loss(lost)
            numbers = {**self._circumstances[submap.id], **self._buffer.numbers}
            self._record.event(
                EventKind.RECOVERY_STARTED,
                now or newest,
                submap.id,
                lost=sorted(lost),
                again=now is not None,
                **numbers,
            )
        views = self._views_before(newest, submap, lost)
        oldest = min((view.index for view in views), default=newest.index)
        late = tuple(frame for frame in self._buffer.late if oldest < frame.index < newest.index)
        self._submit(submap, newest.index, views, lost, now, late)

    def retry(self, submap: Submap, now: FrameStamp, last_chance: bool = False) -> None:
        """Track in reverse again where something was left to find, once the map has grown or its camera was calibrated.

        A link, while the buffer holds frames that a lost map saw; else poses of buffered frames that have none. Links
        that are too loose are measured again.
        `last_chance`: no frame comes any more.
        """
        if submap.id in self._under_way:
            return
        due = self._retries.take_if_due(submap, now.index, self._calibration.camera, last_chance)
        loose = self._joined_loosely(submap.id)
        if not (due or (loose and last_chance)):
            return
        lost = {k for m in self._apart_from(submap.id) for k in self._record.atlas.submaps[m].keyframes}
        own = [view for view in self._buffer if view.index in submap.keyframes]
        first = self._retries.start_of(submap, now.index)
        if own and any(view.index in lost for view in self._buffer):
            self.start(submap, min(own, key=lambda view: (abs(view.index - first), view.index)), now)
        elif way := self._way_to_gaps(submap):
            self._submit(submap, way[0].index, way[1:], {}, now)
        elif loose:
            self._submit(submap, first, (), {}, now)

    def _submit(
        self,
        submap: Submap,
        newest_id: int,
        views: Iterable[View],
        lost: dict[int, Loss],
        now: FrameStamp | None,
        late: tuple[LateFrame, ...] = (),
    ) -> None:
        joined, submaps = self._joined_loosely(submap.id), self._record.atlas.submaps
        job = RecoveryJob(
            submap=submap.copy(),
            newest_id=newest_id,
            lost={m: sound_copy(submaps[m]) for m in lost},
            onsets={m: self._lost[m].onset for m in (*lost, *joined)},
            views=tuple(views),
            own=tuple(view for view in self._buffer if view.index in submap.keyframes),
            camera=self._calibration.camera,
            camera_covariance=self._calibration.covariance,
            tries=self._tries.copy(),
            poses=tuple(p for p in self._record.own_poses() if p.submap_id == submap.id),
            paths={m: self._path_in(m) for m in lost},
            notes_rivals=bool(lost),
            joined={m: sound_copy(submaps[m]) for m in joined},
            live_since=self._retries.start_of(submap, newest_id),
            late=late,
            first_alone=now is not None or self.in_real_time,
        )
        n_live = self._retries.n_live(submap, newest_id if now is None else now.index)
        self._under_way[submap.id] = _UnderWay(time.perf_counter(), n_live, again=now is not None)
        self._desk.submit(JobKind.WALK, job)

    def _path_in(self, submap_id: int) -> Path:
        poses = [pose for pose in self._record.own_poses() if pose.submap_id == submap_id]
        path = Path.of(poses, self._record.atlas.submaps[submap_id])
        return replace(path, refound=self._record.are_refound(path.index.tolist()))

    def _way_to_gaps(self, submap: Submap) -> list[View]:
        """Return the buffered frames without a pose, and what leads to them from the submap; the latest first."""
        poses, own = self._record.poses, self._record.atlas.component_of(submap.id)
        views = as_far_as_it_leads(reversed(tuple(self._buffer)), poses, submap, own)
        return way_to_gaps(tuple(views), poses.keys(), submap.keyframes.keys())

    def collect(self, live: VisualOdometry | None, now: FrameStamp) -> None:
        """Merge the walks that have ended. `live` continues in the merged submap."""
        self._take(self._desk.poll(JobKind.WALK), live, now)

    def finish(
        self, live: VisualOdometry | None, last: FrameStamp | None, interrupted: bool, solve: Callable[[], None]
    ) -> None:
        """Merge the walks that are under way after the last frame, and track in reverse once more.

        `interrupted`: no walk is begun any more. `solve`: waits for the graphs of merged maps, from which it begins.
        """
        if last is None:
            return
        self._take(self._desk.drain(JobKind.WALK), live, last)
        if live is not None and not interrupted:
            solve()
            self.retry(live.submap, last, last_chance=True)
            self._take(self._desk.drain(JobKind.WALK), live, last)

    def _take(self, answers: Iterable[Ended], live: VisualOdometry | None, now: FrameStamp) -> None:
        for ended in answers:
            job: RecoveryJob = ended.work
            walk = self._under_way.pop(job.submap.id)
            result = RecoveryResult.of(job, ended.result).apart_from(walk.gone_on)
            self._note_events(result)
            if result.failure is None:
                self._record.timer.add("walk back", result.cpu_s)
                for lost in job.onsets:
                    self._tries.take_in(lost, job.tries, result.tries)
            else:
                self._failed(job, now, result.failure, time.perf_counter() - walk.began_s)
            poses_any = any(frame.pose.index not in self._record.poses for frame in result.frames)
            if walk.again and not job.lost and not poses_any:
                # The last one for these frames; what it would add to the map is not worth a solution.
                self._tighten(job, result, walk, live, now)
                continue
            link = result.link
            if link is not None and (refused := self._refuse_motion(result, link)) is not None:
                self._note_refused(link, job, refused, now)
                self._failed(job, now, refused, time.perf_counter() - walk.began_s)
                self._retries.leave_open(job.submap.id, walk.n_live, job.camera)  # grown, it knows its velocity better
                continue
            if result.failure is None:
                with self._record.timer.measure("merging"):
                    self._take_in(job, result, live, now, walk.began_s)
            self._tighten(job, result, walk, live, now)
            unlinked = bool(job.lost) and (link is None or link.old_id in self._lost)
            if result.looks_alike:
                continue
            if unlinked or self._way_to_gaps(self._record.atlas.submaps[job.submap.id]):
                left = walk.n_live, job.camera, result.needs_camera, result.stopped_at if job.lost else None
                self._retries.leave_open(job.submap.id, *left)

    def _tighten(
        self, job: RecoveryJob, result: RecoveryResult, walk: _UnderWay, live: VisualOdometry | None, now: FrameStamp
    ) -> None:
        """Replace links that were too loose by what they were measured to be again; those that still are wait on."""
        for found in result.relinked:
            if (refused := self._refuse_motion(result, found)) is not None:
                self._note_refused(found, job, refused, now)
            else:
                tighten(self._record, self._connections, job, found, result.submap, now)
                self._settle(found.old_id, job.submap.id, live)
        if self._joined_loosely(job.submap.id):
            self._retries.leave_open(job.submap.id, walk.n_live, job.camera)

    def _note_refused(self, found: FoundLink, job: RecoveryJob, why: Failure, now: FrameStamp) -> None:
        note_refused(self._record, found, job.submap.id, why, now)
        self._tries.note_try(found.old_id, why.reason)

    def _refuse_motion(self, result: RecoveryResult, found: FoundLink) -> Failure | None:
        """Return why a link is not believed by which the camera would have moved as it never does.

        Across the gaps that reverse tracking has crossed, and where the new map follows on the old one.
        """
        link = found.estimate
        own = (pose for pose in self._record.own_poses() if pose.submap_id == result.submap.id)
        path = path_of(result.submap, result.frames, own)
        known = self._path_in(found.old_id).moved(sim3.inverse(link.S_old_new))
        newest = int(link.agreeing_keyframes[-1])
        old, new = known.take(known.index <= newest), path.take(path.index > newest)
        # The test is made in the unit of the new map, in which the link moves the old one.
        S_new_old, Ad = sim3.inverse(link.S_old_new), sim3.adjoint(link.S_old_new)
        moved = Ad @ link.covariance @ Ad.T

        def slack(i: int, j: int) -> float:
            return join_slack(S_new_old, moved, known.centres[np.isin(known.index, (i, j))][0])

        gaps = step_motions(path, gaps_of(path.times_s), known)
        return judge_motion(chain(gaps, seam_motions(old, new, slack))).refusal()

    def _note_events(self, result: RecoveryResult) -> None:
        """Take over the events of a walk's attempts; each attempt says what was known of the loss, too."""
        told = self._circumstances.get(result.submap.id, {})
        for event in result.events:
            reported = self._record.events.of_kind(EventKind.ATTEMPT_UNAVAILABLE)
            if event.event is EventKind.ATTEMPT_UNAVAILABLE and any(event.data == each.data for each in reported):
                continue
            data = event.data | (told if event.event is EventKind.RECOVERY_ATTEMPT else {})
            at = event.frame, event.timestamp_s, event.submap
            self._record.events.add(event.event, *at, event.gates, **data)

    def _views_before(self, newest: View, submap: Submap, lost: Collection[int]) -> list[View]:
        """Return the buffered frames before a keyframe, the latest first: as far back as a lost map has seen any.

        Where none has, as far as none is posed in another map.
        """
        views, poses = list(self._buffer.backwards_from(newest.index)), self._record.poses
        seen = {i for i, pose in poses.items() if pose.submap_id in lost}
        seen.update(k for m in lost for k in self._record.atlas.submaps[m].keyframes)
        of_lost = [n for n, view in enumerate(views) if view.index in seen]
        if of_lost:
            return views[: of_lost[-1] + 1]
        return list(takewhile(lambda v: v.index not in poses or poses[v.index].submap_id == submap.id, views))

    def _circumstances_of_loss(self, lost: Mapping[int, Loss]) -> dict[str, Any]:
        """Why the newest of the lost maps was lost, and how many frames are buffered of before (k) and since (k_r)."""
        loss = lost[max(lost)]
        indices = [view.index for view in self._buffer]
        k = indices.index(loss.first_frame) if loss.first_frame in indices else 0
        return {"cause": loss.cause, "k": k, "k_r": len(indices) - k}

    def _failed(self, job: RecoveryJob, now: FrameStamp, failure: Failure, seconds: float) -> None:
        data = {"lost": sorted(job.onsets), "reason": str(failure.reason), "detail": failure.detail, "seconds": seconds}
        self._record.event(EventKind.RECOVERY_FAILED, now, job.submap.id, **data)

    # --- taking a result in

    def _take_in(
        self, job: RecoveryJob, result: RecoveryResult, live: VisualOdometry | None, now: FrameStamp, started_s: float
    ) -> None:
        """Merge a result into its submap, live or archived by now; solve it; pose frames and link maps by it."""
        submap = self._record.atlas.submaps[job.submap.id]
        is_same = (submap.K == job.submap.K).all()
        change = None if is_same else partial(rectified_where_possible, camera=self._calibration.camera)
        merged = merge_recovery(submap, job.submap, result.submap, change)
        if result.link is not None:
            merged.submap.gauge = gauge_at_overlap(merged.submap, result.link.estimate.agreeing_keyframes)
        unsolved, graph = merged.submap.copy(), self._new_graph()
        try:
            solve(merged.submap, graph, near_optimum=change is None)
        except SolverError as error:
            failure = Failure(FailureReason.SOLVER, str(error))
            self._failed(job, now, failure, time.perf_counter() - started_s)
            return
        before = submap.copy()
        submap.take_over(merged.submap)
        for front_end in self._front_ends():
            if front_end.submap is submap:
                front_end.adopt(graph, before)
        self._connections.follow(before, submap, now)
        recovered_frames = pose_frames(self._record, result.frames, merged, submap, change)
        seconds = time.perf_counter() - started_s
        linked = False
        if result.link is not None:
            estimate = result.link.estimate
            S_now_then = change_of_frame(unsolved, submap, estimate.agreeing_keyframes.tolist()) @ merged.S_live_grown
            linked = fuse(self._record, self._connections, job, result.link, S_now_then, recovered_frames, now, seconds)
            if linked:
                self._settle(result.link.old_id, submap.id, live)
        if job.lost:
            self._record.event(
                EventKind.RECOVERY_ENDED,
                now,
                submap.id,
                linked=linked,
                frames=len(recovered_frames),
                keyframes=len(result.submap.keyframes.keys() - job.submap.keyframes.keys()),
                recovery_s=result.seconds,
                seconds=seconds,
            )

    # --- what is lost

    def _settle(self, old_id: int, new_id: int, live: VisualOdometry | None) -> None:
        """Let no walk look any more for a submap that is linked, nor for what is one map with the live one."""
        if old_id in self._record.atlas.component_of(new_id, sure=True):
            self._lost.pop(old_id, None)
        if live is not None:
            self.settle(live)

    def _apart_from(self, submap_id: int) -> dict[int, Loss]:
        """Return the lost submaps that no link joins with a submap."""
        own = self._record.atlas.component_of(submap_id)
        return {m: loss for m, loss in self._lost.items() if m not in own}

    def _joined_loosely(self, submap_id: int) -> list[int]:
        """Return the lost submaps whose link with a submap is too loose to be relied on."""
        linked = {link.a for link in self._record.atlas.believed if link.b == submap_id}
        return sorted(linked & self._lost.keys())
