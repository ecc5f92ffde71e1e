"""Algorithm 1: reverse tracking from a new submap until it overlaps a lost one so well that a Sim(3) links the two.

The walk is a visual front end, given the buffered frames latest first. It sees images and features only, never the old
map's poses or landmarks: a link must not confirm itself. It takes from the old map which frames were keyframes, so that
both maps hold the same ones. Several attempts, each with poses from another front end, start from the same snapshot
until one leads to a link.

It is a job on a snapshot that nobody else changes: it can run in a process of its own.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

from dualslam.atlas.trajectory import FramePose
from dualslam.core.config.settings import HealthConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import KeyframeReport
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import se3
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.jobs import Limit, result_of
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, Rival, Track, View
from dualslam.core.walk_news import WalkNews, WalkTrace
from dualslam.linking import LinkRefusal
from dualslam.linking.motion import WINDOW_FRAMES
from dualslam.linking.rivals import choose_by_velocity
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.submap import Submap
from dualslam.recovery.job import (
    Attempt,
    FoundLink,
    RecoveredFrame,
    RecoveryJob,
    RecoveryParts,
    RecoveryResult,
    refusal_data,
)
from dualslam.recovery.relinker import Relinker, confirm_link
from dualslam.recovery.schedule import LinkTries, way_to_gaps
from dualslam.recovery.walk import Walk

log = logging.getLogger(__name__)

RELINK = "again"
"""Instead of an attempt's name: the link is measured again, without reverse tracking."""

Outcome = TypeVar("Outcome")
Steps = Generator[WalkNews | None, bool | None, Outcome]
"""Yields at each step how far the walk has come, and is sent whether its time is over."""


def run_recovery(
    job: RecoveryJob, parts: RecoveryParts, tell: Callable[[WalkNews], None] | None = None, limit: Limit | None = None
) -> RecoveryResult:
    """Track in reverse from the job's submap until a link to a lost one passes its gates, or no frames are left.

    The job is left as it was. Where there is no map to link with, the live features pose the frames before the start.
    `tell` is called now and then with how far it has come; `limit`: after which it returns what it has.
    """
    return result_of(recover_in_steps(job, parts), tell, limit)


def recover_in_steps(job: RecoveryJob, parts: RecoveryParts) -> Steps[RecoveryResult]:
    """Do what `run_recovery` does, in steps: yields how far it has come, and is sent whether its time is over."""
    started, cpu_started = time.perf_counter(), time.process_time()
    walks, tries = list[Walk](), job.tries.copy()
    job = _with_late_frames(job, parts)
    for attempt in parts.attempts if job.lost else (parts.posing,) if job.views or not job.joined else ():
        made = [walk for walk in walks if walk.problem is None]
        if attempt.max_unrecognised is not None and made and not any(walk.leaves_open for walk in made):
            continue
        walks.append((yield from _make_attempt(job, parts, attempt, tries)))
        tries = walks[-1].tries
        if walks[-1].is_final or (job.first_alone and walks[-1].problem is None):
            break
    best = _best_of(walks)
    if best is not None and (gap := best.lost_scale_from(parts.max_scale_sigma)) is not None:
        best = yield from _walk_to(gap, best, parts)
    ending = best or Walk.from_copy(job, RELINK, tries)
    relinked = _relink(job, ending.submap, parts, tries)
    return RecoveryResult(
        submap=ending.submap,
        frames=tuple(ending.frames.values()),
        link=ending.link,
        events=tuple(event for walk in walks for event in walk.events),
        seconds=time.perf_counter() - started,
        cpu_s=time.process_time() - cpu_started,
        looks_alike=any(walk.looks_alike for walk in walks),
        needs_camera=any(walk.needs_camera for walk in walks),
        stopped_at=_stopped_at(walks),
        tries=tries,
        relinked=relinked,
        failure=None if best or job.joined else walks[-1].problem,
    )


def _with_late_frames(job: RecoveryJob, parts: RecoveryParts) -> RecoveryJob:
    """Return the job with the frames that came too late as views among the others."""
    if not job.late:
        return job
    read = (view for frame in job.late if not isinstance(view := parts.read(frame, job.camera), Failure))
    views = sorted((*job.views, *read), key=lambda view: view.index, reverse=True)
    return replace(job, views=tuple(views), late=())


def _best_of(walks: list[Walk]) -> Walk | None:
    """Return the walk with the link: a sure one, or else the surest. Without any it is the first that was made."""
    made = [walk for walk in walks if walk.problem is None]
    if not made or made[-1].link is not None:
        return made[-1] if made else None
    best = made[0]
    for walk in made[1:]:
        if walk.unsure is not None and walk.unsure.is_surer_than(best.unsure):
            best = walk
    best.link = best.unsure
    return best


def _stopped_at(walks: list[Walk]) -> int | None:
    """Return the frame at which the walks have stopped, where none of them came to try a link."""
    frames = [walk.stopped_at for walk in walks if walk.problem is None]
    return None if None in frames else min((frame for frame in frames if frame is not None), default=None)


def _relink(job: RecoveryJob, submap: Submap, parts: RecoveryParts, tries: LinkTries) -> tuple[FoundLink, ...]:
    """Measure again the links with the maps that are joined too loosely, by the keyframes that both hold."""
    since_start = Walk(replace(job, newest_id=job.live_since), RELINK, submap, tries)
    found = (_link_with_doubt(since_start, parts, old_id, old) for old_id, old in job.joined.items())
    return tuple(link for link in found if not isinstance(link, Failure))


def _link_with_doubt(walk: Walk, parts: RecoveryParts, old_id: int, old: Submap) -> FoundLink | Failure:
    """Return the link with a map, measured over the whole overlap; it may be one that is not to be relied on."""
    return confirm_link(walk, parts, old_id, parts.link(old, walk.submap, walk.job.onsets[old_id]), with_doubt=True)


def _walk_to(gap: int, walk: Walk, parts: RecoveryParts) -> Steps[Walk]:
    """Walk again, no farther than to the frame before a gap.

    By the keyframes that an earlier walk has left, the grown map can cross it more firmly.
    """
    job = walk.job
    attempt = next(attempt for attempt in (*parts.attempts, parts.posing) if attempt.name == walk.attempt)
    near = replace(job, views=tuple(view for view in job.views if view.index >= gap))
    return (yield from _walk(near, parts, attempt, job.tries))


def _make_attempt(job: RecoveryJob, parts: RecoveryParts, attempt: Attempt, tries: LinkTries) -> Steps[Walk]:
    """Make one attempt, if the installation has what it takes.

    If a pose beyond a gap is ambiguous, repeat it under the one that the velocities choose, or only as far as the gap.
    """
    if (lack := attempt.find_lack()) is not None:
        at = job.newest_id, job.submap.keyframes[job.newest_id].timestamp_s, job.submap.id
        data = {"attempt": attempt.name, "verdict": lack.detail}
        unavailable = Event(EventKind.ATTEMPT_UNAVAILABLE, *at, data)
        return Walk(job, attempt.name, job.submap, tries, lack, events=[unavailable])
    walk = yield from _walk(job, parts, attempt, tries)
    events, is_ambiguous = walk.events, bool(walk.rivals)
    if better := _find_better(walk):
        expected = {rival.index: rival.T_cam_rival for rival in better}
        walk = yield from _walk(replace(job, expected=expected), parts, attempt, tries)
        events = [*events, *walk.events]
    if is_ambiguous and walk.link is None and walk.unsure is None:
        walk = yield from _walk(replace(job, notes_rivals=False), parts, attempt, tries)
        events = [*events, *walk.events]
    walk.events = events
    return walk


def _find_better(walk: Walk) -> tuple[Rival, ...]:
    """Return what a walk that came to no link should have gone by beyond a gap, if the velocities tell."""
    if walk.link is not None or not walk.rivals:
        return ()
    if walk.choice is not None and walk.choice.is_measured:
        return walk.choice.better
    walked, paths = walk.path, walk.job.paths
    for old_id in sorted(paths, reverse=True):
        known = paths[old_id].take(paths[old_id].index < walk.job.onsets[old_id])
        S_new_old = known.similarity_to(walked, WINDOW_FRAMES)
        if S_new_old is not None:
            return choose_by_velocity(walked, known.moved(S_new_old), walk.rivals).better
    return ()


def _walk(job: RecoveryJob, parts: RecoveryParts, attempt: Attempt, tries: LinkTries) -> Steps[Walk]:
    """Track in reverse from a copy of the job's submap, and try to link what it comes to overlap."""
    started, graph = time.perf_counter(), parts.new_graph()
    walk = Walk.from_copy(job, attempt.name, tries)
    submap = walk.submap
    try:
        estimate = graph.update(submap)
    except SolverError as error:
        walk.problem = Failure(FailureReason.SOLVER, str(error))
        return walk
    submap.apply_estimate(*estimate.values)
    reverse_tracker = attempt.new_odometry(job, submap, graph)
    reverse_tracker.start_at(job.newest_id)
    relinker = Relinker(submap, job.lost, job.onsets, parts.link, parts.config.linking.min_keyframes)
    reverse_tracker.keep(relinker.keyframe_ids)  # redundant or not: a link needs keyframes that both maps hold
    # Before a first map each frame is tried, however many show nothing: no link waits for the end of that walk.
    max_gap_frames = parts.config.recovery.max_gap_frames if job.lost else len(job.views)
    views = job.views if job.lost else _there_and_back(job.views, walk)
    unsure_of: int | None = None  # the lost map with which a link would be, but for a loose scale
    trace = WalkTrace(submap.id, attempt.name, job.newest_id, se3.translation(submap.T_submap_kf[job.newest_id]))
    limits = max_gap_frames, attempt.max_unrecognised
    for step in track_in_reverse(reverse_tracker, views, parts.config.health, relinker.keyframe_ids, *limits):
        trace.note(step.view, step.track)
        walk.out_of_time = bool((yield trace.news()))
        if walk.out_of_time:
            break
        walk.rivals = reverse_tracker.rivals
        if isinstance(step.track, Failure):
            walk.note_unusable(step.track)
            continue
        if step.track.wide and walk.before_gap is None:
            walk.before_gap = min(walk.frames, default=job.newest_id)
        walk.note_posed(_recovered_frame(reverse_tracker, step.view, step.track), step.report is not None)
        if (earlier := reverse_tracker.confirmed()) is not None:
            walk.note_confirmed(_recovered_frame(reverse_tracker, earlier.view, earlier))
            trace.note_confirmed(earlier)
        if step.view.index not in submap.keyframes:
            continue
        for tried in relinker.attempts(step.view.index):
            found = confirm_link(walk, parts, tried.old_id, tried.result)
            if not isinstance(found, Failure):
                walk.link = found
                break
            if isinstance(found, LinkRefusal) and found.unsure is not None:
                unsure_of = tried.old_id
            walk.note_refused(found)
            # A lost map of few keyframes hardly knows its scale: another way over the same ones knows it no better.
            at_overlap = isinstance(tried.result, Failure) and tried.result.reason is FailureReason.SCALE
            walk.needs_camera |= at_overlap and relinker.holds_all
            data = refusal_data(attempt.name, tried.old_id, found, shared_keyframes=tried.n_shared)
            at = step.view.index, step.view.timestamp_s, submap.id
            walk.events.append(Event(EventKind.LINK_REFUSED, *at, data, found.gates))
        walk.given_up |= relinker.has_seen_enough
        if walk.link is not None or walk.given_up:
            break
    walk.needs_camera |= bool(job.lost) and relinker.is_hopeless
    if walk.link is None and unsure_of is not None:
        # The map has grown since that try.
        unsure = _link_with_doubt(walk, parts, unsure_of, job.lost[unsure_of])
        walk.unsure = None if isinstance(unsure, Failure) else unsure
    if job.lost:
        walk.events.append(walk.event(time.perf_counter() - started, max_gap_frames))
    return walk


def _there_and_back(views: tuple[View, ...], walk: Walk) -> Iterator[View]:
    """Yield the views, and then, the other way round, those that the walk has found no pose for.

    A camera that turns away slowly and comes back at once is lost in reverse, and followed forwards.
    """
    yield from views
    yield from way_to_gaps(views[::-1], walk.frames, walk.submap.keyframes)


def _recovered_frame(reverse_tracker: VisualOdometry, view: View, track: Track) -> RecoveredFrame:
    T_kf_cam = reverse_tracker.relative_pose(track)
    pose = FramePose(view.index, view.timestamp_s, reverse_tracker.submap.id, reverse_tracker.reference_id, T_kf_cam)
    seen = FrameObservations.of(track.view.features, track.landmark_ids, pose.submap_id)
    return RecoveredFrame(pose, track.n_matches, track.n_inliers, seen, track.method)


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
    max_unrecognised: int | None = None,
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
    max_unrecognised : int, optional
        So many of them may show something.
    """
    n_failed, n_unrecognised = 0, 0
    for view in views:
        try:
            track: Track | Failure = judge_track(reverse_tracker.track(view), health)
            report: KeyframeReport | None = None
            if isinstance(track, Track):
                reverse_tracker.submap.count_sightings(track)
                is_wanted = view.index in keyframe_ids and view.index not in reverse_tracker.submap.keyframes
                if is_wanted or reverse_tracker.keyframe_due(track):
                    inserted = reverse_tracker.insert_keyframe(track)
                    if isinstance(inserted, Failure):
                        track = inserted
                    else:
                        report = inserted
                else:
                    reverse_tracker.go_by_known(track)
        except SolverError as error:
            log.warning("reverse tracking ends: %s", error)
            yield ReverseStep(view, Failure(FailureReason.SOLVER, str(error)), None)
            return
        yield ReverseStep(view, track, report)
        if isinstance(track, Track):
            n_failed, n_unrecognised = 0, 0
            continue
        n_failed, n_unrecognised = n_failed + 1, n_unrecognised + (track.reason is not FailureReason.NO_TEXTURE)
        if n_failed > max_gap_frames or (max_unrecognised is not None and n_unrecognised >= max_unrecognised):
            return
