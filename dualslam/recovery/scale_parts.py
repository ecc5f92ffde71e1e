"""Splitting of linked maps at a lost scale: a link holds only the part with the scale of its place.

A map that has lost its scale and goes on may be joined to another by its later, healthy part: by sight, or by reverse
tracking. What lies beyond the loss hangs on the joined map by nothing, and yet it would be posed in it, ten times too
large. So each map that is linked is asked once more, at the end of the run, when all that it has seen is in it: from
its outermost links outward, as far as it hands its scale on. The rest is split off as a submap of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.endings import part_off
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.noise_model import GROUP
from dualslam.core.types import IntArray
from dualslam.linking.scale_observability import N_AROUND, answer_scale
from dualslam.map.landmark_views import noise_excess
from dualslam.map.split import submap_of
from dualslam.map.submap import Submap
from dualslam.recovery.scale_watch import FIRM_TIES, SCALE_INFLATION, count_ties, lost_from, question_about

SPAN = 2
"""Groups of keyframes across which the scale is asked for: a blurred turn may take longer than one, and hand on a
little from each to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class _Loss:
    """Where a map does not hand its scale on, seen from a place outward."""

    between: IntArray  # (N,): keyframes that may be of either scale
    beyond: IntArray  # (M,): those of another one
    sigma: float  # standard deviation of its logarithm


def part_what_lost_its_scale(record: Record, submap_id: int, config: LinkingConfig, now: FrameStamp) -> None:
    """Split off the part of a map beyond a loss of scale, seen from its links.

    A map without a link is left as it is: nothing says which of its parts is the right one. So is what lies between
    two links: each end has a scale that is known.

    - `submap_id`: of a map that is archived.
    - `config`: says by how much a scale must be off to be wrong.
    - `now`: for the event log.
    """
    submap = record.atlas.submaps[submap_id]
    held = _where_links_stand(record.atlas, submap_id) - submap.condemned
    if not held:
        return
    for later in (True, False):
        scales = _Scales(submap)
        outward = scales.ids if later else scales.ids[::-1]
        outermost = int(np.flatnonzero(np.isin(outward, list(held)))[-1])
        loss = scales.first_loss(outward[max(outermost - GROUP + 1, 0) :], lost_from(config))
        if loss is None or _is_held(record.atlas, submap_id, loss.beyond):
            continue
        rest = sorted([*loss.between.tolist(), *loss.beyond.tolist()])
        if len(rest) > 1:  # a submap has two keyframes at least
            anchor = int(outward[len(outward) - len(rest) - 1])
            _part_off(record, submap, rest, anchor, loss.sigma, now)


class _Scales:
    """Asks a submap how well it hands its scale on from place to place.

    Attributes
    ----------
    ids : (F,) int64
        Its keyframes that are not condemned, ascending.
    """

    def __init__(self, submap: Submap) -> None:
        self._submap = submap
        self._excess = noise_excess(submap)
        self.ids = np.array(sorted(submap.keyframes.keys() - submap.condemned), np.int64)

    def first_loss(self, outward: IntArray, max_sigma: float) -> _Loss | None:
        """Return the first place at which the scale is lost.

        - `outward` (G,): keyframes from a group of those that have the right scale on.
        - `max_sigma`: of the logarithm of the scale, from which on it is lost.
        """
        groups = [outward[begin : begin + GROUP] for begin in range(0, len(outward), GROUP)]
        for n in range(1, len(groups)):
            known = max(n - 1 - SPAN, 0)
            if (sigma := self._sigma(groups, known, n, max_sigma)) > max_sigma:
                return _Loss(outward[GROUP * (known + 1) : GROUP * n], outward[GROUP * n :], sigma)
        return None

    def _sigma(self, groups: list[IntArray], known: int, asked: int, max_sigma: float) -> float:
        """Return the standard deviation of the log of the scale of one group against that of another; 0 where firm."""
        before, after = sorted((np.sort(groups[known]), np.sort(groups[asked])), key=lambda group: int(group[0]))
        begin, end = np.searchsorted(self.ids, [before[-1] + 1, after[0]]).tolist()
        if count_ties(self._submap, self.ids, begin, end, n_views=2) >= FIRM_TIES:
            return 0.0
        through = np.concatenate(groups[known : asked + 1]).tolist()
        inflation = SCALE_INFLATION * max(self._excess[k] for k in through)
        # What keyframes farther off have seen makes it no worse, and costs the cube of their number.
        for n_around in (N_AROUND, None):
            question = question_about(self._submap, self.ids, before, after, n_around)
            sigma = inflation * answer_scale(question)[0]
            if sigma <= max_sigma:
                break
        return sigma


def _where_links_stand(atlas: Atlas, submap_id: int) -> set[int]:
    """Return the keyframes of a map at which links to others stand."""
    held: set[int] = set()
    own = atlas.submaps[submap_id].keyframes.keys()
    for link in atlas.believed:
        if link.a != link.b and submap_id in (link.a, link.b):
            at = link.attached(atlas)
            held |= {at[0] if link.a == submap_id else at[1], *(own & set(link.keyframes))}
    return held


def _is_held(atlas: Atlas, submap_id: int, beyond: IntArray) -> bool:
    """Whether a loop within the map ties what lies beyond a loss to the rest."""
    loops = (link.attached(atlas) for link in atlas.believed if link.a == link.b == submap_id)
    return any(np.isin(loop, beyond).sum() == 1 for loop in loops)


def _part_off(record: Record, submap: Submap, rest: list[int], anchor: int, sigma: float, now: FrameStamp) -> None:
    """Make the keyframes at one end of a map, and the frames that hang on them, a submap of their own."""
    part = submap_of(submap, len(record.atlas.submaps), rest)
    part_off(record, submap, part, anchor)
    frames = sorted(pose.index for pose in record.own_poses() if pose.submap_id == part.id)
    told = {"reason": "scale_lost", "sigma_scale": sigma, "old_submap": part.id, "left": frames}
    record.event(EventKind.CUT, now, submap.id, **told)
