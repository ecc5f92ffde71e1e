"""Algorithm 1: reverse tracking from a new submap until it overlaps a lost one so well that a Sim(3) links the two.

The walk is a visual front end, given the buffered frames latest first. It sees images and features only, never the
old map's poses or landmarks: a link must not confirm itself. What it takes from the old map is which frames were
keyframes, so that both maps hold the same ones. Several attempts, each with poses from another front end, start from
the same snapshot until one leads to a link. An attempt's errors do not reach the next.

It is a job on a snapshot that nobody else changes: it can run in a process of its own, and be merged when it is ready.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from dualslam.atlas.trajectory import FramePose, Path
from dualslam.core.config.settings import Config, HealthConfig
from dualslam.core.decisions import Gate
from dualslam.core.errors import SolverError
from dualslam.core.estimates import KeyframeReport, PreferredCamera
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import sim3
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.jobs import Limit, result_of
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, IntArray, Rival, Track, View
from dualslam.core.walk_news import WalkNews, WalkTrace
from dualslam.linking import (
    DescriptorMatcher,
    LinkEstimate,
    LinkRefusal,
    check_camera,
    estimate_link,
    propagate_to_live_end,
)
from dualslam.linking.link_tries import LinkTries
from dualslam.linking.motion import WINDOW_FRAMES
from dualslam.linking.rivals import choose_by_velocity
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.submap import Submap
from dualslam.recovery.job import FoundLink, RecoveredFrame, RecoveryJob, RecoveryResult, refusal_data
from dualslam.recovery.progress import Progress
from dualslam.recovery.relinker import LinkTry, Relinker
from dualslam.recovery.schedule import way_to_gaps

log = logging.getLogger(__name__)

RELINK = "again"
"""Instead of an attempt's name: the link is measured again, without reverse tracking."""

Outcome = TypeVar("Outcome")
Steps = Generator[WalkNews | None, bool | None, Outcome]
"""Yields at each step how far the walk has come, and is sent whether its time is over."""


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One way to track in reverse, by the name of the front end that its poses come from.

    `find_lack`: returns why the attempt cannot be made in this installation. It is asked before each attempt.
    """

    name: str
    new_odometry: Callable[[RecoveryJob, Submap, SubmapGraph], VisualOdometry]
    find_lack: Callable[[], Failure | None] = lambda: None


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryParts:
    """The parts of a recovery, built by the composition root of the process in which it runs.

    `posing`: the way back where there is no lost map, but frames without a pose.
    `find_camera`: asks keyframes of a map that a walk has grown about the camera.
    `foresee`: precomputes the features that crossing a gap may need in a frame.
    """

    attempts: tuple[Attempt, ...]
    posing: Attempt
    new_graph: Callable[[], SubmapGraph]
    matcher: DescriptorMatcher
    find_camera: Callable[[RecoveryJob, Submap, IntArray], PreferredCamera | None]
    config: Config
    foresee: Callable[[View], None] = lambda view: None

    def link(self, old: Submap, new: Submap, onset: int | None) -> LinkEstimate | Failure:
        """Try to link a submap with an older one, which is suspected to be corrupted from a frame on."""
        rng = np.random.default_rng(self.config.seed)
        return estimate_link(old, new, self.config.linking, rng, onset, self.matcher)

    @property
    def max_scale_sigma(self) -> float:
        """Largest standard deviation of a link's scale at the live end."""
        return self.config.linking.max_live_scale_sigma


def run_recovery(
    job: RecoveryJob, parts: RecoveryParts, tell: Callable[[WalkNews], None] | None = None, limit: Limit | None = None
) -> RecoveryResult | Failure:
    """Track in reverse from the job's submap until a link to a lost one passes its gates, or no frames are left.

    The job is left as it was. Where there is no map to link with, the live features pose the frames before the start.
    `tell` is called now and then with how far it has come; `limit`: after which it returns what it has.
    """
    return result_of(recover_in_steps(job, parts), tell, limit)


def recover_in_steps(job: RecoveryJob, parts: RecoveryParts) -> Steps[RecoveryResult | Failure]:
    """Do what `run_recovery` does, in steps: yields how far it has come, and is sent whether its time is over."""
    started, cpu_started = time.perf_counter(), time.process_time()
    best: Progress | None = None
    unsure: Progress | None = None
    problem = Failure(FailureReason.SOLVER)
    events: list[Event] = []
    looks_alike, needs_camera, tries = False, False, job.tries.copy()
    attempts = parts.attempts if job.lost else (parts.posing,) if job.views or not job.joined else ()
    for attempt in attempts:
        if best is not None and best.out_of_time:
            break
        if (lack := attempt.find_lack()) is not None:
            problem = lack
            events.append(_unavailable(job, attempt, lack))
            continue
        progress = yield from _make_told_apart(job, parts, attempt, tries)
        if isinstance(progress, Failure):
            problem = progress
            continue
        events += progress.events
        looks_alike = looks_alike or progress.looks_alike
        needs_camera = progress.needs_camera or progress.needs_old_map
        if progress.unsure is not None and progress.unsure.is_surer_than(None if unsure is None else unsure.unsure):
            unsure = progress
        if best is None or progress.link is not None:
            best, way = progress, attempt
        if progress.link is not None or needs_camera or progress.looks_alike:
            break
    if best is None and not job.joined:
        return problem
    if best is None:
        best = Progress(job.submap)
    if best.link is None and unsure is not None:
        best, best.link = unsure, unsure.unsure
    if (gap := best.lost_scale_from(parts.max_scale_sigma)) is not None:
        best = yield from _as_far_as(gap, job, parts, way)
    seconds, cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    frames = tuple(best.frames.values())
    ending = looks_alike, needs_camera, tries, _relink(job, best.submap, parts, tries)
    return RecoveryResult(best.submap, frames, best.link, tuple(events), seconds, cpu_s, *ending)


def _relink(job: RecoveryJob, submap: Submap, parts: RecoveryParts, tries: LinkTries) -> tuple[FoundLink, ...]:
    """Measure again the links with the maps that are joined too loosely, by the keyframes that both hold."""
    since_start, progress = replace(job, newest_id=job.live_since), Progress(submap)
    relinked = []
    for old_id, old in job.joined.items():
        found = _confirm_with_doubt(old_id, old, since_start, submap, RELINK, parts, tries, progress)
        if not isinstance(found, Failure):
            relinked.append(found)
    return tuple(relinked)


def _unavailable(job: RecoveryJob, attempt: Attempt, lack: Failure) -> Event:
    stamp = job.submap.keyframes[job.newest_id].timestamp_s
    data = {"attempt": attempt.name, "verdict": lack.detail}
    return Event(EventKind.ATTEMPT_UNAVAILABLE, job.newest_id, stamp, job.submap.id, data)


def _as_far_as(gap: int, job: RecoveryJob, parts: RecoveryParts, attempt: Attempt) -> Steps[Progress]:
    """Walk again, no farther than to the frame before a gap.

    Later walks go by the keyframes that an earlier one has left. From beyond a gap they would be tied to the crossing
    of a young map. The grown one can cross more firmly.
    """
    near = replace(job, views=tuple(view for view in job.views if view.index >= gap))
    kept = yield from _make_attempt(near, parts, attempt, job.tries.copy())
    return Progress(job.submap) if isinstance(kept, Failure) else kept


def _make_told_apart(
    job: RecoveryJob, parts: RecoveryParts, attempt: Attempt, tries: LinkTries
) -> Steps[Progress | Failure]:
    """Make one attempt. If a pose beyond a gap is ambiguous, repeat it under the one that the velocities choose. If
    they choose none, repeat it only as far as the gap.
    """
    progress = yield from _make_attempt(job, parts, attempt, walked := tries.copy())
    events: list[Event] = []
    has_rivals = not isinstance(progress, Failure) and bool(progress.rivals)
    if not isinstance(progress, Failure) and (better := _find_better(job, progress)):
        events += progress.events
        expected = {rival.index: rival.T_cam_rival for rival in better}
        by_better = replace(job, expected=expected)
        progress = yield from _make_attempt(by_better, parts, attempt, walked := tries.copy())
    if not isinstance(progress, Failure) and progress.link is None and progress.unsure is None and has_rivals:
        events += progress.events
        as_far = replace(job, notes_rivals=False)
        progress = yield from _make_attempt(as_far, parts, attempt, walked := tries.copy())
    tries.restore(walked)
    if not isinstance(progress, Failure):
        progress.events[:0] = events
    return progress


def _make_attempt(
    job: RecoveryJob, parts: RecoveryParts, attempt: Attempt, tries: LinkTries
) -> Steps[Progress | Failure]:
    """Make one attempt, from a copy of the job's submap."""
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
    progress = Progress(submap)
    # Frames before a start are worth a look each, however many show nothing; no map waits for the end of that walk.
    max_gap_frames = parts.config.recovery.max_gap_frames if job.lost else len(job.views)
    views = job.views if job.lost else _there_and_back(job.views, progress)
    unsure_of: int | None = None  # the lost map with which a link would be, but for a loose scale
    trace = WalkTrace(submap.id, attempt.name, job.newest_id, submap.T_submap_kf[job.newest_id][:3, 3])
    for step in track_in_reverse(reverse_tracker, views, parts.config.health, relinker.keyframe_ids, max_gap_frames):
        trace.note(step.view, step.track)
        progress.out_of_time = bool((yield trace.news()))
        if progress.out_of_time:
            break
        progress.rivals = reverse_tracker.rivals
        if isinstance(step.track, Failure):
            progress.note_unusable(step.track)
            continue
        if step.track.wide and progress.before_gap is None:
            progress.before_gap = min(progress.frames, default=job.newest_id)
        progress.note_posed(_recovered_frame(reverse_tracker, step.view, step.track), step.report is not None)
        if (earlier := reverse_tracker.confirmed()) is not None:
            progress.note_confirmed(_recovered_frame(reverse_tracker, earlier.view, earlier))
            trace.note_confirmed(earlier)
        if step.view.index not in submap.keyframes:
            continue
        for tried in relinker.attempts(step.view.index):
            found = _confirm(tried.old_id, tried.result, job, submap, attempt.name, parts, tries, progress)
            if not isinstance(found, Failure):
                progress.link = found
                break
            unsure_of = tried.old_id if _accepted(found, True) is not found else unsure_of
            tries.note_try(tried.old_id, found.reason)
            progress.why_not_linked = found.detail
            progress.walk_sigma = found.walk_sigma if isinstance(found, LinkRefusal) else 0.0
            progress.needs_camera |= found.reason is FailureReason.CAMERA
            # A lost map of few keyframes hardly knows its scale: another way over the same ones knows it no better.
            at_overlap = isinstance(tried.result, Failure) and tried.result.reason is FailureReason.SCALE
            progress.needs_old_map |= at_overlap and relinker.holds_all
            progress.given_up |= progress.needs_camera or found.reason is FailureReason.SCALE_LOST
            # As long as the walk is not far enough beyond the gap nothing is measured, and more may tell.
            is_of_motion = found.reason in (FailureReason.LEAP, FailureReason.LOOK_ALIKE)
            progress.given_up |= is_of_motion and progress.choice is not None and progress.choice.is_measured
            progress.events.append(_refusal(tried, found, attempt.name, step.view, submap.id))
        progress.given_up |= relinker.has_seen_enough
        if progress.link is not None or progress.given_up:
            break
    progress.needs_old_map |= bool(job.lost) and relinker.is_hopeless
    if progress.link is None and unsure_of is not None:
        # The map has grown since that try.
        old = job.lost[unsure_of]
        found = _confirm_with_doubt(unsure_of, old, job, submap, attempt.name, parts, tries, progress)
        progress.unsure = None if isinstance(found, Failure) else found
    if job.lost:
        event = _event_of(job, progress, attempt.name, time.perf_counter() - started)
        gap = Gate("frames in a row without a pose", progress.n_unusable, "<=", max_gap_frames)
        progress.events.append(replace(event, gates=(gap,)))
    return progress


def _there_and_back(views: tuple[View, ...], progress: Progress) -> Iterator[View]:
    """Yield the views, and then, the other way round, those that the walk has found no pose for.

    A camera that turns away slowly and comes back at once is lost in reverse, and followed forwards.
    """
    yield from views
    yield from way_to_gaps(views[::-1], progress.frames, progress.submap.keyframes)


def _confirm_with_doubt(
    old_id: int,
    old: Submap,
    job: RecoveryJob,
    submap: Submap,
    attempt: str,
    parts: RecoveryParts,
    tries: LinkTries,
    progress: Progress,
) -> FoundLink | Failure:
    """Return the link with a map, measured again over the whole overlap; it may be one that is not to be relied on."""
    result = parts.link(old, submap, job.onsets[old_id])
    found = _confirm(old_id, result, job, submap, attempt, parts, tries, progress)
    if not isinstance(found, Failure):
        return found
    tries.note_try(old_id, found.reason)
    return _confirm(old_id, result, job, submap, attempt, parts, tries, progress, with_doubt=True)


def _confirm(
    old_id: int,
    result: LinkEstimate | Failure,
    job: RecoveryJob,
    submap: Submap,
    attempt: str,
    parts: RecoveryParts,
    tries: LinkTries,
    progress: Progress,
    with_doubt: bool = False,
) -> FoundLink | Failure:
    """Return a link that holds as far as the live end, under the camera that the pixels ask for.

    `with_doubt`: its scale may be too loose to be relied on.
    """
    found = _accepted(result, with_doubt)
    if isinstance(found, Failure):
        return found
    config = parts.config.linking
    link = _accepted(propagate_to_live_end(found, submap, job.newest_id, config), with_doubt)
    if isinstance(link, Failure):
        return link
    bend = check_camera(submap, link, job.newest_id, partial(parts.find_camera, job), config)
    if isinstance(bend, Failure):
        return bend
    if bend.doubt is not None and not with_doubt:
        return LinkRefusal(bend.doubt.reason, bend.doubt.detail, bend.doubt.numbers, unsure=link)
    link = _accepted(propagate_to_live_end(found, submap, job.newest_id, config, bend), with_doubt)
    if isinstance(link, Failure):
        return link
    again = None if with_doubt else tries.judge(old_id, link.sigma_scale, parts.max_scale_sigma)
    if again is not None:
        return again
    refused = _refuse_rivalled(job, submap, progress, old_id, link)
    if refused is not None:
        return refused
    told = {"tries": tries.refused[old_id] + 1.0, "rivals": float(len(progress.rivals))}
    return FoundLink(old_id, replace(link, numbers=link.numbers | told), attempt, is_sure=not with_doubt)


def _accepted(result: LinkEstimate | Failure, with_doubt: bool) -> LinkEstimate | Failure:
    """Return the link of a result; `with_doubt`: also one that is refused for a loose scale alone."""
    unsure = result.unsure if with_doubt and isinstance(result, LinkRefusal) else None
    return result if unsure is None else unsure


def _refuse_rivalled(
    job: RecoveryJob, submap: Submap, progress: Progress, old_id: int, link: LinkEstimate
) -> Failure | None:
    """Return why a link over a gap is not to be believed beyond which several poses are alike."""
    if not progress.rivals:
        return None
    sound = np.inf if link.suspected_onset is None else link.suspected_onset
    known = job.paths[old_id].moved(sim3.inverse(link.S_old_new))
    choice = choose_by_velocity(_walked(job, submap, progress), known.take(known.index < sound), progress.rivals)
    progress.choice = choice
    return choice.refusal


def _find_better(job: RecoveryJob, progress: Progress) -> tuple[Rival, ...]:
    """Return what a walk that came to no link should have gone by beyond a gap, if the velocities tell.

    Under a wrong pose it need not come to where a link is judged: a copy is not quite like the other. Then the ways in
    the two maps say how these lie.
    """
    if progress.link is not None or not progress.rivals:
        return ()
    if progress.choice is not None and progress.choice.is_measured:
        return progress.choice.better
    walked = _walked(job, progress.submap, progress)
    for old_id in sorted(job.paths, reverse=True):
        known = job.paths[old_id].take(job.paths[old_id].index < job.onsets[old_id])
        S_new_old = known.similarity_to(walked, WINDOW_FRAMES)
        if S_new_old is not None:
            return choose_by_velocity(walked, known.moved(S_new_old), progress.rivals).better
    return ()


def _walked(job: RecoveryJob, submap: Submap, progress: Progress) -> Path:
    """Return the path of the walk, and of the frames that it set out from."""
    own = [pose for pose in job.poses if pose.index not in progress.frames and pose.keyframe_id in submap.keyframes]
    return Path.of([*own, *(frame.pose for frame in progress.frames.values())], submap)


def _recovered_frame(reverse_tracker: VisualOdometry, view: View, track: Track) -> RecoveredFrame:
    T_kf_cam = reverse_tracker.relative_pose(track)
    pose = FramePose(view.index, view.timestamp_s, reverse_tracker.submap.id, reverse_tracker.reference_id, T_kf_cam)
    seen = FrameObservations.of(track.view.features, track.landmark_ids, pose.submap_id)
    return RecoveredFrame(pose, track.n_matches, track.n_inliers, seen, track.method)


def _refusal(tried: LinkTry, failure: Failure, attempt: str, view: View, submap_id: int) -> Event:
    data = refusal_data(attempt, tried.old_id, failure, shared_keyframes=tried.n_shared)
    return Event(EventKind.LINK_REFUSED, view.index, view.timestamp_s, submap_id, data, failure.gates)


def _event_of(job: RecoveryJob, progress: Progress, attempt: str, seconds: float) -> Event:
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
    reverse_tracker: VisualOdometry,
    views: Iterable[View],
    health: HealthConfig,
    keyframe_ids: set[int],
    max_gap_frames: int,
) -> Iterator[ReverseStep]:
    """Pose frames one after the other in the order given, and extend the walker's submap by keyframes.

    Parameters
    ----------
    reverse_tracker : VisualOdometry
        Started at a keyframe of its submap.
    views : iterable of View
        Latest first.
    health : HealthConfig
        By which a track is taken for sound.
    keyframe_ids : set of int
        Frames that become keyframes in any case: those that were keyframes of an older submap.
    max_gap_frames : int
        So many frames in a row may be unusable before the walk ends.
    """
    n_failed = 0
    for view in views:
        try:
            track = judge_track(reverse_tracker.track(view), health)
            step = _track_one(reverse_tracker, view, track, view.index in keyframe_ids)
        except SolverError as error:
            log.warning("reverse tracking ends: %s", error)
            yield ReverseStep(view, Failure(FailureReason.SOLVER, str(error)), None)
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
