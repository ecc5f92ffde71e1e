"""A map's claimed accuracy, keyframe by keyframe: the columns ``sigma_*`` of ``frames.csv``.

Both are read from the map as it is at the end of a run, whichever way a keyframe came into it: tracked, in reverse too,
or posed again later. A frame claims what the keyframe does that it hangs on.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.core.geometry import se3
from dualslam.core.noise_model import GATE_SIGMAS, GROUP, MIN_DEPTH_MU, STRETCH_S, UNSURE_SCALE
from dualslam.core.types import FloatArray, IntArray
from dualslam.linking.scale_observability import relative_scales
from dualslam.map.landmark_views import landmark_covariances, noise_excess, resection_covariance
from dualslam.map.submap import Submap

POSITION_INFLATION = 1.1
"""As `SCALE_INFLATION` (`linking/scale_observability.py`), for positions."""
NEAR = 2
"""Keyframes before and after by whose residuals, too, a position is judged: it is one against what they hold. The first
after a blurred stretch see sharply what the blurred ones have placed."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A map's claims about one keyframe; NaN if unknown."""

    sigma_position_rel: float
    """Standard deviation of the position against what the keyframe sees, over the median depth of that."""
    sigma_scale: float
    """Standard deviation of the logarithm of the size of the path about the keyframe, against that of the best-tied
    stretch: by how much it may be too large or too small. Infinite where nothing ties it to that one."""


Claims = dict[int, dict[int, Claim]]
"""By submap and keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What a submap knows of its keyframes, and of the scales about them and at its links against each other."""

    sigma_position_rel: dict[int, float]  # by keyframe
    between: FloatArray  # (S + P, S + P): of `relative_scales`: of the stretches about keyframes, then of links' places
    share: FloatArray
    """(S,): of the size of each stretch in the shortest one that can be measured."""
    place_of: dict[int, int]  # of each link its row in `between`

    @property
    def best_tied(self) -> int:
        """The stretch that the others are tied to best, in the median: its row."""
        n = len(self.share)
        return int(np.argmin(np.median(self.between[:n, :n], axis=1)))

    def claims(self, row: int, variance: float) -> dict[int, Claim]:
        """Return the claims by keyframe, with their scales against a stretch or place that is known with a variance."""
        sigmas = self.share * np.sqrt(self.between[: len(self.share), row] ** 2 + variance)
        known = map(Claim, self.sigma_position_rel.values(), sigmas.tolist())
        return dict(zip(self.sigma_position_rel, known, strict=True))


def claims_in_atlas(atlas: Atlas) -> Claims:
    """Return the claims of all submaps, which takes seconds."""
    return {m: own for linked in atlas.components() for m, own in _claims_in(atlas, linked).items()}


def _claims_in(atlas: Atlas, linked: Collection[int]) -> Claims:
    """Return the claims of submaps that are linked, with their scales against the best-tied stretch of them all.

    It is in the largest submap. Along the best links to it, variances add: of each link, and between the links' places.
    """
    links = dict(enumerate(link for link in atlas.believed if link.a != link.b and link.a in linked))
    known = {m: _ask(atlas, atlas.submaps[m], links) for m in linked}
    largest = max(linked, key=lambda m: len(atlas.submaps[m].keyframes))
    return {m: known[m].claims(*seen) for m, seen in _seen_from(largest, known, links).items()}


def _seen_from(largest: int, known: Mapping[int, _Known], links: Mapping[int, Link]) -> dict[int, tuple[int, float]]:
    """Return for each submap the row of the stretch or place by which its scale is known, and the variance of that."""
    seen = {largest: (known[largest].best_tied, 0.0)}
    while len(seen) < len(known):
        ways = []
        for n, link in links.items():
            for a, b in ((link.a, link.b), (link.b, link.a)):
                if a in seen and b not in seen:
                    row, variance = seen[a]
                    lost = float(known[a].between[row, known[a].place_of[n]])
                    ways.append((variance + lost**2 + link.sigma_scale**2, b, known[b].place_of[n]))
        variance, m, row = min(ways)
        seen[m] = row, variance
    return seen


def _place(atlas: Atlas, link: Link, submap: Submap) -> IntArray:
    """Return a submap's keyframes by which a link was measured: those that both have, or those about its place."""
    shared = [k for k in link.keyframes if k in submap.keyframes]
    at = link.attached(atlas)[link.b == submap.id]
    return np.array(sorted(shared or submap.keyframes_near(at)[:GROUP]), np.int64)


def _ask(atlas: Atlas, submap: Submap, links: Mapping[int, Link]) -> _Known:
    """Ask a submap what it knows; of its scales nothing is known where it is short."""
    places = {n: _place(atlas, link, submap) for n, link in links.items() if submap.id in (link.a, link.b)}
    excess, ids = noise_excess(submap), sorted(submap.keyframes)
    covariances = landmark_covariances(submap, np.arange(len(submap.landmarks)))
    usual = {k: _position_sigma(submap, k, covariances) for k in ids}
    near = {k: max(excess[other] for other in ids[max(n - NEAR, 0) : n + NEAR + 1]) for n, k in enumerate(ids)}
    positions = {k: near[k] * sigma for k, sigma in usual.items()}
    place_of, n_parts = {n: len(ids) + row for row, n in enumerate(places)}, len(ids) + len(places)
    if len(ids) <= GROUP or not submap.landmarks["alive"].any():
        return _Known(positions, np.zeros((n_parts, n_parts)), np.full(len(ids), np.nan), place_of)
    stretches = list(stretches_of(submap).values())
    size_mu = np.array([np.linalg.norm(submap.keyframe_poses(s)[:, :3, 3].std(axis=0)) for s in stretches])
    depth_mu = [np.median(submap.depths_in(k)) if len(submap.seen_in(k)) else 0.0 for k in ids]
    measurable_mu = GATE_SIGMAS / UNSURE_SCALE * np.nanmedian(list(usual.values())) * np.maximum(depth_mu, MIN_DEPTH_MU)
    between = relative_scales(submap, stretches, list(places.values()), excess)
    return _Known(positions, between, np.minimum(size_mu / measurable_mu, 1.0), place_of)


def _position_sigma(submap: Submap, keyframe_id: int, covariances: FloatArray) -> float:
    """Resect the keyframe from its landmarks, each as uncertain as its views leave it: `covariances` of all."""
    feature = np.flatnonzero(submap.landmark_of[keyframe_id] >= 0)
    ids = submap.landmark_of[keyframe_id][feature]
    T_cam_submap = se3.inverse(submap.T_submap_kf[keyframe_id])
    sigma = submap.keyframes[keyframe_id].features.sigma_px[feature]
    covariance = resection_covariance(submap, ids, sigma, T_cam_submap, covariances[ids])
    if covariance is None:
        return float("nan")
    depth = submap.depths(ids, T_cam_submap)
    variance = float(np.trace(covariance[3:, 3:]))
    return POSITION_INFLATION * float(np.sqrt(max(variance, 0.0)) / np.median(depth[depth > 0]))


def stretches_of(submap: Submap) -> dict[int, IntArray]:
    """Return the keyframes of the stretch about each keyframe, by whose size its scale is judged: `GROUP` at least."""
    ids = np.array(sorted(submap.keyframes), np.int64)
    times_s = np.array([submap.keyframes[k].timestamp_s for k in ids.tolist()])
    near = np.abs(np.subtract.outer(times_s, times_s)) <= STRETCH_S / 2.0
    near |= np.abs(np.subtract.outer(np.arange(len(ids)), np.arange(len(ids)))) <= GROUP // 2
    return {k: ids[row] for k, row in zip(ids.tolist(), near, strict=True)}
