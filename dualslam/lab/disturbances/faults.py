"""Faults inside the system: a script that the composition root puts around the parts, frame by frame.

Only the live track is disturbed. Reverse tracking meets the same frames later, and undisturbed: what is tested is
whether redundancy helps.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dualslam.core.config.corruption import INTERNAL_KINDS, Corruption, CorruptionKind
from dualslam.core.decisions import Ruling
from dualslam.core.errors import SolverError
from dualslam.core.estimates import KeyframeReport
from dualslam.core.geometry import so3
from dualslam.core.interfaces import Seeker, SubmapGraph, VisualOdometry
from dualslam.core.jobs import JobKind
from dualslam.core.types import Failure, FloatArray, Frame, Track, View
from dualslam.map.submap import Submap

if TYPE_CHECKING:
    from dualslam.recovery.job import RecoveryJob

_KINDS = INTERNAL_KINDS | {CorruptionKind.FEW_FEATURES}


class FaultScript:
    """Which faults there are, and at which frame the system is.

    Parameters
    ----------
    corruptions : iterable of Corruption
        Those that are no faults are left out.
    """

    def __init__(self, corruptions: Iterable[Corruption]) -> None:
        self._faults = tuple(c for c in corruptions if c.kind in _KINDS)
        self._frame, self._time_s = -1, float("nan")
        self._fired: list[Corruption] = []

    def around_views(self, view_of: Callable[[Frame], View | Failure]) -> Callable[[Frame], View | Failure]:
        """Return the function that finds a live frame's features, with some of them lost where the script says so."""
        if not self._faults:
            return view_of

        def disturbed(frame: Frame) -> View | Failure:
            self._frame, self._time_s = frame.index, frame.timestamp_s
            view = view_of(frame)
            return view if isinstance(view, Failure) else self._lose_features(view)

        return disturbed

    def around_odometry(
        self, new_odometry: Callable[[Submap, SubmapGraph], Seeker]
    ) -> Callable[[Submap, SubmapGraph], Seeker]:
        """Return the function that makes the front end of a submap, with faults in what it makes."""
        if not self._faults:
            return new_odometry
        return lambda submap, graph: cast(Seeker, _FaultyOdometry(new_odometry(submap, graph), self))

    def loses(self, kind: JobKind, job: Any) -> bool:
        """Whether a job ends as if its process had been killed."""
        return kind is JobKind.WALK and self.worker_dies(job)

    def kill_worker(self, kind: JobKind, job: Any, pid: int | None) -> None:
        """Kill the process that has begun a recovery, where the script says so."""
        if pid is not None and self.loses(kind, job):
            os.kill(pid, signal.SIGKILL)

    def active(self, kind: CorruptionKind, timestamp_s: float) -> Corruption | None:
        """Return the fault of a kind at the frame of this time, if that is the live frame.

        Frames are identified by their time: inside the system they have another number than in the source.
        """
        if timestamp_s != self._time_s:
            return None
        return next((f for f in self._faults if f.kind is kind and f.covers(self._frame)), None)

    def solver_fails(self, timestamp_s: float) -> bool:
        """Return whether the solver fails at this keyframe: once for each fault, at its first live keyframe."""
        return self._fires_once(CorruptionKind.SOLVER_ERROR, timestamp_s)

    def worker_dies(self, job: RecoveryJob) -> bool:
        """Return whether the recovery that starts now loses its process: once for each fault."""
        # A walk that only poses the frames before a start recovers nothing.
        return bool(job.lost) and self._fires_once(CorruptionKind.KILL_WORKER, self._time_s)

    def _fires_once(self, kind: CorruptionKind, timestamp_s: float) -> bool:
        fault = self.active(kind, timestamp_s)
        if fault is None or fault in self._fired:
            return False
        self._fired.append(fault)
        return True

    def _lose_features(self, view: View) -> View:
        fault = self.active(CorruptionKind.FEW_FEATURES, view.timestamp_s)
        if fault is None:
            return view
        n = len(view.features)
        rng = np.random.default_rng([fault.seed, 0xFEA7, view.index])
        kept = np.sort(rng.permutation(n)[: round((1 - fault.level) * n)])
        return replace(view, features=view.features.take(kept))


class _FaultyOdometry:
    """A front end whose pose or solver fails by the script; all else is the front end's own."""

    def __init__(self, inner: VisualOdometry, script: FaultScript) -> None:
        self._inner, self._script = inner, script

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def track(self, view: View) -> Track | Failure:
        track = self._inner.track(view)
        fault = self._script.active(CorruptionKind.WRONG_POSE, view.timestamp_s)
        if fault is None or isinstance(track, Failure):
            return track
        return replace(track, T_cam_submap=wrong_pose(track, self._inner.submap, fault))

    def keyframe_due(self, track: Track) -> Ruling:
        # A wrong pose that is no keyframe would not reach the map.
        forced = self._script.active(CorruptionKind.WRONG_POSE, track.view.timestamp_s) is not None
        known = track.view.index in self._inner.submap.keyframes
        if forced and not known:
            return Ruling(True, detail="the failure lab wants it")
        return self._inner.keyframe_due(track)

    def insert_keyframe(self, track: Track, in_haste: bool = False) -> KeyframeReport | Failure:
        if self._script.solver_fails(track.view.timestamp_s):
            raise SolverError(f"frame {track.view.index}: the failure lab lets the solver fail here")
        return self._inner.insert_keyframe(track, in_haste)


def wrong_pose(track: Track, submap: Submap, fault: Corruption) -> FloatArray:
    """Return ``T_cam_submap`` turned by the fault's degrees about a random axis, and moved by as much of the depth.

    Moved means: by the sine of that angle times the median depth of the landmarks that the frame sees, in a random
    direction. Axis and direction are the same in all frames of a fault.
    """
    rng = np.random.default_rng([fault.seed, 0x3053])
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    angle_rad = np.radians(fault.level)
    ids = track.seen_ids
    depth_mu = float(np.median(submap.depths(ids, track.T_cam_submap))) if len(ids) else 1.0
    T_error = np.eye(4)
    T_error[:3, :3] = so3.exp(angle_rad * axis)
    T_error[:3, 3] = np.sin(angle_rad) * depth_mu * direction
    return np.asarray(T_error @ track.T_cam_submap)
