"""Algorithm 1: reverse tracking from a new submap until it overlaps a lost one so well that a Sim(3) links the two.

The walk is a visual front end, given the buffered frames latest first. It sees images and features only, never the
old map's poses or landmarks: a link must not confirm itself. What it takes from the old map is which frames were
keyframes, so that both maps hold the same ones. Several attempts, each with poses from another front end, start from
the same snapshot one after the other until one leads to a link; what one of them got wrong does not reach the next.

It is a job on a snapshot that nobody else changes: it can run in a process of its own, and be merged when it is ready.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dualslam.config.settings import FusionConfig, RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import KeyframeReport
from dualslam.core.events import Event, EventKind
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import Failure, FailureReason, Track, View
from dualslam.map.submap import Submap
from dualslam.map.trajectory import FramePose
from dualslam.recovery.job import FoundLink, RecoveredFrame, RecoveryJob, RecoveryResult
from dualslam.recovery.link_tries import LinkTries
from dualslam.recovery.linking import NO_BEND, Bend, LinkEstimate
from dualslam.recovery.overlap_refinement import OverlapReport, refine_overlap
from dualslam.recovery.relinker import Linker, LinkTry, Relinker
from dualslam.recovery.schedule import way_to_gaps
from dualslam.recovery.walk_news import WalkNews, WalkTrace
from dualslam.workers.jobs import result_of

log = logging.getLogger(__name__)

Judge = Callable[[Track | Failure], Track | Failure]


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One way to track in reverse, by the name of the front end that its poses come from.

    `thorough`: the same way without short cuts, made where those that it took lead to no link.
    """

    name: str
    new_odometry: Callable[[RecoveryJob, Submap, SubmapGraph], VisualOdometry]
    thorough: Attempt | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryParts:
    """The parts of a recovery, built by the composition root of the process in which it runs.

    `posing`: the way back where there is no lost map, but frames without a pose.
    `max_scale_sigma`: of a link, at the live end.
    `budget_s`: wall time after which it comes to an end with what it has, where it does not run inline.
    """

    attempts: tuple[Attempt, ...]
    posing: Attempt
    new_graph: Callable[[], SubmapGraph]
    link: Linker
    max_scale_sigma: float
    propagate: Callable[[LinkEstimate, Submap, int, Bend], LinkEstimate | Failure]
    check_camera: Callable[[Submap, LinkEstimate, RecoveryJob], Bend | Failure]
    judge: Judge
    config: RecoveryConfig
    fusion: FusionConfig
    budget_s: float | None = None


def run_recovery(
    job: RecoveryJob, parts: RecoveryParts, tell: Callable[[WalkNews], None] | None = None
) -> RecoveryResult | Failure:
    """Track in reverse from the job's submap until a link to a lost one passes its gates, or no frames are left.

    The job is left as it was. Where there is no map to link with, the live features pose the frames before the start.
    `tell` is called now and then with how far it has come.
    """
    return result_of(recover_in_steps(job, parts), tell)


def recover_in_steps(job: RecoveryJob, parts: RecoveryParts) -> Generator[WalkNews, None, RecoveryResult | Failure]:
    """Do what `run_recovery` does; yields how far it has come, and nothing depends on who takes notice."""
    started, cpu_started = time.perf_counter(), time.process_time()
    best: _Progress | None = None
    problem = Failure(FailureReason.SOLVER)
    events: list[Event] = []
    looks_alike, tries = False, job.tries.copy()
    until = np.inf if parts.budget_s is None else started + parts.budget_s
    ways = list(parts.attempts if job.lost else (parts.posing,))
    thorough: Attempt | None = None
    while ways:
        attempt = ways.pop(0)
        if best is not None and time.perf_counter() > until:
            break
        progress = yield from _make_attempt(job, parts, attempt, until, tries)
        if isinstance(progress, Failure):
            problem = progress
            continue
        events += progress.events
        looks_alike |= progress.looks_alike
        came_as_far = best is not None and len(progress.frames) >= len(best.frames)
        if best is None or progress.link is not None or (attempt is thorough and came_as_far):
            best = progress
        if progress.link is not None or progress.needs_camera or progress.needs_live_end or progress.looks_alike:
            break
        if progress.took_short_cut and attempt.thorough is not None:
            thorough = attempt.thorough
            ways.insert(0, thorough)
    if best is None:
        return problem
    seconds, cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    frames = tuple(best.frames.values())
    return RecoveryResult(best.submap, frames, best.link, tuple(events), seconds, cpu_s, looks_alike, tries)


@dataclass(slots=True, eq=False)
class _Progress:
    """The state of one attempt."""

    submap: Submap
    frames: dict[int, RecoveredFrame] = field(default_factory=dict)  # in the order in which they were posed first
    events: list[Event] = field(default_factory=list)
    link: FoundLink | None = None
    n_keyframes: int = 0
    n_gaps: int = 0
    n_skipped: int = 0  # frames without a pose between some that have one
    n_unusable: int = 0  # the last frames
    took_short_cut: bool = False
    out_of_time: bool = False
    given_up: bool = False
    needs_camera: bool = False  # no other walk would do better, before the camera is calibrated
    needs_live_end: bool = False  # nor before the live end has grown, from which all of them set out
    looks_alike: bool = False  # beyond a gap: what one front end cannot tell apart another may not even notice
    why_unusable: str = ""
    why_not_linked: str = ""

    @property
    def verdict(self) -> str:
        if self.link is not None:
            return "linked"
        ended = "out of time" if self.out_of_time else self.why_unusable if self.n_unusable else "the buffer ends"
        ended = "given up" if self.given_up else ended
        return f"{ended}; no link: {self.why_not_linked}" if self.why_not_linked else ended

    def note_unusable(self, failure: Failure) -> None:
        self.n_unusable += 1
        self.looks_alike |= failure.reason is FailureReason.LOOK_ALIKE
        self.why_unusable = failure.detail or str(failure.reason)

    def note_posed(self, frame: RecoveredFrame, new_keyframe: bool) -> None:
        self.frames.setdefault(frame.pose.index, frame)
        self.n_keyframes += new_keyframe
        self.n_gaps += self.n_unusable > 0
        self.n_skipped += self.n_unusable
        self.n_unusable = 0

    def note_confirmed(self, frame: RecoveredFrame) -> None:
        self.frames.setdefault(frame.pose.index, frame)
        self.n_skipped -= 1


def _make_attempt(
    job: RecoveryJob, parts: RecoveryParts, attempt: Attempt, until: float, tries: LinkTries
) -> Generator[WalkNews, None, _Progress | Failure]:
    """Make one attempt, from a copy of the job's submap; it stops at the time `until`."""
    started = time.perf_counter()
    submap, graph = job.submap.copy(), parts.new_graph()
    try:
        estimate = graph.update(submap)
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))
    submap.apply_estimate(*estimate.values)
    reverse_tracker = attempt.new_odometry(job, submap, graph)
    reverse_tracker.start_at(job.newest_id)
    relinker = Relinker(submap, job.lost, job.onsets, parts.link)
    reverse_tracker.keep(relinker.keyframe_ids)  # redundant or not: linking stands on keyframes that both maps hold
    progress = _Progress(submap)
    # Frames before a start are worth a look each, however many show nothing; no map waits for the end of that walk.
    max_gap_frames = parts.config.max_gap_frames if job.lost else len(job.views)
    views = job.views if job.lost else _there_and_back(job.views, progress)
    trace = WalkTrace(submap.id, attempt.name, job.newest_id, submap.T_submap_kf[job.newest_id][:3, 3])
    for step in track_in_reverse(reverse_tracker, views, parts.judge, relinker.keyframe_ids, max_gap_frames):
        progress.out_of_time = time.perf_counter() > until
        if progress.out_of_time:
            break
        trace.note(step.view, step.track)
        if (news := trace.news()) is not None:
            yield news
        if isinstance(step.track, Failure):
            progress.note_unusable(step.track)
            continue
        progress.took_short_cut = reverse_tracker.took_short_cut
        progress.note_posed(_recovered_frame(reverse_tracker, step.view, step.track), step.report is not None)
        if (earlier := reverse_tracker.confirmed()) is not None:
            progress.note_confirmed(_recovered_frame(reverse_tracker, earlier.view, earlier))
            trace.note_confirmed(earlier)
        if step.view.index not in submap.keyframes:
            continue
        for tried in relinker.attempts(step.view.index):
            found = _fused(tried, job, submap, attempt.name, parts, tries)
            if not isinstance(found, Failure):
                progress.link = found
                break
            tries.note_try(tried.old_id, found.reason)
            progress.why_not_linked = found.detail
            progress.needs_camera |= found.reason is FailureReason.CAMERA
            # What was lost across a gap the others lose as well: they cross it by the same matches, or by fewer. Only
            # where a short cut was taken there are more.
            was_lost = found.reason is FailureReason.SCALE_LOST and progress.n_gaps > 0
            progress.needs_live_end |= was_lost and not progress.took_short_cut
            progress.given_up |= progress.needs_camera or found.reason is FailureReason.SCALE_LOST
            progress.events.append(_refusal(tried, found, attempt.name, step.view, submap.id))
        progress.given_up |= relinker.has_seen_enough
        if progress.link is not None or progress.given_up:
            break
    if job.lost:
        progress.events.append(_event_of(job, progress, attempt.name, time.perf_counter() - started))
    return progress


def _there_and_back(views: tuple[View, ...], progress: _Progress) -> Iterator[View]:
    """Yield the views, and then, the other way round, those that the walk has found no pose for.

    A camera that turns away slowly and comes back at once is lost in reverse, and followed forwards.
    """
    yield from views
    yield from way_to_gaps(views[::-1], progress.frames, progress.submap.keyframes)


def _fused(
    tried: LinkTry, job: RecoveryJob, submap: Submap, attempt: str, parts: RecoveryParts, tries: LinkTries
) -> FoundLink | Failure:
    """Refine the overlap and with it the link, which must hold as far as where the walk set out, and beyond."""
    found = tried.result
    if isinstance(found, Failure):
        return found
    link = parts.propagate(found, submap, job.newest_id, NO_BEND)
    if isinstance(link, Failure):
        return link
    bend = parts.check_camera(submap, link, job)
    if isinstance(bend, Failure):
        return bend
    refinement = refine_overlap(job.lost[tried.old_id], submap, found, parts.new_graph, parts.link, parts.fusion)
    if isinstance(refinement, Failure):
        unrefined = refinement.reason in (FailureReason.DISABLED, FailureReason.SOLVER)
        if not unrefined:
            return refinement
        refined: Submap = submap
        report: OverlapReport | Failure = refinement
        link = parts.propagate(found, submap, job.newest_id, bend)
    else:
        refined, report = refinement.submap, refinement.report
        link = parts.propagate(refinement.link, refined, job.newest_id, bend)
    if isinstance(link, Failure):
        return link
    again = tries.judge(tried.old_id, link.numbers["sigma_scale"], parts.max_scale_sigma)
    if again is not None:
        return again
    if refined is not submap:
        submap.take_over(refined)
    link = replace(link, numbers=link.numbers | {"tries": tries.refused[tried.old_id] + 1.0})
    return FoundLink(tried.old_id, link, report, attempt)


def _recovered_frame(reverse_tracker: VisualOdometry, view: View, track: Track) -> RecoveredFrame:
    T_kf_cam = reverse_tracker.relative_pose(track)
    pose = FramePose(view.index, view.timestamp_s, reverse_tracker.submap.id, reverse_tracker.reference_id, T_kf_cam)
    return RecoveredFrame(pose, track.n_matches, track.n_inliers)


def _refusal(tried: LinkTry, failure: Failure, attempt: str, view: View, submap_id: int) -> Event:
    data = {
        "attempt": attempt,
        "old_submap": tried.old_id,
        "shared_keyframes": tried.n_shared,
        "verdict": failure.detail,
        "reason": str(failure.reason),
        **failure.numbers,
    }
    return Event(EventKind.LINK_REFUSED, view.index, view.timestamp_s, submap_id, data)


def _event_of(job: RecoveryJob, progress: _Progress, attempt: str, seconds: float) -> Event:
    """One attempt in one line, at the frame where it ended."""
    by_index = {view.index: view for view in (*job.own, *job.views)}
    frames = list(progress.frames.values())
    last = frames[-1].pose.index if frames else job.newest_id
    data: dict[str, Any] = {
        "attempt": attempt,
        "frames": len(frames),
        "new_keyframes": progress.n_keyframes,
        "gaps": progress.n_gaps,
        "skipped_frames": progress.n_skipped,
        "unusable_at_end": progress.n_unusable,
        "matches": sum(frame.n_matches for frame in frames),
        "inliers": sum(frame.n_inliers for frame in frames),
        "verdict": progress.verdict,
        "seconds": seconds,
    }
    if progress.link is not None:
        data |= {"old_submap": progress.link.old_id, **progress.link.estimate.numbers}
    return Event(EventKind.RECOVERY_ATTEMPT, last, by_index[last].timestamp_s, job.submap.id, data)


@dataclass(frozen=True, slots=True, eq=False)
class ReverseStep:
    """One frame of reverse tracking: where it was found to be or why not, and whether it became a keyframe."""

    view: View
    track: Track | Failure
    report: KeyframeReport | None


def track_in_reverse(
    reverse_tracker: VisualOdometry, views: Iterable[View], judge: Judge, keyframe_ids: set[int], max_gap_frames: int
) -> Iterator[ReverseStep]:
    """Pose frames one after the other in the order given, and extend the walker's submap by keyframes.

    Parameters
    ----------
    reverse_tracker : VisualOdometry
        Started at a keyframe of its submap.
    views : iterable of View
        Latest first.
    judge : callable
        The health verdict on a track.
    keyframe_ids : set of int
        Frames that become keyframes in any case: those that were keyframes of an older submap.
    max_gap_frames : int
        So many frames in a row may be unusable before the walk ends.
    """
    n_failed = 0
    for view in views:
        try:
            step = _track_one(reverse_tracker, view, judge(reverse_tracker.track(view)), view.index in keyframe_ids)
        except SolverError as error:
            log.warning("reverse tracking ends: %s", error)
            return
        yield step
        n_failed = 0 if step.track else n_failed + 1
        if n_failed > max_gap_frames:
            return


def _track_one(reverse_tracker: VisualOdometry, view: View, track: Track | Failure, is_wanted: bool) -> ReverseStep:
    """Make a frame that was posed a keyframe where it is wanted or due."""
    if isinstance(track, Failure):
        return ReverseStep(view, track, None)
    reverse_tracker.submap.count_sightings(track)
    is_new = view.index not in reverse_tracker.submap.keyframes
    if not ((is_wanted and is_new) or reverse_tracker.keyframe_due(track)):
        reverse_tracker.go_by_known(track)
        return ReverseStep(view, track, None)
    report = reverse_tracker.insert_keyframe(track)
    return ReverseStep(view, report, None) if isinstance(report, Failure) else ReverseStep(view, track, report)
