"""Factors of a submap's graph, and the gauge: which pose is fixed and which baseline carries the scale.

Beside projections there are the gauge, relative poses, and holds where ties are too few.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import TypeGuard

import gtsam
import numpy as np

from dualslam.backend.convert import pose_key, to_pose3
from dualslam.backend.factor_index import OUTSIDE, Plan
from dualslam.backend.noise import GAUGE_SIGMA, PixelNoise, pose_sigmas
from dualslam.backend.observability import find_components
from dualslam.core.geometry import se3, so3
from dualslam.core.noise_model import BASELINE_SIGMA, GROUP, MIN_DEPTH_MU, MIN_LANDMARKS
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import Submap


def insert_projections(
    graph: gtsam.NonlinearFactorGraph,
    kf: IntArray,
    landmark: IntArray,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    K: gtsam.Cal3_S2,
    noise: PixelNoise,
) -> IntArray:
    """Append one projection factor per observation, in as few calls as keyframes and sigmas allow.

    - `kf`, `landmark` (R,), `uv_px` (R, 2), `sigma_px` (R,).
    - `graph`: is appended to.

    Returns (R,) int64: order of insertion: the i-th new factor is that of observation ``order[i]``.
    """
    order = np.lexsort((landmark, sigma_px, kf))
    if len(order) == 0:
        return order
    k, s = kf[order], sigma_px[order]
    cuts = np.flatnonzero((np.diff(k) != 0) | (np.diff(s) != 0)) + 1
    starts = np.concatenate(([0], cuts))
    ends = np.append(cuts, len(order)).tolist()
    keys, sigmas = k[starts].tolist(), s[starts].tolist()
    J = landmark[order].astype(float)
    Z = np.ascontiguousarray(uv_px[order].T)
    insert = gtsam.utilities.insertProjectionFactors
    for a, b, key, sigma in zip(starts.tolist(), ends, keys, sigmas, strict=True):
        insert(graph, pose_key(key), J[a:b], Z[:, a:b], noise(sigma), K)
    return order


def pose_prior(
    keyframe_id: int, T_submap_kf: FloatArray, rotation_rad: float = GAUGE_SIGMA, translation_mu: float = GAUGE_SIGMA
) -> gtsam.PriorFactorPose3:
    """Return a prior on a keyframe's pose; by default tight (a gauge)."""
    return gtsam.PriorFactorPose3(
        pose_key(keyframe_id), to_pose3(T_submap_kf), pose_sigmas(rotation_rad, translation_mu)
    )


def relative_pose(keyframe_id: int, known: RelativePose) -> gtsam.BetweenFactorPose3:
    """Return the factor of what is known of a keyframe's pose relative to another one."""
    noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
    return gtsam.BetweenFactorPose3(pose_key(known.keyframe_id), pose_key(keyframe_id), to_pose3(known.T_ref_kf), noise)


def baseline_factor(first: int, second: int, length_mu: float) -> gtsam.RangeFactorPose3:
    """Return the factor that fixes a submap's scale: the distance between the centres of two keyframes."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, BASELINE_SIGMA * length_mu)
    return gtsam.RangeFactorPose3(pose_key(first), pose_key(second), length_mu, noise)


MOVED_TOLERANCE = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """The pose and the distance that are held."""

    first: int
    T_submap_first: FloatArray  # (4, 4)
    second: int | None  # none where there is no other keyframe at a distance
    baseline_mu: float

    def was_moved_in(self, submap: Submap) -> bool:
        """Return whether the submap's arrays stand in another gauge than the graph (after `Submap.transform`)."""
        T = submap.T_submap_kf.get(self.first)
        if T is None:
            return False
        off = se3.inverse(self.T_submap_first) @ T
        if np.abs(se3.rotation(off) - so3.IDENTITY).max() > MOVED_TOLERANCE:
            return True
        if np.linalg.norm(se3.translation(off)) > MOVED_TOLERANCE * max(1.0, self.baseline_mu):
            return True
        other = submap.T_submap_kf.get(self.second) if self.second is not None else None
        if other is None:
            return False
        length = float(np.linalg.norm(se3.translation(other) - se3.translation(T)))
        return abs(length - self.baseline_mu) > MOVED_TOLERANCE * self.baseline_mu


def choose_gauge(submap: Submap, current: Gauge | None, pose: Callable[[int], FloatArray]) -> Gauge:
    """Return the gauge to use: the submap's where its keyframes live, else the one in use, else a neighbour.

    A new gauge is taken at the poses as they are estimated now, so that nothing jumps.

    - `submap`: with at least one keyframe.
    - `current`: is returned itself where nothing has to change.
    - `pose`: gives the present ``T_submap_kf`` of a keyframe.
    """
    live = submap.keyframes.keys()
    mine = (current.first, current.second) if current is not None else (None, None)
    wanted_first, wanted_second = submap.gauge
    if wanted_first in live:
        first = wanted_first
    elif mine[0] in live:
        first = mine[0]
    else:
        first = submap.living_keyframe(wanted_first)
    T_first = pose(first)

    def distance(k: int) -> float:
        return float(np.linalg.norm(se3.translation(pose(k)) - se3.translation(T_first)))

    def serves(k: int | None) -> TypeGuard[int]:
        return k is not None and k in live and k != first

    if current is not None and first == mine[0]:
        if serves(mine[1]) and (mine[1] == wanted_second or not serves(wanted_second)):
            return current
        if mine[1] is None and len(live) == 1:
            return current
    for second in (wanted_second, mine[1]):
        if serves(second) and distance(second) > MIN_DEPTH_MU:
            return Gauge(first, T_first, second, distance(second))
    # The farthest of the keyframes that share most with the first one.
    ids, _ = submap.covisible(submap.landmarks_of_keyframes([first]))
    near = [k for k in ids.tolist() if k != first and k in live][: 2 * GROUP] or [k for k in live if k != first]
    second = max(near, key=distance, default=None)
    if second is None or distance(second) <= MIN_DEPTH_MU:
        return (
            current
            if current is not None and first == mine[0] and mine[1] is None
            else Gauge(first, T_first, None, 0.0)
        )
    return Gauge(first, T_first, second, distance(second))


HOLD_ROTATION_RAD, HOLD_TRANSLATION_MU = 0.01, 0.02
"""Sigmas of the loose prior that holds a keyframe with too few ties where it is."""


@dataclass(frozen=True, slots=True, eq=False)
class TieChanges:
    """Removed and added factors, in this order: a new gauge, holds, relative poses."""

    remove: list[int]  # indices of factors
    gauge: Gauge
    new_holds: list[int]  # keyframes
    kept_holds: dict[int, int]  # factors by keyframe
    new_relative: list[tuple[int, RelativePose]]
    kept_relative: dict[int, tuple[RelativePose, int]]
    """dict of int to (RelativePose, int): with their factors, by keyframe."""


class Ties:
    """The gauge, holds and relative poses in a graph, with the indices of their factors.

    - `forced`: keyframes that are held whatever ties them. They stay when the graph is made anew.
    - `holds`: factors of the keyframes that are held by a loose prior.
    """

    def __init__(self) -> None:
        self.forced: set[int] = set()
        self.clear()

    def clear(self) -> None:
        """Begin a graph without factors."""
        self.gauge: Gauge | None = None
        self._gauge_factors: list[int] = []
        self.holds: dict[int, int] = {}
        self._relative: dict[int, tuple[RelativePose, int]] = {}

    def changes(
        self,
        graph: gtsam.NonlinearFactorGraph,
        submap: Submap,
        plan: Plan,
        pose_now: Callable[[int], FloatArray],
        n_rows: Callable[[int], int],
    ) -> TieChanges:
        """Add the new factors to a graph, and return what changes.

        - `pose_now`: of a keyframe.
        - `n_rows`: how many projections a keyframe will have.
        """
        remove: list[int] = []
        gauge = choose_gauge(submap, self.gauge, pose_now)
        if gauge is not self.gauge:
            remove += self._gauge_factors
            graph.push_back(pose_prior(gauge.first, gauge.T_submap_first))
            if gauge.second is not None:
                graph.push_back(baseline_factor(gauge.first, gauge.second, gauge.baseline_mu))

        weak = set(plan.weak_keyframes.tolist())
        known = {k: r for k, r in submap.relative_poses.items() if {k, r.keyframe_id} <= submap.keyframes.keys()}
        wanted = ((weak | self.forced) & submap.keyframes.keys()) - known.keys()
        wanted.discard(gauge.first)
        if gauge.second is not None and gauge.second in wanted and n_rows(gauge.second) >= MIN_LANDMARKS:
            wanted.discard(gauge.second)  # the baseline gives it its scale, so that landmarks of two views tie it
        remove += [factor for k, factor in self.holds.items() if k not in wanted]
        new_holds = sorted(wanted - self.holds.keys())
        for k in new_holds:
            graph.push_back(pose_prior(k, pose_now(k), HOLD_ROTATION_RAD, HOLD_TRANSLATION_MU))
        kept_relative = {k: (r, f) for k, (r, f) in self._relative.items() if known.get(k) is r}
        remove += [factor for k, (_, factor) in self._relative.items() if k not in kept_relative]
        new_relative = sorted(((k, r) for k, r in known.items() if k not in kept_relative), key=itemgetter(0))
        for k, r in new_relative:
            graph.push_back(relative_pose(k, r))
        kept_holds = {k: factor for k, factor in self.holds.items() if k in wanted}
        return TieChanges(remove, gauge, new_holds, kept_holds, new_relative, kept_relative)

    def note(self, changes: TieChanges, factors: IntArray) -> None:
        """Note the indices that the solver gave the new factors, in their order."""
        relative = len(factors) - len(changes.new_relative)
        holds = relative - len(changes.new_holds)
        if changes.gauge is not self.gauge:
            self.gauge, self._gauge_factors = changes.gauge, factors[:holds].tolist()
        self.holds = changes.kept_holds | dict(zip(changes.new_holds, factors[holds:relative].tolist(), strict=True))
        taken = zip(changes.new_relative, factors[relative:].tolist(), strict=True)
        self._relative = changes.kept_relative | {k: (known, factor) for (k, known), factor in taken}

    def hold_loose_pieces(self, submap: Submap, plan: Plan) -> None:
        """Hold the keyframes of every piece of the planned graph that is not connected to the gauge."""
        obs, e = submap.observations, plan.adding
        ids, label = find_components(obs["kf"][e], obs["landmark"][e])
        if len(ids) == 0 or label.max() == 0:
            return
        first = choose_gauge(submap, None, submap.T_submap_kf.__getitem__).first
        home = label[ids == first]
        self.forced.update(ids[label != (home[0] if len(home) else OUTSIDE)].tolist())
