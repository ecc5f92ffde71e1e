"""Questions about the camera, asked in the background, and their answers' effect on a map that has grown meanwhile.

The snapshot that was asked comes back changed to another camera: other pixels, poses and points. All keyframes of the
live submap take the new camera, and those of the snapshot their new poses, too. Later ones follow
them. Then the graph is rebuilt. Inline nothing has come since, and the live submap becomes the changed snapshot.
"""

from __future__ import annotations

import logging
from functools import partial

import numpy as np

from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp
from dualslam.core.errors import InputError, SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.jobs import Desk, JobKind
from dualslam.core.types import Failure, FailureReason
from dualslam.map.lens import CalibrationAnswer, CalibrationJob, change_camera, rectified_where_possible
from dualslam.map.submap import Submap
from dualslam.map.submap_change import apply_late, change_of_frame
from dualslam.recovery.manager import Recoveries
from dualslam.system.state import State

log = logging.getLogger(__name__)

SAME_GAUGE = 1e-6
"""Relative. A snapshot whose gauge the submap still has needs no change of frame; a solution moves it by rounding."""


class Calibrations:
    """Asks live submaps about their camera, and takes the answers in between two frames.

    `recoveries`: knows the lost submaps, which are to be linked with the live one and must have the same camera.
    """

    def __init__(self, state: State, recoveries: Recoveries, connections: Connections) -> None:
        self._desk: Desk = state.parts.desk
        self._record, self._buffer = state.record, state.buffer
        self._calibration, self._new_graph = state.parts.calibration, state.parts.new_graph
        self._recoveries, self._connections = recoveries, connections
        self._ask_together, self._find_zoom = state.parts.calibrate_together, state.parts.find_focal_change

    def ask_if_due(self, live: VisualOdometry, now: FrameStamp) -> None:
        """Ask the live submap about its camera where it is time to."""
        if self._calibration.is_due(live.submap, self._is_waited_for(live)):
            self._ask(live, now)

    def ask_at_loss(self, live: VisualOdometry, now: FrameStamp) -> None:
        """Ask the live submap as its track is lost, so that the next map has its camera from the first frame on."""
        if self._calibration.is_due_at_loss(live.submap):
            self._ask(live, now)

    def finish(self, live: VisualOdometry, now: FrameStamp, ask: bool) -> None:
        """Take in what is open at the end of the run; `ask`: a live submap that has said nothing yet is asked.

        A wrong camera bends a short map as it does a long one. Where a lost map waits to be joined to it, both take the
        camera that is found. Otherwise the map stays as it is: one that a wrong camera has broken is not mended by a
        better one.
        """
        self.collect(live, now, wait=True)
        is_waited_for = self._is_waited_for(live)
        if not ask or not self._calibration.is_due_at_end(live.submap, is_waited_for):
            return
        if is_waited_for:
            self._ask(live, now)
            self.collect(live, now, wait=True)
            return
        with self._record.timer.measure("calibration"):
            found = self._calibration.estimate(live.submap)
            self._calibration.note_change(found)
        if found.numbers:
            kept, reason = EventKind.CALIBRATION_KEPT, "asked at the end of the run"
            self._record.event(kept, now, live.submap.id, reason=reason, **found.numbers)

    def settle(self, submaps: list[Submap], now: FrameStamp) -> None:
        """Let all maps of the run, as they are at its end, say which camera they share, and change to it.

        Where they have not refuted the calibration that was given, it is more exact than what they would say.
        """
        calibration = self._calibration
        if not calibration.is_refuted or not submaps:
            return
        with self._record.timer.measure("calibration"):
            try:
                found = self._ask_together(submaps, calibration.camera, calibration.covariance)
            except (InputError, SolverError) as error:
                log.warning("maps keep the camera that one of them has found: %s", error)
                return
            if isinstance(found, Failure) or not calibration.take_together(found[0]):
                return
            estimate, changed = found
            rectified = partial(rectified_where_possible, camera=calibration.camera)
            for submap, after in zip(submaps, changed, strict=True):
                self._change(submap, after, now)
                self._record.change_pixels(submap.id, lambda _: rectified)
        self._record.event(EventKind.CALIBRATED, now, lost=[], **estimate.numbers)

    def look_for_zoom(self, submaps: list[Submap]) -> None:
        """Note where the focal length changes during the run, if it does; the maps stay as they are."""
        with self._record.timer.measure("calibration"):
            found = self._find_zoom(submaps, self._calibration.camera)
        if found is not None:
            self._record.event(EventKind.FOCAL_CHANGED, self._record.rows[found.keyframe_id], **found.numbers)

    def _is_waited_for(self, live: VisualOdometry) -> bool:
        """Whether a lost map is to be joined to the live one."""
        return any(m != live.submap.id for m in self._recoveries.waiting)

    def _ask(self, live: VisualOdometry, now: FrameStamp) -> None:
        if self._desk.n_open(JobKind.CALIBRATION, live.submap.id):
            return
        submaps = self._record.atlas.submaps
        with self._record.timer.measure("calibration"):
            job = self._calibration.ask(live.submap, {m: submaps[m] for m in self._recoveries.waiting})
            self._desk.submit(JobKind.CALIBRATION, job, of=live.submap.id)
        self.collect(live, now)

    def collect(self, live: VisualOdometry, now: FrameStamp, wait: bool = False) -> bool:
        """Take in the answers; `live` continues in its submap as it is after that. Those of a lost map are withdrawn.

        Returns whether the frames to come have another camera. `wait`: for a limited time, for what is open.
        """
        before, desk = self._calibration.camera, self._desk
        for ended in desk.drain(JobKind.CALIBRATION) if wait else desk.poll(JobKind.CALIBRATION):
            with self._record.timer.measure("calibration"):
                self._take(ended.work, ended.result, live, now)
        return self._calibration.camera is not before

    def _take(
        self, job: CalibrationJob, result: CalibrationAnswer | Failure, live: VisualOdometry, now: FrameStamp
    ) -> None:
        """Let submap, graph, buffer and lost submaps change to the camera that was found, all of them or none."""
        failure = result if isinstance(result, Failure) else self._take_answer(job, result, live, now)
        if isinstance(failure, Failure):
            self._calibration.note(job, failure)
            kept = EventKind.CALIBRATION_KEPT
            self._record.event(kept, now, job.submap.id, reason=failure.detail, **failure.numbers)
            return
        assert isinstance(result, CalibrationAnswer)
        self._record.event(EventKind.CALIBRATED, now, job.submap.id, lost=failure, **result.numbers)

    def _take_answer(
        self, job: CalibrationJob, answer: CalibrationAnswer, live: VisualOdometry, now: FrameStamp
    ) -> list[int] | Failure:
        """Return the lost submaps that have changed, too."""
        submap, graph = live.submap, self._new_graph()
        if job.submap.id != submap.id:
            # What came after was made with the camera of before, and would be left apart from all that changes.
            return Failure(FailureReason.DISABLED, "the submap that was asked is live no more", answer.numbers)
        try:
            merged = merge_calibrated(submap, job.submap, answer)
            merged.apply_estimate(*graph.rebuild(merged, near_optimum=True).values)
        except (InputError, SolverError) as error:
            return Failure(FailureReason.SOLVER, str(error), answer.numbers)
        self._calibration.take(answer)
        before = submap.copy()
        submap.take_over(merged)
        live.adopt(graph, before)
        self._buffer.map_later(self._calibration.rectified, "camera")
        self._connections.follow(before, submap, now)
        changed = [m for m in self._recoveries.waiting if self._change_lost(m, job, answer, now)]
        rectified = partial(rectified_where_possible, camera=answer.camera)
        for m in (submap.id, *changed):
            self._record.change_pixels(m, lambda _: rectified)
        return changed

    def _change_lost(self, submap_id: int, job: CalibrationJob, answer: CalibrationAnswer, now: FrameStamp) -> bool:
        """Change a lost submap with the live one, if it could be."""
        if submap_id not in answer.lost:
            return False
        submap = self._record.atlas.submaps[submap_id]
        of_lost = CalibrationAnswer(answer.camera, answer.covariance, answer.lost[submap_id], {}, answer.numbers)
        try:
            merged = merge_calibrated(submap, job.lost[submap_id], of_lost)
        except InputError as error:
            log.warning("submap %d keeps its camera: %s", submap_id, error)
            return False
        self._change(submap, merged, now)
        return True

    def _change(self, submap: Submap, changed: Submap, now: FrameStamp) -> None:
        """Let a submap become what a copy of it was changed to, and all that hangs on it follow."""
        before = submap.copy()
        submap.take_over(changed)
        self._connections.follow(before, submap, now)


def merge_calibrated(live: Submap, base: Submap, answer: CalibrationAnswer) -> Submap:
    """Return a copy of a submap changed to another camera as its snapshot was; what has come since follows.

    - `live`: in its current state: grown, solved again, merged with what a walk found.
    - `base`: the snapshot.
    - `answer`: its `submap` is the snapshot, changed.

    Raises `InputError` if features have no place in the corrected image.
    """
    changed, merged = answer.submap, live.copy()
    if not _same_gauge(live, base):
        changed = changed.copy()
        S = change_of_frame(base, live, base.keyframes, len(base.landmarks))
        T = se3.from_parts(sim3.rotation(S), sim3.translation(S))
        changed.transform(float(sim3.scale(S)), T)
    change_camera(merged, answer.camera, changed.keyframes, base.keyframes)
    shared = np.array([k for k in changed.keyframes if k in merged.keyframes], np.int64)
    n = len(base.landmarks)
    alive = np.flatnonzero(merged.landmarks["alive"][:n] & changed.landmarks["alive"])
    if len(shared):
        apply_late(merged, shared, changed.keyframe_poses(shared), alive, changed.landmarks["xyz_mu"][alive])
    return merged


def _same_gauge(live: Submap, base: Submap) -> bool:
    first, second = base.gauge
    if live.gauge != base.gauge or not {first, second} <= live.keyframes.keys():
        return False
    baselines = [se3.translation(m.T_submap_kf[second] - m.T_submap_kf[first]) for m in (live, base)]
    lengths = [float(np.linalg.norm(each)) for each in baselines]
    stays = np.allclose(live.T_submap_kf[first], base.T_submap_kf[first], rtol=0, atol=SAME_GAUGE)
    return bool(stays) and abs(lengths[0] - lengths[1]) <= SAME_GAUGE * lengths[1]
