"""Whether a map hands its scale on, asked while it lives and at the end: where not, what comes after is another map.

A fast turn leaves few landmarks that both sides of it have seen. If their depths are hardly known, the scale behind the
turn is another one, and yet every frame finds its inliers. The map's own normal equations show it
(`linking/scale_observability.py`), once some keyframes behind the turn have seen the same. They are solved at the desk,
in the background with workers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from dualslam.atlas.atlas import Atlas, Link, joined
from dualslam.atlas.endings import part_off
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.jobs import Desk, Handlers, InlineDesk, JobKind
from dualslam.core.noise_model import GROUP, TINY
from dualslam.core.types import BoolArray, Failure, FloatArray, IntArray
from dualslam.linking.scale_observability import (
    N_AROUND,
    SCALE_INFLATION,
    ScaleQuestion,
    answer_scale,
    ask_scale,
    scale_sigmas_in_all,
)
from dualslam.map.landmark_views import noise_excess
from dualslam.map.split import submap_of
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
    return config.wrong_scale / float(ndtri(1.0 - SURE / 2))


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


def part_what_lost_its_scale(record: Record, submap_id: int, config: LinkingConfig, now: FrameStamp) -> None:
    """Split off the part of a map beyond a loss of scale, seen from its links; without one it is left as it is.

    What other maps tie together stays: the scale of either part is known there.

    - `submap_id`: of a map that is archived.
    - `config`: says by how much a scale must be off to be wrong.
    """
    submap = record.atlas.submaps[submap_id]
    held = _where_links_stand(record.atlas, submap_id) - submap.condemned
    if not held:
        return
    for later in (True, False):
        ids = np.array(sorted(submap.keyframes.keys() - submap.condemned), np.int64)
        if all(count_ties(submap, ids, at, at, n_views=2) >= FIRM_TIES for at in range(GROUP, len(ids), GROUP)):
            return
        outward = ids if later else ids[::-1]
        rest, sigma = _outermost_loss(record.atlas, submap, outward, np.isin(outward, list(held)), lost_from(config))
        if len(rest) > 1:  # a submap has two keyframes at least
            anchor = int(outward[len(outward) - len(rest) - 1])
            _part_off(record, submap, sorted(rest.tolist()), anchor, sigma, now)


def _outermost_loss(
    atlas: Atlas, submap: Submap, outward: IntArray, is_held: BoolArray, max_sigma: float
) -> tuple[IntArray, float]:
    """Return the keyframes behind the loss of scale farthest out, seen from a link, that nothing else ties to the rest.

    - `outward` (F,): keyframes; `is_held` (F,): whether a link stands there.
    - `max_sigma`: of the logarithm of the scale, from which on it is lost.

    Returns (IntArray, float): empty where there is none; and how well the scale is known where it is first lost.
    """
    links = np.flatnonzero(is_held & ~np.append(is_held[1:], False))[::-1].tolist()
    places = [
        (outward[begin : begin + GROUP], outward[max(link - GROUP + 1, 0) : link + 1])
        for link in links
        for begin in range(link + 1, len(outward), GROUP)
    ]
    if not places:
        return outward[:0], 0.0
    sigmas = iter(scale_sigmas_in_all(submap, places, noise_excess(submap)))
    for link in links:
        begins = np.arange(link + 1, len(outward), GROUP)
        sigma = np.array([next(sigmas) for _ in begins])
        n_lost = int(np.minimum.accumulate(sigma[::-1] > max_sigma).sum())
        # The first group may have keyframes of either scale: what ties it may tie the others of it.
        if n_lost and not _is_held(atlas, submap.id, outward[begins[-max(n_lost - 1, 1)] :]):
            return outward[begins[-n_lost] :], float(sigma[-n_lost])
    return outward[:0], 0.0


def _where_links_stand(atlas: Atlas, submap_id: int) -> set[int]:
    """Return the keyframes of a map at which links to others stand."""
    held: set[int] = set()
    own = atlas.submaps[submap_id].keyframes.keys()
    for link, at in _links_at(atlas, submap_id):
        held |= {at, *(own & set(link.keyframes))}
    return held


def _links_at(atlas: Atlas, submap_id: int) -> Iterator[tuple[Link, int]]:
    """Yield the believed links of a map to others, each with the keyframe at which it stands."""
    for link in atlas.believed:
        if link.a != link.b and submap_id in (link.a, link.b):
            yield link, link.attached(atlas)[link.b == submap_id]


def _is_held(atlas: Atlas, submap_id: int, beyond: IntArray) -> bool:
    """Whether a loop within the map, or other maps, tie what lies beyond a loss to the rest."""
    loops = (link.attached(atlas) for link in atlas.believed if link.a == link.b == submap_id)
    if any(np.isin(loop, beyond).sum() == 1 for loop in loops):
        return True
    others = [link for link in atlas.believed if submap_id not in (link.a, link.b)]
    set_of = {m: component[0] for component in joined(atlas.submaps, others) for m in component}
    reached: dict[bool, set[int]] = {True: set(), False: set()}
    for link, at in _links_at(atlas, submap_id):
        reached[at in beyond].add(set_of[link.b if link.a == submap_id else link.a])
    return bool(reached[True] & reached[False])


def _part_off(record: Record, submap: Submap, rest: list[int], anchor: int, sigma: float, now: FrameStamp) -> None:
    """Make the keyframes at one end of a map a submap of their own, with the frames and links that hang on them."""
    atlas = record.atlas
    part = submap_of(submap, len(atlas.submaps), rest)
    moved = [_moved_to(link, submap, part, link.attached(atlas)) for link in atlas.links]
    if moved != atlas.links:
        for m in atlas.component_of(submap.id):
            atlas.placement.pop(m, None)  # it is composed along its links again
    part_off(record, submap, part, anchor)
    atlas.links = moved
    frames = sorted(pose.index for pose in record.own_poses() if pose.submap_id == part.id)
    told = {"reason": "scale_lost", "sigma_scale": sigma, "old_submap": part.id, "left": frames}
    record.event(EventKind.CUT, now, submap.id, **told)


def _moved_to(link: Link, old: Submap, part: Submap, at: tuple[int, int]) -> Link:
    """Return a link, of the part where an end of it stands at a keyframe of that; both have the same coordinates."""
    if link.a == old.id and at[0] in part.keyframes:
        link = replace(link, a=part.id, keyframe_a=at[0])
    if link.b == old.id and at[1] in part.keyframes:
        link = replace(link, b=part.id, keyframe_b=at[1])
    return link
