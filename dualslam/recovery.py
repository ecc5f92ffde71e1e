"""Algorithm 1: walk back in time from a new submap until it overlaps a lost one so well that a Sim(3) links the two.

The walk is the visual front end, given the buffered frames latest first. It sees images and features only, never the
old map's poses or landmarks: a link must not confirm itself. What it takes from the old map is which frames were
keyframes, so that both maps hold the same ones.

It is a job: a function of a snapshot that nobody else changes, so that it can run beside the tracking, in a process of
its own, and be merged (`dualslam.merging`) when it is ready.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from dualslam.core.camera import Camera
from dualslam.core.config import FusionConfig, RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.events import Event, EventKind
from dualslam.core.interfaces import KeyframeReport, SubmapGraph, VisualOdometry
from dualslam.core.submap import Submap
from dualslam.core.types import Failure, FailureReason, Track, View
from dualslam.linking import LinkEstimate
from dualslam.seam import SeamReport, refine_seam
from dualslam.trajectory import FramePose

log = logging.getLogger(__name__)

Judge = Callable[[Track | Failure], Track | Failure]
Linker = Callable[[Submap, Submap, int | None], LinkEstimate | Failure]


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryJob:
    """Everything that a walk back needs, as it was when the new submap started. It can be pickled.

    Attributes
    ----------
    submap : Submap
        The new one, a copy.
    newest_id : int
        The keyframe of it to start from.
    lost : dict of int to Submap
        Copies of the lost submaps that it may link to. With none the walk only poses the frames before the start.
    onsets : dict of int to int
        For each of them the frame from which on it is suspected to be corrupted.
    views : tuple of View
        What is buffered, latest first, from the frame before `newest_id` on.
    camera : Camera
        The one that rectified them.
    """

    submap: Submap
    newest_id: int
    lost: dict[int, Submap]
    onsets: dict[int, int]
    views: tuple[View, ...]
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class WalkedFrame:
    """A frame that the walk posed, relative to a keyframe of its submap."""

    pose: FramePose
    n_matches: int
    n_inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class FoundLink:
    """The link that a walk ended with. `seam`: how the seam was refined, or why it was not."""

    old_id: int
    estimate: LinkEstimate
    seam: SeamReport | Failure


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryResult:
    """What a walk back found out.

    Attributes
    ----------
    submap : Submap
        The job's, grown at its early end.
    frames : tuple of WalkedFrame
        In the order of the walk.
    link : FoundLink or None
    events : tuple of Event
        The attempts, in order.
    seconds, cpu_s : float
        Wall and CPU time of the walk.
    """

    submap: Submap
    frames: tuple[WalkedFrame, ...]
    link: FoundLink | None
    events: tuple[Event, ...]
    seconds: float
    cpu_s: float


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryParts:
    """What a walk is made of; put together by the composition root of the process in which it runs."""

    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], VisualOdometry]
    link: Linker
    judge: Judge
    config: RecoveryConfig
    fusion: FusionConfig


def run_recovery(job: RecoveryJob, parts: RecoveryParts) -> RecoveryResult | Failure:
    """Walk back from the job's submap until a link to a lost one passes its gates, or nothing is left to walk on.

    The job is left as it was.
    """
    started, cpu_started = time.perf_counter(), time.thread_time()
    submap, graph = job.submap.copy(), parts.new_graph()
    try:
        estimate = graph.update(submap)
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))
    submap.apply_estimate(estimate.keyframe_ids, estimate.T_submap_kf, estimate.landmark_ids, estimate.xyz_mu)
    walker = parts.new_odometry(submap, graph)
    walker.start_at(job.newest_id)
    relinker = Relinker(submap, job.lost, job.onsets, parts.link, parts.config)
    frames, events = [], []
    link: FoundLink | None = None
    for step in walk_back(walker, job.views, parts.judge, relinker.keyframe_ids, parts.config.max_leap_frames):
        frames.append(_walked(walker, step))
        if step.view.index not in submap.keyframes:
            continue
        for attempt in relinker.attempts(step.view.index):
            events.append(_event_of(attempt, step.view, submap.id))
            if link is None and not isinstance(attempt.result, Failure):
                found = _fused(job.lost[attempt.old_id], submap, attempt.result, parts)
                if isinstance(found, Failure):
                    events.append(_event_of(replace(attempt, result=found), step.view, submap.id))
                else:
                    link = found
        if link is not None:
            break
    seconds, cpu_s = time.perf_counter() - started, time.thread_time() - cpu_started
    return RecoveryResult(submap, tuple(frames), link, tuple(events), seconds, cpu_s)


def _fused(old: Submap, submap: Submap, link: LinkEstimate, parts: RecoveryParts) -> FoundLink | Failure:
    """Refine the seam and with it the link; a failure where the refined seam contradicts the link."""
    seam = refine_seam(old, submap, link, parts.new_graph, parts.link, parts.fusion)
    if isinstance(seam, Failure):
        contradicted = seam.reason is FailureReason.CONTRADICTION
        return seam if contradicted else FoundLink(old.id, link, seam)
    submap.take_over(seam.submap)
    return FoundLink(old.id, seam.link, seam.report)


def _walked(walker: VisualOdometry, step: WalkStep) -> WalkedFrame:
    view, track = step.view, step.track
    pose = FramePose(view.index, view.timestamp_s, walker.submap.id, walker.reference_id, walker.relative_pose(track))
    return WalkedFrame(pose, track.n_matches, track.n_inliers)


def _event_of(attempt: LinkAttempt, view: View, submap_id: int) -> Event:
    result = attempt.result
    refused = isinstance(result, Failure)
    data = {
        "old_submap": attempt.old_id,
        "shared_keyframes": attempt.n_shared,
        "verdict": result.detail if isinstance(result, Failure) else "linked",
        "reason": str(result.reason) if isinstance(result, Failure) else "linked",
        **result.numbers,
    }
    kind = EventKind.LINK_REFUSED if refused else EventKind.RECOVERY_ATTEMPT
    return Event(kind, view.index, view.timestamp_s, submap_id, data)


@dataclass(frozen=True, slots=True, eq=False)
class WalkStep:
    """One frame of a walk back: where it was found to be, and whether it became a keyframe."""

    view: View
    track: Track
    report: KeyframeReport | None


@dataclass(frozen=True, slots=True, eq=False)
class LinkAttempt:
    """One try to link the growing submap with an older one."""

    old_id: int
    n_shared: int
    result: LinkEstimate | Failure


def walk_back(
    walker: VisualOdometry, views: Iterable[View], judge: Judge, keyframe_ids: set[int], max_leap_frames: int
) -> Iterator[WalkStep]:
    """Pose frames one after the other in the order given, and extend the walker's submap by keyframes.

    Parameters
    ----------
    walker : VisualOdometry
        Started at a keyframe of its submap.
    views : iterable of View
        Latest first.
    judge : callable
        The health verdict on a track.
    keyframe_ids : set of int
        Frames that become keyframes in any case: those that were keyframes of an older submap.
    max_leap_frames : int
        So many frames in a row may be unusable before the walk ends.
    """
    n_failed = 0
    for view in views:
        track = judge(walker.track(view))
        if isinstance(track, Failure):
            n_failed += 1
            if n_failed > max_leap_frames:
                return
            continue
        n_failed = 0
        wanted = view.index in keyframe_ids and view.index not in walker.submap.keyframes
        report = None
        if wanted or walker.keyframe_due(track):
            try:
                report = walker.insert_keyframe(track)
            except SolverError as error:
                log.warning("the walk back ends at frame %d: %s", view.index, error)
                return
        yield WalkStep(view, track, report)


class Relinker:
    """Tries, at each new keyframe of a walk, to link the growing submap with those that it has come to overlap.

    Parameters
    ----------
    submap : Submap
        The growing one.
    lost : dict of int to Submap
    onsets : dict of int to int
        For each lost submap the frame from which on it is suspected to be corrupted.
    linker : callable
    config : RecoveryConfig
    """

    def __init__(
        self,
        submap: Submap,
        lost: dict[int, Submap],
        onsets: dict[int, int],
        linker: Linker,
        config: RecoveryConfig,
    ) -> None:
        self._submap = submap
        self._linker = linker
        self._config = config
        self._onsets = onsets
        self._old = [lost[m] for m in sorted(lost)]

    @property
    def keyframe_ids(self) -> set[int]:
        """Keyframes of the lost submaps."""
        return {k for old in self._old for k in old.keyframes}

    def attempts(self, keyframe_id: int) -> Iterator[LinkAttempt]:
        """Try each lost submap that holds the newest keyframe of the walk, the latest lost one first."""
        for old in reversed(self._old):
            shared = old.keyframes.keys() & self._submap.keyframes.keys()
            if keyframe_id not in shared or len(shared) < self._config.min_shared_keyframes:
                continue
            yield LinkAttempt(old.id, len(shared), self._linker(old, self._submap, self._onsets[old.id]))
