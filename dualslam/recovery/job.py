"""Input and output of reverse tracking, which can be pickled, and the parts of which it is made."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dualslam.atlas.trajectory import FramePose, Path
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.estimates import PreferredCamera
from dualslam.core.events import Event
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import Failure, FloatArray, FrameMethod, IntArray, LateFrame, View
from dualslam.linking import DescriptorMatcher, LinkEstimate, estimate_link
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.submap import Submap
from dualslam.recovery.schedule import LinkTries


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryJob:
    """Everything that reverse tracking needs, as it was when the new submap started. It can be pickled."""

    submap: Submap  # the new one, a copy
    newest_id: int  # the keyframe of it to start from
    lost: dict[int, Submap]
    """Copies of the lost submaps that it may link to. With none the walk only poses the frames before the start."""
    onsets: dict[int, int]  # for each of them, and of `joined`, the frame from which on it is suspected to be corrupted
    views: tuple[View, ...]
    """What is buffered, latest first, from the frame before `newest_id` on. Where a walk is made again for the sake of
    frames without a pose: those, and what leads to them."""
    own: tuple[View, ...]
    """Buffered views of the new submap's keyframes, `newest_id` included: for attempts that need their images."""
    camera: Camera  # the one that rectified them
    camera_covariance: FloatArray | None  # (5, 5): of the correction that it has, if it was estimated
    tries: LinkTries = field(default_factory=LinkTries)  # what earlier walks have tried in vain
    poses: tuple[FramePose, ...] = ()  # of the frames that the new submap has posed
    paths: dict[int, Path] = field(default_factory=dict)  # for each lost submap the camera's path in it
    notes_rivals: bool = False
    """Whether an ambiguous pose beyond a gap is used. The velocities must then decide."""
    expected: dict[int, FloatArray] = field(default_factory=dict)
    """dict of int to (4, 4): ``T_cam_submap`` of frames beyond a gap, decided by the velocities."""
    joined: dict[int, Submap] = field(default_factory=dict)
    """Copies of lost submaps that are joined with it by a scale too loose to be relied on: these links are measured
    again, by the keyframes that both hold."""
    live_since: int = 0  # the keyframe that the submap's first walk set out from
    late: tuple[LateFrame, ...] = ()  # frames among the views that came too late to be tracked
    first_alone: bool = False  # whether the first attempt alone is made


@dataclass(frozen=True, slots=True, eq=False)
class RecoveredFrame:
    """A frame that the walk posed, relative to a keyframe of its submap, and what it saw of that."""

    pose: FramePose
    n_matches: int
    n_inliers: int
    observations: FrameObservations | None = None
    method: FrameMethod = FrameMethod.GUIDED


@dataclass(frozen=True, slots=True, eq=False)
class FoundLink:
    """The link that an attempt ended with; `is_sure`: whether it may be relied on, by all its gates."""

    old_id: int
    estimate: LinkEstimate
    attempt: str
    is_sure: bool = True

    def is_surer_than(self, other: FoundLink | None) -> bool:
        """Whether it may be relied on and the other not, or its scale is known better; any is surer than none."""
        if other is None or self.is_sure != other.is_sure:
            return other is None or self.is_sure
        return self.estimate.sigma_scale < other.estimate.sigma_scale


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryResult:
    """The result of a recovery: of the attempt that led to a link, or else of the first one that posed a frame."""

    submap: Submap  # the job's, grown at its early end
    frames: tuple[RecoveredFrame, ...]  # in the order of the walk
    link: FoundLink | None
    events: tuple[Event, ...]  # of all attempts, in order
    # Wall time of all attempts, and CPU time of the process, whose threads find features beside the walk.
    seconds: float
    cpu_s: float
    looks_alike: bool = False
    """Whether beyond a gap two poses explained as much: no later walk over it would tell them apart."""
    needs_camera: bool = False
    """Whether no later walk does better under this camera: the pixels contradict it, or the scale stays open."""
    stopped_at: int | None = None
    """The frame at which all attempts have stopped, none of which met a lost map's keyframes."""
    tries: LinkTries = field(default_factory=LinkTries)  # the job's, with the tries of this walk
    relinked: tuple[FoundLink, ...] = ()  # the links with `joined` submaps, measured again
    failure: Failure | None = None
    """Why no walk was made, or why its result is lost: then there is nothing to take over."""

    @classmethod
    def of(cls, job: RecoveryJob, outcome: RecoveryResult | Failure) -> RecoveryResult:
        """Return the result of a job, an empty one where the job has failed."""
        if not isinstance(outcome, Failure):
            return outcome
        return cls(job.submap, (), None, (), 0.0, 0.0, tries=job.tries, failure=outcome)

    def apart_from(self, submap_ids: Collection[int]) -> RecoveryResult:
        """Return the result without links to some submaps."""
        link = None if self.link is None or self.link.old_id in submap_ids else self.link
        return replace(self, link=link, relinked=tuple(k for k in self.relinked if k.old_id not in submap_ids))


def path_of(submap: Submap, frames: Iterable[RecoveredFrame], own: Iterable[FramePose]) -> Path:
    """Return the path of what reverse tracking has posed in a submap, and of the frames that it set out from."""
    walked = {frame.pose.index: frame.pose for frame in frames}
    before = [pose for pose in own if pose.index not in walked and pose.keyframe_id in submap.keyframes]
    return Path.of([*before, *walked.values()], submap)


def refusal_data(attempt: str, old_id: int, why: Failure, **known: Any) -> dict[str, Any]:
    """Return what the event `link_refused` tells, wherever the link is refused; `known`: of the try, besides."""
    return {
        "attempt": attempt,
        "old_submap": old_id,
        **known,
        "verdict": why.detail,
        "reason": str(why.reason),
        **why.numbers,
    }


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One way to track in reverse, by the name of the front end that its poses come from."""

    name: str
    new_odometry: Callable[[RecoveryJob, Submap, SubmapGraph], VisualOdometry]
    find_lack: Callable[[], Failure | None] = lambda: None  # why it cannot be made in this installation, if so
    max_unrecognised: int | None = None
    """For an attempt that is only made if those before it leave something to do better: it ends at so many frames in a
    row that show something and are not recognised."""


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryParts:
    """The parts of a recovery, built by the composition root of the process in which it runs."""

    attempts: tuple[Attempt, ...]
    posing: Attempt  # the way back where there is no lost map, but frames without a pose
    new_graph: Callable[[], SubmapGraph]
    matcher: DescriptorMatcher
    find_camera: Callable[[RecoveryJob, Submap, IntArray], PreferredCamera | None]
    """Asks keyframes of a map that a walk has grown about the camera."""
    config: Config
    read: Callable[[LateFrame, Camera], View | Failure]  # finds the live features in a frame that came too late
    foresee: Callable[[View], None] = lambda view: None  # precomputes what crossing a gap may need in a frame

    def link(self, old: Submap, new: Submap, onset: int | None) -> LinkEstimate | Failure:
        """Try to link a submap with an older one, which is suspected to be corrupted from a frame on."""
        rng = np.random.default_rng(self.config.seed)
        return estimate_link(old, new, self.config.linking, rng, onset, self.matcher)

    @property
    def max_scale_sigma(self) -> float:
        """Largest standard deviation of a link's scale at the live end."""
        return self.config.linking.max_live_scale_sigma
