"""Frames that show a submap which is not being tracked: found there by pixels, followed until others say the same."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import numpy as np

from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.interfaces import Seeker, SubmapGraph
from dualslam.core.noise_model import GROUP, SAME_WITHIN
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, FloatArray, Track, View
from dualslam.map.submap import Submap
from dualslam.places.faiss_index import FaissRecogniser
from dualslam.places.recogniser import PlaceCandidate
from dualslam.places.verification import PlaceVerifier

N_CONFIRMING = 2
"""Keyframes (or frames) that must say the same as the first: three with it, where evidence begins for a link too."""
SAME_TURN_RAD = float(np.radians(6.0))
"""The same for its rotation: twice 3 degrees."""
SILENT = (FailureReason.TOO_FEW_MATCHES, FailureReason.TOO_FEW_INLIERS)
"""Refusals of what only looked alike to the recogniser: they are no events."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceParts:
    """Recogniser and verifier of places, made by the composition root."""

    recogniser: FaissRecogniser
    verifier: PlaceVerifier


@dataclass(slots=True)
class Sighting:
    """A front end that has posed a frame in a submap, and those that it has posed since, relative to a keyframe."""

    odometry: Seeker
    keyframe_id: int
    tracks: list[tuple[Track, FloatArray]] = field(default_factory=list)


@dataclass(slots=True)
class Search:
    """A frame that is looked for in some submaps: the keyframes left to try, and where it was found."""

    view: View
    submaps: dict[int, Submap]
    candidates: list[PlaceCandidate]
    found: list[tuple[Sighting, Track]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Relocalised:
    """The map in which frames without a map were found."""

    odometry: Seeker  # goes on there
    earlier: list[tuple[Track, FloatArray]]
    """list of (Track, (4, 4)): frames before the newest that it has posed, with their poses relative to `reference`."""
    track: Track  # the newest frame's
    reference: int


class Sightings:
    """Shows frames to submaps that are not being tracked, in front ends that `new_relocaliser` makes."""

    def __init__(
        self,
        record: Record,
        parts: PlaceParts,
        new_graph: Callable[[], SubmapGraph],
        new_relocaliser: Callable[[Submap, SubmapGraph], Seeker],
        config: Config,
    ) -> None:
        self._record = record
        self._recogniser, self._verifier = parts.recogniser, parts.verifier
        self._new_graph = new_graph
        self._new_frontend = new_relocaliser
        self._config = config
        self._sighting: Sighting | None = None
        self._avoided: set[int] = set()

    def take_in(self, live: Submap | None, at_most: int | None = None) -> int:
        """Let the index know what all submaps have gained, but for the newest keyframes of the live one.

        `at_most`: landmarks in one go. Returns how many there were.
        """
        n = 0
        for submap in self._record.atlas.submaps.values():
            # Half of the landmarks of the newest keyframes will be culled.
            left = None if at_most is None else at_most - n
            n += self._recogniser.take_in(submap, GROUP if submap is live else 0, left)
        return n

    def avoid(self, submap_id: int) -> None:
        """Relocalise no more frames in a submap lost to repeated structure: a wrong pose may pass by chance."""
        self._avoided.add(submap_id)

    def end(self) -> None:
        """Forget what frames without a map have shown so far: there is one again."""
        self._sighting = None

    def sighted(self, view: View, K: FloatArray) -> Relocalised | None:
        """Search all submaps for a frame without a map; return where it is once later frames confirm it.

        `K`: (3, 3) intrinsics of the frame; submaps of other ones are not looked at.
        """
        if not self._config.places.enabled:
            return None
        if self._sighting is not None:
            followed = self.follow(self._sighting, view)
            if followed is None:
                return None
            self._sighting = None
            if not isinstance(followed, Failure):
                return followed
        self.take_in(None)
        self._sighting = self.find(view, K, self._record.atlas.submaps)
        return None

    def follow(self, sighting: Sighting, view: View) -> Relocalised | Failure | None:
        """Let the front end that has posed the last frame pose this one; None where more must say the same."""
        track = judge_track(sighting.odometry.track(view), self._config.health)
        if isinstance(track, Failure):
            return track
        if track.wide:
            return Failure(FailureReason.UNCONFIRMED, "the frame does not follow from the one before")
        if len(sighting.tracks) < N_CONFIRMING:
            sighting.tracks.append((track, sighting.odometry.relative_pose(track)))
            return None
        return Relocalised(sighting.odometry, sighting.tracks, track, sighting.odometry.reference_id)

    def find(self, view: View, K: FloatArray, submap_ids: Collection[int]) -> Sighting | None:
        """Pose a frame in the submap that it shows, one of these, by pixels alone."""
        search = self.search(view, K, submap_ids)
        while self.go_on(search):
            pass
        return self.outcome(search)

    def search(self, view: View, K: FloatArray, submap_ids: Collection[int]) -> Search:
        """Begin to look for a frame in the submaps that it may show: ask the index which keyframes it resembles."""
        all_submaps = {m: self._record.atlas.submaps[m] for m in submap_ids}
        submaps = {m: s for m, s in all_submaps.items() if (s.K == K).all() and m not in self._avoided}
        return Search(view, submaps, self._recogniser.query(view.features, submaps))

    def go_on(self, search: Search) -> bool:
        """Try to pose the frame by the next keyframe that it resembles; return False where there is none any more."""
        if not search.candidates:
            return False
        candidate, view = search.candidates.pop(0), search.view
        submap = search.submaps[candidate.submap_id]
        odometry = self._new_frontend(submap, self._new_graph())
        track = judge_track(odometry.relocalise(view, candidate.keyframe_id), self._config.health)
        if isinstance(track, Failure):
            return True
        why = self._verifier.check_pose(submap, candidate.keyframe_id, track.T_cam_submap, view.features)
        if why is not None:
            record_refusal(self._record, view, candidate.submap_id, candidate.submap_id, candidate.keyframe_id, why)
            return True
        pose = odometry.relative_pose(track)
        search.found.append((Sighting(odometry, candidate.keyframe_id, [(track, pose)]), track))
        return True

    def outcome(self, search: Search) -> Sighting | None:
        """Return where the frame was found, unless another place shows it as well."""
        if not search.found:
            return None
        best, track = max(search.found, key=lambda item: item[1].n_inliers)
        for other, contender in search.found:
            submap = best.odometry.submap
            if other.odometry.submap is not submap:
                continue
            here, there = se3.inverse(track.T_cam_submap), se3.inverse(contender.T_cam_submap)
            if not same_pose(here, there, SAME_WITHIN * median_depth(submap, track)):
                detail = f"keyframes {best.keyframe_id} and {other.keyframe_id} show the place as well, elsewhere"
                why = Failure(FailureReason.AMBIGUOUS_MODEL, detail)
                record_refusal(self._record, search.view, submap.id, submap.id, best.keyframe_id, why)
                return None
        return best


def record_refusal(
    record: Record, now: FrameStamp, submap_id: int, other_submap: int, other_frame: int, why: Failure
) -> None:
    """Enter a place that was not believed into the event log."""
    record.event(
        EventKind.LOOP_REFUSED,
        now,
        submap_id,
        why.gates,
        other_submap=other_submap,
        other_frame=other_frame,
        reason=str(why.reason),
        detail=why.detail,
        **why.numbers,
    )


def median_depth(submap: Submap, track: Track) -> float:
    """Return how far away is what a frame was tracked by, in the submap's unit."""
    return float(np.median(submap.depths(track.seen_ids, track.T_cam_submap)))


def turn_between(T_a: FloatArray, T_b: FloatArray) -> float:
    """Return the angle between two poses, radians."""
    return float(so3.rotation_angle(se3.rotation(T_a).T @ se3.rotation(T_b)))


def same_pose(T_a: FloatArray, T_b: FloatArray, within: float) -> bool:
    """Whether two poses, camera to map, are one: within a distance and `SAME_TURN_RAD`."""
    return bool(
        np.linalg.norm(se3.translation(T_a) - se3.translation(T_b)) < within and turn_between(T_a, T_b) < SAME_TURN_RAD
    )
