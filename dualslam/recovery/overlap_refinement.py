"""Where two linked maps meet: the healthy end of the old map is measured in the new one as well, and solved there.

Fused submaps stay submaps. What the newer one gains are keyframes of the old map's healthy end and what they saw: as
observations, never as poses. Landmarks of the overlap that both maps hold become one, with the views of both; poses and
points around the overlap are solved in batch; and since the two maps now overlap by more, with twice the evidence,
their similarity is estimated again and must agree with the first one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dualslam.config.settings import FusionConfig
from dualslam.core.chi_square import CHI2_999
from dualslam.core.errors import SolverError
from dualslam.core.geometry import sim3
from dualslam.core.interfaces import SubmapGraph
from dualslam.core.types import BoolArray, Failure, FailureReason, IntArray
from dualslam.map.solving import solve
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.recovery.linking import LinkEstimate

MAX_SHIFT_CHI2 = CHI2_999[7]
"""Squared Mahalanobis distance of the link estimated again on the refined overlap from the first one, above which
neither is believed: chi-square, 7 degrees of freedom, 99.9 %."""

Relink = Callable[[Submap, Submap, int | None], LinkEstimate | Failure]


@dataclass(frozen=True, slots=True)
class OverlapReport:
    """What was done at an overlap.

    Attributes
    ----------
    keyframe_ids : tuple of int
        Keyframes of the old map that the new one did not hold before.
    n_merged : int
        Landmarks that both maps held, and that have the views of both now.
    n_new : int
        Landmarks of the old map that the new one did not hold.
    n_observations : int
        Taken over.
    n_outliers : int
        Observations of the new map that its solution contradicts.
    shift_sigmas : float
        How far the second link lies from the first: root of chi-square over its degrees of freedom.
    """

    keyframe_ids: tuple[int, ...]
    n_merged: int
    n_new: int
    n_observations: int
    n_outliers: int = 0
    shift_sigmas: float = 0.0

    @property
    def numbers(self) -> dict[str, float]:
        """All of it, for the event log."""
        return {
            "overlap_keyframes": len(self.keyframe_ids),
            "overlap_merged": self.n_merged,
            "overlap_new": self.n_new,
            "overlap_observations": self.n_observations,
            "overlap_outliers": self.n_outliers,
            "overlap_shift_sigmas": self.shift_sigmas,
        }


@dataclass(frozen=True, slots=True, eq=False)
class RefinedOverlap:
    """A refined overlap.

    Attributes
    ----------
    submap : Submap
        The new map with the overlap in it: a copy, solved.
    link : LinkEstimate
        Estimated again on the larger overlap.
    report : OverlapReport
    """

    submap: Submap
    link: LinkEstimate
    report: OverlapReport


def refine_overlap(
    old: Submap,
    new: Submap,
    link: LinkEstimate,
    new_graph: Callable[[], SubmapGraph],
    relink: Relink,
    config: FusionConfig,
) -> RefinedOverlap | Failure:
    """Refine the overlap of two maps and their link; neither map is changed.

    Parameters
    ----------
    old, new : Submap
    link : LinkEstimate
        With which they are joined so far.
    new_graph : callable
        Makes an empty graph.
    relink : callable
        Estimates the link of the old and the new map, given the onset of the corruption.
    config : FusionConfig

    Returns
    -------
    RefinedOverlap or Failure
        `CONTRADICTION` where the larger overlap gives another similarity: one of the two is wrong. `DISABLED` and
        `SOLVER` say that the overlap could not be refined. All others that the larger overlap gives no link.
    """
    if config.overlap_keyframes == 0:
        return Failure(FailureReason.DISABLED, "no keyframes of the old map are taken in")
    submap = new.copy()
    report = graft_keyframes(old, submap, link, config.overlap_keyframes)
    try:
        n_outliers = solve(submap, new_graph())
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))
    again = relink(old, submap, link.suspected_onset)
    if isinstance(again, Failure):
        return again
    chi2 = link_distance2(link, again)
    if chi2 > MAX_SHIFT_CHI2:
        numbers = {
            "shift_chi2": chi2,
            "scale_first": float(sim3.scale(link.S_old_new)),
            "scale_second": float(sim3.scale(again.S_old_new)),
        }
        return Failure(FailureReason.CONTRADICTION, "with the overlap refined another similarity fits", numbers)
    return RefinedOverlap(submap, again, replace(report, n_outliers=n_outliers, shift_sigmas=float(np.sqrt(chi2 / 7))))


def gauge_at_overlap(submap: Submap, keyframe_ids: IntArray) -> tuple[int, int]:
    """Return the two keyframes that are to hold a submap's gauge from now on: the widest baseline of the overlap.

    A link is measured at its overlap. While the map goes on at its other end its scale is still solved for, and if the
    gauge lay there, the overlap would drift away under the link. Where the overlap spans less than the gauge in use (a
    turn in place), that one stays.
    """
    ids = [int(k) for k in keyframe_ids if int(k) in submap.keyframes]
    if len(ids) < 2:
        return submap.gauge
    newest = ids[-1]
    reach = np.linalg.norm(submap.keyframe_poses(ids)[:, :3, 3] - submap.T_submap_kf[newest][:3, 3], axis=1)
    in_use = [submap.resolve_anchor(k, np.eye(4))[:3, 3] for k in submap.gauge]
    if reach.max() <= np.linalg.norm(in_use[0] - in_use[1]):
        return submap.gauge
    return newest, ids[int(np.argmax(reach))]


def link_distance2(first: LinkEstimate, second: LinkEstimate) -> float:
    """Return the squared Mahalanobis distance of two estimates of a link, as if they were independent.

    They share measurements: their difference is smaller than that of independent ones, if both are right.
    """
    xi = sim3.log(sim3.inverse(first.S_old_new) @ second.S_old_new)
    return float(xi @ np.linalg.solve(first.covariance + second.covariance, xi))


def graft_keyframes(old: Submap, new: Submap, link: LinkEstimate, n_keyframes: int) -> OverlapReport:
    """Bring the keyframes of the old map's healthy end, and what they saw, into the new map (not solved yet).

    Parameters
    ----------
    old, new : Submap
        `new` is changed.
    link : LinkEstimate
    n_keyframes : int
        So many of the old map's keyframes, the nearest in time to those that the link stands on.
    """
    S_new_old = sim3.inverse(link.S_old_new)
    newest = int(max(link.agreeing_keyframes))
    known = new.keyframes.keys() | new.anchors.keys()
    grafted = sorted(k for k in old.keyframes if k < newest and k not in known)[-n_keyframes:] if n_keyframes else []
    shared = [int(k) for k in link.agreeing_keyframes if int(k) in new.keyframes and int(k) in old.keyframes]
    landmark_of = _landmarks_in_new(old, new, link.landmark_pairs)
    fresh = _unpaired(old, new, grafted, shared, landmark_of)
    for k in grafted:
        new.add_keyframe(old.keyframes[k], sim3.act_on_pose(S_new_old, old.T_submap_kf[k]))
    landmark_of[fresh] = new.copy_landmarks(old, fresh, S_new_old)
    n_observations = sum(_copy_observations(old, new, k, landmark_of) for k in (*grafted, *shared))
    return OverlapReport(tuple(grafted), len(link.landmark_pairs), len(fresh), n_observations)


def _landmarks_in_new(old: Submap, new: Submap, pairs: IntArray) -> IntArray:
    """Return for each landmark of the old map the one of the new map that is the same, or `NO_LANDMARK`."""
    landmark_of = np.full(len(old.landmarks), NO_LANDMARK, np.int64)
    landmark_of[pairs[:, 0]] = new.current_ids(pairs[:, 1])
    return landmark_of


def _unpaired(old: Submap, new: Submap, grafted: list[int], shared: list[int], landmark_of: IntArray) -> IntArray:
    """Return the old map's landmarks that are new to the new one: seen twice at the overlap, and not contradicted
    there.

    Where a shared keyframe's keypoint has a landmark in either map and the two were not found to be the same, the maps
    disagree about it, and the new one is believed.
    """
    n_seen = np.zeros(len(old.landmarks), np.int64)
    disputed: BoolArray = np.zeros(len(old.landmarks), bool)
    for k in (*grafted, *shared):
        ids = old.landmark_of[k]
        feature = np.flatnonzero(ids >= 0)
        n_seen[ids[feature]] += 1
        if k in new.landmark_of:
            feature = feature[feature < _n_common(old, new, k)]
            disputed[ids[feature[new.landmark_of[k][feature] >= 0]]] = True
    return np.flatnonzero((n_seen >= 2) & old.landmarks["alive"] & (landmark_of == NO_LANDMARK) & ~disputed)


def _copy_observations(old: Submap, new: Submap, k: int, landmark_of: IntArray) -> int:
    """Add what the old map's keyframe saw and the new map's does not hold yet; return how many that were.

    Features that only the old map has in its keyframe stand behind those of the front end, and stay out.
    """
    feature = np.flatnonzero(old.landmark_of[k][: _n_common(old, new, k)] >= 0)
    ids = landmark_of[old.landmark_of[k][feature]]
    free = (ids >= 0) & (new.landmark_of[k][feature] == NO_LANDMARK) & ~np.isin(ids, new.landmark_of[k])
    new.add_observations(k, feature[free], ids[free])
    return int(free.sum())


def _n_common(old: Submap, new: Submap, k: int) -> int:
    """Return how many features of a keyframe both maps have, from the first on."""
    return old.keyframes[k].features.n_common(new.keyframes[k].features)
