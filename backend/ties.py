"""Factors beside projections: the gauge, relative poses, and holds where ties are too few."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter

import gtsam

from dualslam.backend.factor_index import MIN_TIES, OUTSIDE, Plan
from dualslam.backend.factors import baseline_factor, pose_prior, relative_pose
from dualslam.backend.gauge import Gauge, choose_gauge
from dualslam.backend.observability import find_components
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import Submap

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

    Attributes
    ----------
    gauge : Gauge or None
    forced : set of int
        Keyframes that are held whatever ties them. They stay when the graph is made anew.
    holds : dict of int to int
        Factors of the keyframes that are held by a loose prior.
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
        if gauge.second is not None and gauge.second in wanted and n_rows(gauge.second) >= MIN_TIES:
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
