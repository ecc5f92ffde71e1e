"""Whether a live map still hands its scale on: where it does not, what comes after is another map.

A fast turn leaves few landmarks that both sides of it have seen. If their depths are hardly known, the scale behind the
turn is another one, and yet every frame finds its inliers. The map's own normal equations show it
(`linking/scale_observability.py`), once some keyframes behind the turn have seen the same. They are solved at the desk,
in the background with workers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from dualslam.atlas.atlas import Link
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3
from dualslam.core.jobs import Desk, Handlers, InlineDesk, JobKind
from dualslam.core.noise_model import GROUP, TINY
from dualslam.core.types import Failure, FloatArray, IntArray
from dualslam.linking.scale_observability import N_AROUND, SCALE_INFLATION, ScaleQuestion, answer_scale, ask_scale
from dualslam.map.submap import Submap

BEHIND = 2 * GROUP
"""Keyframes after a group before it is tested."""
SURE = 0.9
"""Probability of a wrong scale at which a map is split. At even odds half of the split maps would have been whole: six
runs of `hololens_000` lose 2 % of their frames by that, and the error of the rest falls by a fifth."""
FIRM_TIES = 20
"""Landmarks that two keyframes before the group and two after it have seen, from which on nothing is asked: each would
have to be off by half its depth for the scale to be lost. They are counted in a hundredth of the time."""
TIE_PARALLAX_DEG = 0.7
"""Parallax of a landmark that counts as a tie: that of near ones (the mapper's `MIN_PARALLAX_DEG`), less what the graph
has moved since. Far ones may be off by half their depth."""


@dataclass(frozen=True, slots=True)
class ScaleLoss:
    """A place in a map across which the scale is not handed on."""

    since: int  # the first keyframe that may be of either scale
    first: int  # the first one of the map that begins there: where the fewest landmarks are seen from both sides
    sigma: float  # standard deviation of the logarithm of the scale, after against before

    @property
    def detail(self) -> str:
        """For the event log."""
        known = "not known" if np.isinf(self.sigma) else f"known to {self.sigma:.0%}"
        return f"the scale from here on is {known} by what was mapped before"


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """A question about a group of a submap's keyframes. It can be pickled."""

    submap_id: int
    group: IntArray
    question: ScaleQuestion


def answer_question(asked: _Asked) -> float:
    """Return the standard deviation of the log of the scale after the group against that before it."""
    return answer_scale(asked.question)[0]


SCALE_HANDLERS: Handlers = {JobKind.SCALE: answer_question}


def lost_from(config: LinkingConfig) -> float:
    """Return the standard deviation from which on a scale is wrong with the probability `SURE`."""
    return config.wrong_scale / float(ndtri(1.0 - 0.5 * SURE))


class ScaleWatch:
    """Asks about each group of a live map's keyframes, once, when `BEHIND` have come after it.

    What the map held when it was first seen is not tested.

    - `config`: says by how much a scale must be off to be wrong.
    - `desk`: where the normal equations are solved; by default here and now.
    """

    def __init__(self, config: LinkingConfig, desk: Desk | None = None) -> None:
        self._desk = desk or InlineDesk(SCALE_HANDLERS)
        self.max_sigma = lost_from(config)
        self._asked: dict[int, int] = {}  # by submap: the newest keyframe that was in a group

    def judge(self, submap: Submap, links: Iterable[Link]) -> ScaleLoss | None:
        """Return where a map has lost its scale, if its newest keyframes show that.

        - `submap`: at each new keyframe.
        - `links`: those that are believed: what one of them holds is not lost.
        """
        self._ask_if_due(submap)
        for ended in self._desk.poll(JobKind.SCALE):
            asked: _Asked = ended.work
            if isinstance(ended.result, Failure) or asked.submap_id != submap.id:
                continue  # it costs its question
            sigma = SCALE_INFLATION * ended.result
            if sigma > self.max_sigma and (loss := self._loss_at(submap, asked.group, sigma, links)) is not None:
                return loss
        return None

    def _ask_if_due(self, submap: Submap) -> None:
        """Ask about the next group, once what comes after it is there."""
        ids = np.array(sorted(submap.keyframes), np.int64)
        begin = int(np.searchsorted(ids, self._asked.setdefault(submap.id, int(ids[-1])), side="right"))
        if len(ids) < begin + GROUP + BEHIND or self._desk.n_open(JobKind.SCALE, submap.id):
            return
        before, group = ids[begin - GROUP : begin], ids[begin : begin + GROUP]
        after = ids[begin + GROUP : begin + 2 * GROUP]
        self._asked[submap.id] = int(group[-1])
        if len(before) < GROUP or count_ties(submap, ids, begin, begin + GROUP, n_views=2) >= FIRM_TIES:
            return
        asked = _Asked(submap.id, group, question_about(submap, ids, before, after))
        self._desk.submit(JobKind.SCALE, asked, of=submap.id)

    @staticmethod
    def _loss_at(submap: Submap, group: IntArray, sigma: float, links: Iterable[Link]) -> ScaleLoss | None:
        """Return the seam within a group across which the scale is lost, unless a link holds it."""
        ids = np.array(sorted(submap.keyframes), np.int64)
        begin, end = np.searchsorted(ids, [group[0], group[-1] + 1]).tolist()
        if end == len(ids):
            return None  # the map was split meanwhile: nothing is left behind the group
        if count_ties(submap, ids, begin, end, n_views=2) >= FIRM_TIES:
            return None  # reverse tracking, or a loop, has tied them meanwhile
        seam = min(range(begin, end + 1), key=lambda place: count_ties(submap, ids, place, place))
        first = int(ids[seam])
        return None if _is_linked(submap.id, first, links) else ScaleLoss(int(group[0]), first, sigma)


def question_about(submap: Submap, ids: IntArray, before: IntArray, after: IntArray) -> ScaleQuestion:
    """Ask what the map claims of its scale at one place, against that at an earlier one.

    Few keyframes around count as well, but all where others than those just before have seen the same as those after:
    they may hold the places together.

    - `ids` (F,): its keyframes, ascending.
    - `before`, `after` (P,): keyframes of the two places.
    """
    seen = submap.covisible(submap.landmarks_of_keyframes(ids[ids >= after[0]]))[0]
    earliest = ids[max(int(np.searchsorted(ids, before[0])) - N_AROUND, 0)]
    return ask_scale(submap, [(before, after)], len(ids) if (seen < earliest).any() else N_AROUND)


def count_ties(submap: Submap, ids: IntArray, end: int, begin: int, n_views: int = 1) -> int:
    """Return how many landmarks that are not far are seen by `n_views` keyframes before `end`, and from `begin` on."""
    sides = ids[max(end - N_AROUND, 0) : end].tolist(), ids[begin : begin + N_AROUND].tolist()
    before, after = (submap.n_views_among(side) for side in sides)
    tied = (before >= n_views) & (after >= n_views)
    return int((tied & (_parallax_rad(submap, [*sides[0], *sides[1]]) >= np.radians(TIE_PARALLAX_DEG))).sum())


def _parallax_rad(submap: Submap, keyframe_ids: list[int]) -> FloatArray:
    """Return for each landmark (N,) the largest angle between the first of these keyframes' rays and another."""
    xyz = submap.landmarks["xyz_mu"]
    first, cosine = np.full(xyz.shape, np.nan), np.ones(len(xyz))
    for k in keyframe_ids:
        seen = submap.landmark_of[k]
        seen = seen[seen >= 0]
        ray = xyz[seen] - se3.translation(submap.T_submap_kf[k])
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), TINY)
        new = np.isnan(first[seen, 0])
        first[seen[new]] = ray[new]
        cosine[seen] = np.minimum(cosine[seen], np.einsum("ij,ij->i", first[seen], ray))
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _is_linked(submap_id: int, first: int, links: Iterable[Link]) -> bool:
    """Whether a link stands on keyframes of a submap from `first` on."""
    for link in links:
        for m, k in ((link.a, link.keyframe_a), (link.b, link.keyframe_b)):
            if m == submap_id and max((k, *link.keyframes)) >= first:
                return True
    return False
