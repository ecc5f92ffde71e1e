"""Verification of a place by pixels: what both sides match, what should be seen and is not, what else would fit.

The recogniser's candidate and the query keyframe each bring the keyframes that see the same landmarks. The steps:

1. Wide matching between the two groups pairs landmarks.
2. RANSAC and refinement give a similarity of these 3D-3D pairs.
3. A guided search looks for everything that either side should show in the other's images. Misses count, too.
4. All pairs give the similarity again, with its covariance. The gates test keyframes on either side, their spread over
   the image, and sigmas.
5. A second similarity must not fit as well.

What the maps say of their own drift is not considered: it can neither refute what the pixels prove, nor prove what they
do not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.alignment import Sim3Estimate, estimate_sim3_robust, sensitivity
from dualslam.core.interfaces import Frontend
from dualslam.core.matchers import Look, Sighting
from dualslam.core.noise_model import MAJORITY, MIN_CONSENSUS, PROOF_VIEWS
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, IntArray
from dualslam.linking.join_test import (
    MAX_HYPOTHESES,
    MAX_SCALE,
    MIN_IMAGE_SPREAD,
    MIN_PAIRS_PER_KEYFRAME,
    PAIR_CHI2,
    JoinGate,
    LinkEvidence,
    ambiguity_gate,
    similarity_gates,
    support_gate,
)
from dualslam.linking.scale_observability import spread_by_poses
from dualslam.map.landmark_views import landmark_covariances, noise_excess
from dualslam.map.submap import Submap
from dualslam.places.sides import (
    Looks,
    Pairs,
    SecondSimilarity,
    Side,
    alike,
    find_second_pose,
    image_spread,
    keyframes_seeing,
    one_to_one,
    seen_as,
    side_of,
    sigmas_at_pairs,
)

N_MATCHED = 3
"""Of a side's keyframes, how many are matched with all of the other side's: matching is quadratic."""
SEARCH_RADIUS_PX = 8.0
"""About where a landmark should be under a similarity of some tens of pairs: its error, and the maps' own drift."""
NEAR_FIRST = 4.0
"""Pairs within twice the gate's distance of the first similarity are its own, not evidence of another: a thing that was
mapped twice lies a little beside itself."""
MIN_FOUND = 0.3
"""Share of the expected landmarks that must be found, in the middle part of the image. It is relative to the share that
the place's own keyframes show. Images that show something else come to 0.01 to 0.04 (25 pairs each of `kitti_03` and
`hololens_000`); the same place from elsewhere to 0.4 and more."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMatch:
    """Two places that are one, as the pixels say."""

    # Submap and keyframe on either side.
    place: tuple[int, int]
    query: tuple[int, int]
    S_place_query: FloatArray  # (4, 4): ``p_place = S_place_query @ p_query``, in the submaps' frames
    covariance: FloatArray  # (7, 7): of ``S_place_query @ exp(xi)``, in the query's frame and unit
    landmark_pairs: IntArray  # (I, 2): landmarks of the place and of the query that are one
    # Those that see the agreeing landmarks.
    keyframes_place: tuple[int, ...]
    keyframes_query: tuple[int, ...]
    n_matches: int
    n_inliers: int
    numbers: dict[str, float] = field(default_factory=dict)
    doubt: Failure | None = None  # why scale or position may not be relied on; None where they may


class PlaceVerifier:
    """Verifies candidates.

    - `config`: the gates of links: those of places are the same.
    - `seed`: the random choices depend on it and on the two keyframes alone, not on what was asked before.
    """

    def __init__(self, frontend: Frontend, look: Look, config: LinkingConfig, seed: int) -> None:
        self._frontend, self._look_for = frontend, look
        self._config = config
        self._seed = seed

    def verify(self, query: tuple[Submap, int], place: tuple[Submap, int]) -> PlaceMatch | Failure:
        """Ask whether two keyframes, each with its submap (which may be one), show one place."""
        rng = np.random.default_rng([self._seed, query[1], place[0].id, place[1]])
        sides = self._sides(query, place)
        if isinstance(sides, Failure):
            return sides
        place_side, query_side = sides
        proposed = self._match(place_side, query_side)
        if isinstance(proposed, Failure):
            return proposed
        first = self._estimate(proposed, rng)
        if isinstance(first, Failure):
            return first
        searched = self._search(place_side, query_side, first.S_dst_src)
        pairs = self._place_pairs(
            place_side.submap, query_side.submap, *one_to_one([*searched.pairs, (proposed.place, proposed.query)])
        )
        estimate = self._estimate(pairs, rng)
        if isinstance(estimate, Failure):
            return estimate
        looks = self._search(place_side, query_side, estimate.S_dst_src)
        return self._judge(place_side, query_side, pairs, estimate, looks, rng)

    def check_pose(
        self, submap: Submap, keyframe_id: int, T_cam_submap: FloatArray, features: Features
    ) -> Failure | None:
        """Refuse a frame's pose where the image does not show what the place, seen from there, should show.

        - `T_cam_submap` (4, 4).
        - `keyframe_id`: by which the place was recognised.
        - `features`: of the frame.
        """
        place = side_of(submap, keyframe_id)
        look = self._look_for(submap, place.landmarks, T_cam_submap, submap.K, features, SEARCH_RADIUS_PX)
        own = self._own_found(place)
        numbers = {"own_found": own, "n_visible": float(len(look.feature))}
        return LinkEvidence.of([_found_gate(look.share, own)]).refusal(numbers)

    def with_errors_of_poses(self, match: PlaceMatch, place: Submap, query: Submap) -> PlaceMatch:
        """Return a match of two submaps with what the poses of their keyframes add to its covariance."""
        pairs = self._place_pairs(place, query, *match.landmark_pairs.T)
        by_place = sensitivity(match.S_place_query, pairs.xyz_query, pairs.xyz_place, pairs.cov_query, pairs.cov_place)
        covariance = match.covariance
        for submap, keyframes, ids, by_point in (
            (place, match.keyframes_place, pairs.place, by_place),
            (query, match.keyframes_query, pairs.query, -by_place @ match.S_place_query[:3, :3]),
        ):
            covariance = covariance + spread_by_poses(submap, np.array(keyframes), ids, by_point, noise_excess(submap))
        return replace(match, covariance=covariance)

    # --- steps

    def _sides(self, query: tuple[Submap, int], place: tuple[Submap, int]) -> tuple[Side, Side] | Failure:
        query_side, place_side = side_of(*query), side_of(*place)
        if query[0] is place[0] and set(query_side.keyframes) & set(place_side.keyframes):
            return Failure(FailureReason.DEGENERATE, "the two places see the same landmarks already")
        n = min(len(query_side.keyframes), len(place_side.keyframes))
        if n < PROOF_VIEWS:
            detail = f"{n} keyframes about a place, {PROOF_VIEWS} needed on either side"
            return Failure(FailureReason.AGREEMENT, detail, {"n_keyframes": float(n)})
        return place_side, query_side

    def _match(self, place: Side, query: Side) -> Pairs | Failure:
        """Match keyframes of the one side with those of the other, without a guide."""
        votes: list[tuple[IntArray, IntArray]] = []
        most = 0
        for n, q in enumerate(query.keyframes[:N_MATCHED]):
            for k in place.keyframes:
                votes.append(self._match_keyframes(place.submap, k, query.submap, q))
                most = max(most, len(votes[-1][0]))
                if 2 * most < MIN_CONSENSUS:
                    break  # what the place itself hardly shares, its neighbours do not either
            if n == 0 and most < MIN_CONSENSUS:
                detail = f"{most} matches with the place, {MIN_CONSENSUS} needed"
                return Failure(FailureReason.TOO_FEW_MATCHES, detail, {"n_matches": float(most)})
        return self._place_pairs(place.submap, query.submap, *one_to_one(votes))

    def _match_keyframes(self, place: Submap, k: int, query: Submap, q: int) -> tuple[IntArray, IntArray]:
        a, b = np.flatnonzero(place.landmark_of[k] >= 0), np.flatnonzero(query.landmark_of[q] >= 0)
        if not len(a) or not len(b):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        found = self._frontend.match_wide(place.keyframes[k].features.take(a), query.keyframes[q].features.take(b))
        return place.landmark_of[k][a[found.index[:, 0]]], query.landmark_of[q][b[found.index[:, 1]]]

    def _place_pairs(self, place: Submap, query: Submap, in_place: IntArray, in_query: IntArray) -> Pairs:
        """Look up where the landmarks of pairs are; those that their views do not fix are left out."""
        (xyz_place, cov_place), (xyz_query, cov_query) = self._points(place, in_place), self._points(query, in_query)
        return Pairs(in_place, in_query, xyz_place, xyz_query, cov_place, cov_query).fixed()

    def _points(self, submap: Submap, ids: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return where landmarks are, and their covariances by their views and the deformation of maps."""
        xyz, half = submap.landmarks["xyz_mu"][ids], self._config.deformation_sigma**2 / 2
        spread2 = ((xyz - np.median(xyz, axis=0)) ** 2).sum(1) if len(ids) else np.zeros(0)
        return xyz, landmark_covariances(submap, ids) + half * spread2[:, None, None] * so3.IDENTITY

    def _estimate(self, pairs: Pairs, rng: Generator) -> Sim3Estimate | Failure:
        config = self._config
        return estimate_sim3_robust(
            pairs.xyz_query,
            pairs.xyz_place,
            pairs.cov_query,
            pairs.cov_place,
            rng,
            min_inliers=config.min_inliers,
            max_hypotheses=MAX_HYPOTHESES,
            chi2_gate=PAIR_CHI2,
            scale_bounds=(1.0 / MAX_SCALE, MAX_SCALE),
        )

    def _search(self, place: Side, query: Side, S_place_query: FloatArray) -> Looks:
        """Look for what each side should show in the images of the other."""
        S_query_place = sim3.inverse(S_place_query)
        in_query = [self._look(place, query.submap, q, S_place_query) for q in query.keyframes]
        in_place = [self._look(query, place.submap, k, S_query_place) for k in place.keyframes]
        pairs = [seen_as(look, query.submap.landmark_of[q]) for look, q in zip(in_query, query.keyframes, strict=True)]
        for look, k in zip(in_place, place.keyframes, strict=True):
            theirs, ours = seen_as(look, place.submap.landmark_of[k])
            pairs.append((ours, theirs))
        return Looks(in_query, pairs)

    def _own_found(self, place: Side) -> float:
        """Share of what a place should show that its own images show, where it is as much as can be had: the middle."""
        return float(np.median([self._look(place, place.submap, k, se3.IDENTITY).share for k in place.keyframes]))

    def _look(self, seen: Side, looking: Submap, keyframe_id: int, S_seen_looking: FloatArray) -> Sighting:
        T_seen_cam = sim3.act_on_pose(S_seen_looking, looking.T_submap_kf[keyframe_id])
        features = looking.keyframes[keyframe_id].features
        return self._look_for(
            seen.submap, seen.landmarks, se3.inverse(T_seen_cam), looking.K, features, SEARCH_RADIUS_PX
        )

    def _judge(
        self, place: Side, query: Side, pairs: Pairs, estimate: Sim3Estimate, looks: Looks, rng: Generator
    ) -> PlaceMatch | Failure:
        S, inliers = estimate.S_dst_src, estimate.inliers
        n = int(inliers.sum())
        found, own = looks.found, self._own_found(place)
        sigmas = sigmas_at_pairs(pairs.xyz_query[inliers], S, estimate.covariance, place)
        keyframes_place = keyframes_seeing(place, pairs.place[inliers], MIN_PAIRS_PER_KEYFRAME)
        keyframes_query = keyframes_seeing(query, pairs.query[inliers], MIN_PAIRS_PER_KEYFRAME)
        spread = min(
            image_spread(place.submap, keyframes_place, pairs.place[inliers]),
            image_spread(query.submap, keyframes_query, pairs.query[inliers]),
        )
        numbers = {
            "n_matches": float(len(pairs.place)),
            "n_inliers": float(n),
            "inlier_ratio": n / len(inliers),
            "found": found,
            "own_found": own,
            "n_keyframes_place": float(len(keyframes_place)),
            "n_keyframes_query": float(len(keyframes_query)),
            "spread": spread,
            "scale": float(sim3.scale(S)),
            **sigmas,
        }
        share = n / len(inliers)
        known = sigmas["sigma_scale"], sigmas["sigma_rot_deg"], sigmas["sigma_trans_rel"]
        agree = f"{n} of {len(inliers)} pairs agree"
        covered = f"{spread:.0%} of the image is covered"
        gates = [
            JoinGate.at_least("inlier_ratio", share, MAJORITY, FailureReason.LOW_INLIER_RATIO, agree),
            support_gate(min(len(keyframes_place), len(keyframes_query)), PROOF_VIEWS),
            _found_gate(found, own),
            JoinGate.at_least("spread", spread, MIN_IMAGE_SPREAD, FailureReason.SPREAD, covered),
            *similarity_gates(*known, self._config),
        ]
        judged = LinkEvidence.of(gates)
        refused = judged.refusal(numbers)
        if refused is not None:
            return refused
        second = self._second_pose(place, query, S, rng)
        if second is not None:
            evidence = LinkEvidence((ambiguity_gate(second.support, second.first_support),))
            numbers |= evidence.numbers
            refused = evidence.refusal(numbers)
            if refused is not None:
                return refused
        landmark_pairs = np.stack([pairs.place[inliers], pairs.query[inliers]], 1)
        return PlaceMatch(
            place.id,
            query.id,
            S,
            estimate.covariance,
            landmark_pairs,
            keyframes_place,
            keyframes_query,
            len(inliers),
            n,
            numbers,
            judged.doubt(numbers),
        )

    def _second_pose(self, place: Side, query: Side, S: FloatArray, rng: Generator) -> SecondSimilarity | None:
        """Look for another similarity among all similar landmarks, in the place and in the query keyframe."""
        asked = np.unique(query.submap.seen_in(query.keyframes[0]))
        theirs, ours = query.submap.landmarks["descriptor"], place.submap.landmarks["descriptor"]
        i, j = alike(theirs[asked], ours[place.landmarks], self._frontend)
        xyz_query, cov_query = self._points(query.submap, asked)
        xyz_place, cov_place = self._points(place.submap, place.landmarks)
        all_pairs = Pairs(place.landmarks[j], asked[i], xyz_place[j], xyz_query[i], cov_place[j], cov_query[i]).fixed()
        return find_second_pose(
            all_pairs.xyz_query,
            all_pairs.xyz_place,
            all_pairs.cov_query,
            all_pairs.cov_place,
            all_pairs.query,
            S,
            all_pairs.mahalanobis2(S) < NEAR_FIRST * PAIR_CHI2,
            rng,
            min_support=self._config.min_inliers,
            chi2_gate=PAIR_CHI2,
            max_hypotheses=MAX_HYPOTHESES,
        )


def _found_gate(found: float, own: float) -> JoinGate:
    """Return the gate of the share of a place's landmarks that an image shows, against the place's own images."""
    detail = f"{found:.0%} of what the place should show is there, {own:.0%} in its own keyframes"
    return JoinGate.at_least("found", found, MIN_FOUND * own, FailureReason.REPROJECTION, detail)
