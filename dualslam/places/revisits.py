"""Loops and merges by revisit: when places are searched and believed, and what follows.

One verified pair is provisional. It is believed once keyframes that follow it say the same; it is dropped where they
do not. What is believed becomes a link, and the atlas does the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.report import AtlasReport
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.interfaces import Seeker, SubmapGraph, VisualOdometry
from dualslam.core.jobs import Desk, Ended, JobKind
from dualslam.core.noise_model import MAX_TRIES
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.map.submap import Submap
from dualslam.places.plausibility import agree, contradict, plausible
from dualslam.places.recogniser import PlaceSearch, follow_maps, poses_of
from dualslam.places.set_joins import RECENT, SetJoins
from dualslam.places.sightings import N_CONFIRMING, SILENT, PlaceParts, Sightings, record_refusal
from dualslam.places.verification import PlaceMatch

ASK_EVERY = 2
"""Keyframes between two searches, where nothing is provisional: neighbours show the same."""
REST, MAX_REST = 10, 40
"""Keyframes after a loop before the map that it lies in is searched again. Each loop that finds no more drift than the
map claims doubles them: beside one that was closed a moment ago it tells next to nothing, and costs more the larger the
map is. At most so many that each submap still comes by a few."""


@dataclass(slots=True, eq=False)
class _Found:
    """A verified place: provisional until others say the same, then believed, then solved with."""

    match: PlaceMatch
    confirmations: int = 0
    misses: int = 0
    then: tuple[FloatArray, FloatArray] | None = None  # where its two keyframes stood when it was believed
    kind: LinkKind | None = None  # of the connection that the atlas is solved with


class Revisits:
    """Searches for places, keyframe by keyframe, and links those that are revisited.

    - `desk`: where places are verified.
    - `new_relocaliser`: makes a front end of an archived submap.
    - `merges`: whether maps that are not joined yet may be.
    """

    def __init__(
        self,
        record: Record,
        parts: PlaceParts,
        connections: Connections,
        desk: Desk,
        new_graph: Callable[[], SubmapGraph],
        new_relocaliser: Callable[[Submap, SubmapGraph], Seeker],
        config: Config,
        merges: bool = True,
    ) -> None:
        self._record = record
        self._merges = merges
        self._parts = parts
        self._recogniser = parts.recogniser
        self.sightings = Sightings(record, parts, new_graph, new_relocaliser, config)
        self._connections = connections
        self._desk = desk
        self._config = config
        self._provisional: _Found | None = None
        self._believed: _Found | None = None  # waits for what the atlas needs to be solved with it
        self._closing: _Found | None = None  # the atlas is being solved with it
        self._n_asked = 0
        self._rest = REST
        self._rests_until = 0  # counted in `_n_asked`; other maps may be found all the same

    @property
    def _is_enabled(self) -> bool:
        return self._config.places.enabled and self._config.loops.enabled

    # --- keyframes of the live map

    def take_in(self, live: Submap | None, at_most: int | None = None) -> int:
        """Let places be recognised by what maps have gained; return how many landmarks were taken in.

        `live`: of which the newest keyframes wait. `at_most`: landmarks in one go, of which 1,000 take 2.5 ms.
        """
        return self.sightings.take_in(live, at_most) if self._is_enabled else 0

    def note_keyframe(
        self,
        live: VisualOdometry,
        at_most: int | None = None,
        among: Collection[int] | None = None,
    ) -> None:
        """Search for a place that the live map's reference keyframe shows again; `collect` returns the answer.

        `at_most`: see `take_in`. `among`: the submaps to search, of another run; by default all.
        """
        if not self._is_enabled:
            return
        self.sightings.end()
        self._n_asked += 1
        # Which another must not take the place of.
        waits = self._believed is not None or self._closing is not None
        busy = waits or self._desk.n_open(JobKind.LOOP, live.submap.id)
        if busy or (self._provisional is None and self._n_asked % ASK_EVERY):
            return
        submap, keyframe_id = live.submap, live.reference_id
        submaps = self._record.atlas.submaps
        if among is None:
            self.take_in(submap, at_most)
        else:
            for m in among:
                self._recogniser.take_in(submaps[m])
        features = submap.keyframes[keyframe_id].features
        may_be = self._may_be(submap, keyframe_id, among)
        candidates = tuple(self._recogniser.query(features, submaps, may_be))
        named = {submap.id, *(candidate.submap_id for candidate in candidates)} if candidates else set()
        search = PlaceSearch(submap.id, keyframe_id, candidates, {m: submaps[m].copy() for m in sorted(named)})
        self._desk.submit(JobKind.LOOP, search, of=submap.id)

    def take_solution(self, live: VisualOdometry | None, now: FrameStamp) -> AtlasReport | None:
        """Let the maps follow what has been solved meanwhile; return the report on the link that has waited for it."""
        return self._closed(self._connections.collect(now), live, now)

    def _closed(self, report: AtlasReport | None, live: VisualOdometry | None, now: FrameStamp) -> AtlasReport | None:
        if report is None or self._closing is None:
            return None
        closing, self._closing = self._closing, None
        return self._linked(closing, report, live, now)

    def collect(self, live: VisualOdometry | None, now: FrameStamp) -> AtlasReport | None:
        """Take in the places found meanwhile, and link those that are sure; return the report on the link that was
        made.
        """
        self._take_answers(self._desk.poll(JobKind.LOOP), live, now)
        waits = self._connections.foreseeing or self._connections.is_solving
        return None if waits else self._link_believed(live, now)

    def finish(self, live: VisualOdometry | None, now: FrameStamp) -> AtlasReport | None:
        """Do the same at the end of the run, with what is under way."""
        report = self._closed(self._connections.finish(now), live, now)
        self._take_answers(self._desk.drain(JobKind.LOOP), live, now)
        return self._link_believed(live, now) or report

    def join_rest(self, own: Collection[int], now: FrameStamp) -> None:
        """Join sets of submaps that are apart when the run is over, by all places that they share.

        `own`: the submaps of this run. Those of the largest set are not compared, but all others with them.
        """
        atlas = self._record.atlas
        if not (self._merges and self._is_enabled) or len(atlas.components()) < 2:
            return
        self.take_in(None)
        largest = max(atlas.components(), key=lambda ids: sum(len(atlas.submaps[m].keyframes) for m in ids))
        joins = SetJoins(self._record, self._parts, [m for m in own if m not in largest], now)
        while (found := joins.next()) is not None:
            link = self._link_of(found.match)
            report = self._connections.connect([link], now)
            self._linked(_Found(found.match, found.confirmations, kind=link.kind), report, None, now)

    def measure_again(self, refined: Collection[int]) -> None:
        """Measure the links of places again where a submap was refined since: the first time it was young."""
        atlas, verifier = self._record.atlas, self._parts.verifier
        for i, link in enumerate(atlas.links):
            if link.kind not in (LinkKind.LOOP, LinkKind.MERGE) or not (link.a in refined or link.b in refined):
                continue
            k_a, k_b = link.attached(atlas)
            a, b = atlas.submaps[link.a], atlas.submaps[link.b]
            match = verifier.verify((b, k_b), (a, k_a))
            if isinstance(match, Failure) or match.doubt is not None:
                continue
            if agree(atlas, replace(match, S_place_query=link.S_a_b), match):
                match = verifier.with_errors_of_poses(match, a, b)
                atlas.links[i] = replace(link, S_a_b=match.S_place_query, covariance=match.covariance)

    def _take_answers(self, answers: Iterable[Ended], live: VisualOdometry | None, now: FrameStamp) -> None:
        for ended in answers:
            search: PlaceSearch = ended.work
            self._record.timer.add("loop search", ended.cpu_s)
            if isinstance(ended.result, Failure) or live is None or live.submap.id != search.submap_id:
                continue  # it costs its search
            self._weigh(self._judged(search, ended.result, now), live.submap, now)

    def _judged(self, search: PlaceSearch, results: list[PlaceMatch | Failure], now: FrameStamp) -> PlaceMatch | None:
        """Return the verified place that a keyframe shows, where there is one and nothing contradicts it."""
        found: list[PlaceMatch] = []
        refused: tuple[int, int, Failure] | None = None
        for candidate, result in zip(search.candidates, results, strict=True):
            match = result
            if isinstance(match, PlaceMatch) and match.doubt is not None:
                match = match.doubt
            if not isinstance(match, Failure):
                then = poses_of(match, search.submaps)
                followed = None if then is None else follow_maps(match, then, self._record.atlas.submaps)
                if followed is None:
                    continue
                match = plausible(self._record, followed)
            if not isinstance(match, Failure):
                found.append(match)
            elif match.reason not in SILENT and refused is None:
                refused = candidate.submap_id, candidate.keyframe_id, match
        if not found:
            if refused is not None:  # the best of them: one event for a keyframe
                record_refusal(self._record, now, search.submap_id, *refused)
            return None
        best = max(found, key=lambda m: m.n_inliers)
        for other in found:
            if other is not best and contradict(self._record.atlas, best, other):
                detail = f"keyframes {best.place[1]} and {other.place[1]} show the place as well, elsewhere"
                why = Failure(FailureReason.AMBIGUOUS_MODEL, detail)
                record_refusal(self._record, now, search.submap_id, best.place[0], best.place[1], why)
                self._provisional = None
                return None
        return best

    def _may_be(self, submap: Submap, keyframe_id: int, among: Collection[int] | None) -> Callable[[int, int], bool]:
        """Return which keyframes would be a revisit: not those that are tracked, or were a moment ago."""
        seen_now = set(submap.covisible(submap.seen_in(keyframe_id))[0].tolist())
        arrived = sorted({k for m in self._record.atlas.submaps.values() for k in m.keyframes})
        at = arrived.index(keyframe_id)
        recent = {*arrived[max(at - RECENT, 0) : at + RECENT + 1], *seen_now} if among is None else set()
        joined = set(self._record.atlas.component_of(submap.id))
        rests = self._n_asked < self._rests_until

        def may_be(m: int, k: int) -> bool:
            if k in recent or (among is not None and m not in among) or (rests if m in joined else not self._merges):
                return False
            return m == submap.id or k not in submap.keyframes

        return may_be

    def _weigh(self, match: PlaceMatch | None, submap: Submap, now: FrameStamp) -> None:
        """Confirm the provisional place or replace it; believe it once enough keyframes agree."""
        waiting = self._provisional
        if waiting is not None and waiting.match.query[0] != submap.id:
            waiting = self._provisional = None
        if match is None:
            if waiting is not None:
                waiting.misses += 1
                if waiting.misses > MAX_TRIES:
                    detail = f"{waiting.confirmations} of {N_CONFIRMING} keyframes confirmed it"
                    why = Failure(FailureReason.UNCONFIRMED, detail)
                    record_refusal(self._record, now, submap.id, *waiting.match.place, why)
                    self._provisional = None
            return
        if waiting is None or not agree(self._record.atlas, waiting.match, match):
            self._provisional = _Found(match)
            return
        waiting.match = match
        waiting.confirmations += 1
        if waiting.confirmations < N_CONFIRMING:
            return
        self._provisional, self._believed = None, waiting
        waiting.then = poses_of(match, self._record.atlas.submaps)
        self._connections.foresee(self._link_of(match))

    def _link_believed(self, live: VisualOdometry | None, now: FrameStamp) -> AtlasReport | None:
        """Link the place that is believed, unless one of its keyframes, or the map that saw it, is no more."""
        believed, self._believed = self._believed, None
        if believed is None or live is None or live.submap.id != believed.match.query[0]:
            return None
        assert believed.then is not None, "it was followed to the submaps as they were"
        match = follow_maps(believed.match, believed.then, self._record.atlas.submaps)
        if match is None:
            return None
        link, believed.match = self._link_of(match), match
        believed.kind = link.kind
        report = self._connections.connect_later(link, now)
        if report is None:  # the atlas has to be solved with it first
            self._closing = believed
            return None
        return self._linked(believed, report, live, now)

    def _link_of(self, match: PlaceMatch) -> Link:
        (a, keyframe_a), (b, keyframe_b) = match.place, match.query
        together = any(a in component and b in component for component in self._record.atlas.components())
        kind = LinkKind.LOOP if together else LinkKind.MERGE
        return Link(a, b, match.S_place_query, match.covariance, kind, (), keyframe_a, keyframe_b, doubtful=False)

    def _linked(
        self, closing: _Found, report: AtlasReport, live: VisualOdometry | None, now: FrameStamp
    ) -> AtlasReport | None:
        """Record whether a link was accepted, and what follows."""
        atlas, match = self._record.atlas, closing.match
        (a, keyframe_a), (b, keyframe_b) = match.place, match.query
        self._rest_after(report)
        if not report:
            assert report.failure is not None
            record_refusal(self._record, now, b, a, keyframe_a, report.failure)
            return None
        if a == b:
            self._merge_duplicates(atlas.submaps[a], match)
            if live is not None and live.submap.id == a:
                live.adopt(live.graph, live.submap)  # its last frame holds ids that are no more
        self._record.event(
            EventKind.LOOP_CLOSED if closing.kind is LinkKind.LOOP else EventKind.MERGED,
            now,
            b,
            other_submap=a,
            other_frame=keyframe_a,
            keyframe=keyframe_b,
            confirmations=closing.confirmations,
            matches=match.n_matches,
            inliers=match.n_inliers,
            chi2_drift=report.newest_chi2,
            moved=max([*report.placed.values(), *report.bent.values()], default=0.0),
            **{name: value for name, value in match.numbers.items() if name not in ("n_matches", "n_inliers")},
        )
        return report

    def _rest_after(self, report: AtlasReport) -> None:
        """Set when the map is searched again: the later, the less it had drifted."""
        chi2 = report.newest_chi2
        as_claimed = chi2 is not None and chi2 < MEDIAN_CHI2[sim3.DOF]
        self._rest = min(2 * self._rest, MAX_REST) if as_claimed else REST
        self._rests_until = self._n_asked + self._rest

    def _merge_duplicates(self, submap: Submap, match: PlaceMatch) -> None:
        """Merge duplicate landmarks of the loop, so that the observations hold it too."""
        current = submap.current_ids(match.landmark_pairs.ravel()).reshape(-1, 2)
        current = current[(current >= 0).all(axis=1)]
        submap.merge_landmarks(current[:, 0], current[:, 1])
