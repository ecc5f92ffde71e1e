"""Joins of maps that are apart at the end of a run, by all the places that they share."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.geometry import sim3
from dualslam.core.noise_model import MAJORITY, SAME_WITHIN
from dualslam.core.types import BoolArray, Failure, FloatArray
from dualslam.places.plausibility import reachable
from dualslam.places.recogniser import follow_maps, poses_of
from dualslam.places.sightings import N_CONFIRMING, SILENT, PlaceParts, record_refusal, same_pose
from dualslam.places.verification import PlaceMatch

RECENT = 20
"""Keyframes before and after that are no revisit: what is seen there is tracked, or was a moment ago."""


@dataclass(frozen=True, slots=True, eq=False)
class SetJoin:
    """A place by which two sets are joined, and how many more keyframes confirm it."""

    match: PlaceMatch
    confirmations: int


@dataclass(frozen=True, slots=True, eq=False)
class _Shared:
    """A place that two sets share, in their worlds."""

    match: PlaceMatch
    keyframes: tuple[int, int]  # one in either set
    S_a_b: FloatArray  # (4, 4): between the two worlds
    T_b_cam: FloatArray  # (4, 4): pose of the second keyframe
    within: float  # distance in the first world up to which another place says the same

    def agrees(self, other: _Shared) -> bool:
        """Whether another place puts its second keyframe where this one puts it."""
        here, there = (sim3.act_on_pose(S, other.T_b_cam) for S in (self.S_a_b, other.S_a_b))
        return same_pose(here, there, other.within)


class SetJoins:
    """Places that linked sets of maps share, compared keyframe by keyframe when the run is over.

    While a map is live, the keyframes that follow must confirm a place. Where steps are wide, they show other things.
    Here any keyframes of two sets confirm each other.
    """

    def __init__(self, record: Record, parts: PlaceParts, asked: Iterable[int], now: FrameStamp) -> None:
        """Compare the submaps `asked` with those of other sets."""
        self._record, self._now = record, now
        submaps = record.atlas.submaps
        arrived = {k: n for n, k in enumerate(sorted({k for s in submaps.values() for k in s.keyframes}))}
        set_of = self._set_of()
        matches = (match for m in asked for match in self._matches(m, parts, arrived, set_of))
        self._found = [(match, then) for match in matches if (then := poses_of(match, submaps)) is not None]

    def next(self) -> SetJoin | None:
        """Return the join of two sets that most keyframes agree on; None where there is none any more."""
        while (best := self._best()) is not None:
            ends = best.match.place, best.match.query
            self._found = [found for found in self._found if (found[0].place, found[0].query) != ends]
            match = reachable(self._record, best.match)
            if not isinstance(match, Failure):
                return best
            record_refusal(self._record, self._now, best.match.query[0], *best.match.place, match)
        return None

    # --- steps

    def _set_of(self) -> dict[int, list[int]]:
        """Return the linked set of each submap; submaps of one set have the same list."""
        return {m: component for component in self._record.atlas.components() for m in component}

    def _matches(
        self, m: int, parts: PlaceParts, arrived: Mapping[int, int], set_of: Mapping[int, list[int]]
    ) -> Iterator[PlaceMatch]:
        """Yield the verified places that a submap's keyframes show in other sets.

        `arrived`: the order in which all keyframes came. `set_of`: by submap.
        """
        atlas = self._record.atlas
        submap = atlas.submaps[m]
        for q in sorted(submap.keyframes.keys() - submap.condemned):

            def may_be(a: int, k: int, q: int = q) -> bool:
                return set_of[a] is not set_of[m] and abs(arrived[k] - arrived[q]) > RECENT

            mapped = submap.keyframes[q].features.take(np.flatnonzero(submap.landmark_of[q] >= 0))
            compared: set[int] = set()  # first submaps of sets: the best candidate of each that is one speaks for it
            for c in parts.recogniser.query(mapped, atlas.submaps, may_be):
                other = set_of[c.submap_id][0]
                if other in compared:
                    continue
                result = parts.verifier.verify((submap, q), (atlas.submaps[c.submap_id], c.keyframe_id))
                if not isinstance(result, Failure):
                    yield result
                elif result.reason in SILENT:
                    continue
                else:
                    record_refusal(self._record, self._now, m, c.submap_id, c.keyframe_id, result)
                compared.add(other)

    def _best(self) -> SetJoin | None:
        groups: dict[tuple[int, int], list[_Shared]] = defaultdict(list)
        for sets, shared in self._shared():
            groups[sets].append(shared)
        joins = [join for group in groups.values() if (join := _join_of(group)) is not None]
        return max(joins, key=lambda join: join.confirmations, default=None)

    def _shared(self) -> Iterator[tuple[tuple[int, int], _Shared]]:
        """Yield the places that sets which are still apart share, each with the first submaps of the two."""
        atlas = self._record.atlas
        set_of = self._set_of()
        worlds = {component[0]: atlas.S_world_submap(component) for component in atlas.components()}
        for found, then in self._found:
            match = follow_maps(found, then, atlas.submaps)
            if match is None or set_of[match.place[0]] is set_of[match.query[0]]:
                continue
            (a, k_a), (b, k_b), S_a_b = match.place, match.query, match.S_place_query
            if set_of[b] < set_of[a]:
                (a, k_a), (b, k_b), S_a_b = match.query, match.place, sim3.inverse(S_a_b)
            first, second = set_of[a][0], set_of[b][0]
            S_first_a, S_second_b = worlds[first][a], worlds[second][b]
            yield (
                (first, second),
                _Shared(
                    match,
                    (k_a, k_b),
                    S_first_a @ S_a_b @ sim3.inverse(S_second_b),
                    sim3.act_on_pose(S_second_b, atlas.submaps[b].T_submap_kf[k_b]),
                    SAME_WITHIN * float(sim3.scale(S_first_a) * np.median(atlas.submaps[a].depths_in(k_a))),
                ),
            )


def _join_of(group: Sequence[_Shared]) -> SetJoin | None:
    """Return the join of two sets by a place that enough keyframes confirm, and most of those that show one."""
    agree = np.array([[one.agrees(other) for other in group] for one in group])
    n_agreeing = np.array([_n_keyframes(group, row) for row in agree])
    is_sure = np.array([shared.match.doubt is None for shared in group])
    enough = max(N_CONFIRMING + 1, MAJORITY * _n_keyframes(group, np.ones(len(group), bool)))
    rows = np.flatnonzero(is_sure & (n_agreeing >= enough))
    if not len(rows):
        return None
    sigma = np.array([shared.match.numbers["sigma_scale"] for shared in group])
    best = rows[np.lexsort((sigma[rows], -n_agreeing[rows]))[0]]
    return SetJoin(group[best].match, int(n_agreeing[best]) - 1)


def _n_keyframes(group: Sequence[_Shared], chosen: BoolArray) -> int:
    """Count the keyframes of the set that has more of them among some places."""
    rows = np.flatnonzero(chosen).tolist()
    return max(len({group[row].keyframes[side] for row in rows}) for side in (0, 1))
