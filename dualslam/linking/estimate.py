"""From two submaps that saw the same frames to a verified similarity between them, or to the reason why there is none.

Source: Huang et al., "Dual-SLAM", section II (Map Fusion): ``X' = s R X + T`` by RANSAC with Horn's algorithm over
3D-3D matches restricted to equal keyframes. The consensus along time, the reprojections and the gates are ours.

The refinement weighs the pairs by their points' covariances, which are the pixels of both maps, propagated. The
reprojections both ways are the same pixels again: they judge the result, per keyframe and over all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.decisions import Gate
from dualslam.core.geometry import sim3
from dualslam.core.geometry.alignment import Sim3Estimate, estimate_sim3_robust
from dualslam.core.noise_model import MAJORITY
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray
from dualslam.linking import verify
from dualslam.linking.correspondences import (
    Correspondences,
    DescriptorMatcher,
    MatchedLandmarks,
    match_landmarks,
    place_pairs,
)
from dualslam.linking.join_test import (
    LOOK_BACK,
    MAX_HYPOTHESES,
    MAX_MISFITS,
    MAX_SCALE,
    MIN_PAIRS_PER_KEYFRAME,
    MINORITY_DEFORMATION,
    PAIR_CHI2,
)
from dualslam.linking.pairs import PairModel
from dualslam.linking.timeline import (
    KeyframeVotes,
    ask_keyframes,
    deformation_covariance,
    find_discontinuities,
    leading_run,
    measure_deformation,
    smallest_share_handed_on,
)
from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True, eq=False)
class LinkEstimate:
    """A link between two submaps, with what supports it.

    Attributes
    ----------
    S_old_new : (4, 4)
        ``p_old = S_old_new @ p_new``.
    covariance : (7, 7)
        Of xi in ``S_old_new @ exp(xi)``: rotation (rad), translation (unit of new), log-scale, in the new map's frame.
        The Hessian's, inflated, and the share of the maps' own deformation that no number of pairs averages out.
    n_matches, n_inliers : int
        Pairs that the estimate looked at (seen in the keyframes that it trusts), and those that agree.
    landmark_pairs : (I, 2) int64
        Ids of all agreeing landmarks, old and new: duplicates to be merged.
    agreeing_keyframes : (A,) int64
        Ids of the shared keyframes that the link stands on, ascending.
    change_point : int or None
        First shared keyframe at which the old map no longer fits the link: from there on it is to be by-passed.
    suspected_onset : int or None
        The onset that was told or found (the older), from which on no keyframe was trusted.
    sigma_scale : float
        Relative sigma of the scale: at the overlap, or at the live end once it is propagated there.
    numbers : dict
        For the event log.
    gates : tuple of Gate
        The comparisons that it has passed, for ``decisions.jsonl``.
    """

    S_old_new: FloatArray
    covariance: FloatArray
    n_matches: int
    n_inliers: int
    landmark_pairs: IntArray
    agreeing_keyframes: IntArray
    change_point: int | None
    suspected_onset: int | None
    sigma_scale: float
    numbers: dict[str, float]
    gates: tuple[Gate, ...] = ()


@dataclass(frozen=True, slots=True)
class LinkRefusal(Failure):
    """A link that is not made, or not yet. `Failure.numbers` are for the event log alone.

    Attributes
    ----------
    torn_at : int or None
        The keyframe before which the new map is torn.
    walk_sigma : float
        Relative sigma of the scale that reverse tracking has handed on; 0 where another gate came first.
    unsure : LinkEstimate or None
        The link that may be made with a doubt, where nothing but its scale is too loose.
    """

    torn_at: int | None = None
    walk_sigma: float = 0.0
    unsure: LinkEstimate | None = None


def estimate_link(
    old: Submap,
    new: Submap,
    config: LinkingConfig,
    rng: Generator,
    suspected_onset: int | None = None,
    matcher: DescriptorMatcher | None = None,
) -> LinkEstimate | Failure:
    """Estimate the similarity between two submaps that share keyframes, and verify it.

    Parameters
    ----------
    old : Submap
        The archived map; its newest part may be corrupted.
    new : Submap
        The map that was extended backwards in time over the same frames.
    config : LinkingConfig
    rng : numpy.random.Generator
        The only source of randomness.
    suspected_onset : int, optional
        Frame from which on the old map may be corrupted.
    matcher : DescriptorMatcher, optional
        How descriptors are compared; without it landmarks are matched by identity alone.

    Returns
    -------
    LinkEstimate or Failure
        `NEEDS_OLDER_KEYFRAMES` where the overlap does not reach far enough into the healthy part of the old map to
        decide: walk on. All other reasons are refusals of this overlap.
    """
    # 1. Which landmarks are the same.
    matched = match_landmarks(old, new, matcher)
    pairs = place_pairs(old, new, matched, None)
    if len(pairs) < config.min_inliers:
        return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(pairs)} pairs, {config.min_inliers} needed")
    # 2. Which keyframes may be trusted: those older than what is suspected, by others or by a discontinuity in the old
    #    map. The new map must be one piece there (but for its newest keyframe, the oldest, which may hang by
    #    little yet).
    discontinuities_old = find_discontinuities(old, _look_back(old, int(pairs.keyframes[0])), max(old.keyframes))
    discontinuities_new = find_discontinuities(new, int(pairs.keyframes[0]), int(pairs.keyframes[-1]))
    onset = min([*discontinuities_old.tolist(), *([] if suspected_onset is None else [suspected_onset])], default=None)
    trusted = pairs.count_by_keyframe(np.ones(len(pairs.view_pair), bool)) >= MIN_PAIRS_PER_KEYFRAME
    if onset is not None:
        trusted &= pairs.keyframes < onset
    if len(discontinuities_new):
        trusted &= pairs.keyframes >= discontinuities_new[-1]
        if np.count_nonzero(np.array(list(new.keyframes)) < discontinuities_new[-1]) > 1:
            detail = "the new map is torn among its older keyframes"
            torn_at = int(discontinuities_new[-1])
            numbers = {"torn": float(torn_at)}
            return LinkRefusal(FailureReason.DEFORMED, detail, numbers, torn_at, walk_sigma=np.inf)
    if np.count_nonzero(trusted) < config.min_keyframes:
        return _needs_older(int(np.count_nonzero(trusted)), config, onset)
    # 3. What they agree on.
    return _link_over(old, new, matched, pairs, pairs.keyframes[trusted], onset, config, rng)


def _link_over(
    old: Submap,
    new: Submap,
    matched: MatchedLandmarks,
    all_pairs: Correspondences,
    trusted: IntArray,
    onset: int | None,
    config: LinkingConfig,
    rng: Generator,
) -> LinkEstimate | Failure:
    """Estimate the link on the trusted keyframes (ids), and pass it through the gates.

    - `all_pairs`: placed by all of the old map.
    - `onset`: keyframes from there on are not trusted.
    """
    # The similarity on which the oldest of them agree, and how far it holds. What lies beyond has moved landmarks of
    # the healthy part too: place those anew without it, and ask again.
    limit = onset
    while True:
        pairs = all_pairs if limit is None else place_pairs(old, new, matched, limit)
        model = PairModel(pairs, old, new, config.deformation_sigma)
        can_vote = pairs.count_by_keyframe(np.ones(len(pairs.view_pair), bool)) >= MIN_PAIRS_PER_KEYFRAME
        consensus = _oldest_consensus(model, can_vote & np.isin(pairs.keyframes, trusted), config, rng, limit)
        if isinstance(consensus, Failure):
            return consensus
        if consensus.change is None:
            break
        limit, trusted = consensus.change, trusted[trusted < consensus.change]
    # Newer keyframes that nothing speaks against, and that part with it all the same: enough of them for another link.
    whole = PairModel(all_pairs, old, new, config.deformation_sigma)
    later = ask_keyframes(whole, consensus.estimate.S_dst_src, config)
    agreeing = pairs.keyframes[consensus.keyframes]
    newer = later.can_vote & (all_pairs.keyframes > agreeing[-1])
    parted = all_pairs.keyframes[newer & ~later.agrees & (all_pairs.keyframes < (np.inf if onset is None else onset))]
    if len(parted) >= config.min_keyframes:
        evidence = verify.judge_parting(whole, consensus.estimate.S_dst_src, old, new, agreeing, parted)
        refused = evidence.refusal({"change_point": float(parted[0])})
        if refused is not None:
            return refused
    # How far the maps are bent against each other beyond it: that is part of what is not known.
    S_old_new = consensus.estimate.S_dst_src
    deformation = measure_deformation(model, S_old_new, consensus.inliers, consensus.keyframes, config)
    # The walk has crossed the images of the newer keyframes, too.
    newest = max(old.keyframes) if limit is None else limit - 1
    share = smallest_share_handed_on(old, _look_back(old, int(agreeing[0])), newest)
    if share < MAJORITY:
        deformation = math.hypot(deformation, MINORITY_DEFORMATION)
    covariance = consensus.estimate.covariance + deformation_covariance(model, deformation)
    # The gates.
    sigmas = verify.sigma_numbers(model, S_old_new, covariance) | {"handed_on": share}
    evidence = verify.judge_overlap(sigmas, len(agreeing), config)
    refused = evidence.refusal(sigmas)
    if refused is not None:
        return refused
    link = _link(model, whole, later, consensus, covariance, sigmas, deformation, onset, limit)
    link = replace(link, gates=evidence.comparisons)
    doubt = evidence.doubt(sigmas)
    if doubt is None:
        return link
    return LinkRefusal(doubt.reason, doubt.detail, doubt.numbers, unsure=link, gates=doubt.gates)


@dataclass(frozen=True, slots=True, eq=False)
class _Consensus:
    """A similarity with the keyframes (K,) and pairs (M,) that it stands on."""

    estimate: Sim3Estimate
    votes: KeyframeVotes
    keyframes: BoolArray
    seen: BoolArray  # the pairs that it was asked of
    inliers: BoolArray
    change: int | None  # the first trusted keyframe that had to be left out

    @property
    def inlier_ratio(self) -> float:
        """Share of the pairs asked that agree."""
        return float(self.inliers.sum() / self.seen.sum())


def _look_back(old: Submap, keyframe_id: int) -> int:
    """Return the id of the keyframe that stands `LOOK_BACK` before one of the old map's."""
    ids = sorted(old.keyframes)
    return ids[max(ids.index(keyframe_id) - LOOK_BACK, 0)]


def _needs_older(n: int, config: LinkingConfig, onset: int | None, change: int | None = None) -> Failure:
    """Make the refusal that asks for more keyframes."""
    before = "" if onset is None else " older than the suspected onset"
    broken = "" if change is None else ", another similarity fits the newer ones"
    numbers = {"n_keyframes": float(n)}
    numbers |= {} if onset is None else {"onset": float(onset)}
    numbers |= {} if change is None else {"change_point": float(change)}
    detail = f"{n} keyframes{before} agree, {config.min_keyframes} needed{broken}"
    return Failure(FailureReason.NEEDS_OLDER_KEYFRAMES, detail, numbers)


def _oldest_consensus(
    model: PairModel, trusted: BoolArray, config: LinkingConfig, rng: Generator, onset: int | None
) -> _Consensus | Failure:
    """Find the similarity of the oldest trusted keyframes: where two fit, the older one holds.

    While some of the keyframes disagree, it is estimated again on fewer, always with the oldest among them.
    """
    ids = model.pairs.keyframes
    rows = np.flatnonzero(trusted)
    change: int | None = None
    failure: Failure | None = None
    while len(rows) >= config.min_keyframes:
        chosen = np.zeros(len(ids), bool)
        chosen[rows] = True
        seen = model.pairs.pairs_seen_in(chosen)
        estimate = _fit(model, seen, config, rng)
        if isinstance(estimate, Failure):
            failure = estimate if failure is None else failure
            change, rows = int(ids[rows[len(rows) // 2]]), rows[: len(rows) // 2]
            continue
        votes = ask_keyframes(model, estimate.S_dst_src, config)
        agrees = votes.agrees[rows]
        n_run = leading_run(agrees, MAX_MISFITS)
        if n_run == len(rows):
            return _Consensus(estimate, votes, chosen & votes.agrees, seen, estimate.inliers, change)
        if n_run > 0:  # it holds for the oldest: keep those
            change, rows = int(ids[rows[n_run]]), rows[:n_run]
        elif agrees.any():  # it is that of newer keyframes: look before them
            first = int(np.argmax(agrees))
            change, rows = int(ids[rows[first]]), rows[:first]
        else:
            failure = Failure(FailureReason.AGREEMENT, f"none of {len(rows)} keyframes agrees with the similarity")
            change, rows = int(ids[rows[len(rows) // 2]]), rows[: len(rows) // 2]
    if failure is not None:
        return failure
    return _needs_older(len(rows), config, onset, change)


def _fit(model: PairModel, used: BoolArray, config: LinkingConfig, rng: Generator) -> Sim3Estimate | Failure:
    """Estimate the similarity from the used pairs; `inliers` of the result are rows of all pairs."""
    c, rows = model.pairs, np.flatnonzero(used)
    estimate = estimate_sim3_robust(
        c.xyz_new[rows],
        c.xyz_old[rows],
        model.covariance_new[rows],
        model.covariance_old[rows],
        rng,
        min_inliers=config.min_inliers,
        max_hypotheses=MAX_HYPOTHESES,
        chi2_gate=PAIR_CHI2,
        scale_bounds=(1.0 / MAX_SCALE, MAX_SCALE),
    )
    if isinstance(estimate, Failure):
        return estimate
    inliers = np.zeros(len(c), bool)
    inliers[rows[estimate.inliers]] = True
    return Sim3Estimate(estimate.S_dst_src, estimate.covariance, inliers, estimate.n_iterations, estimate.chi2_per_dof)


def _link(
    model: PairModel,
    whole: PairModel,
    later: KeyframeVotes,
    consensus: _Consensus,
    covariance: FloatArray,
    sigmas: dict[str, float],
    deformation: float,
    onset: int | None,
    limit: int | None,
) -> LinkEstimate:
    """Pack a verified consensus. `later`: how all keyframes agree with it, on all pairs as the maps hold them."""
    c, estimate, votes = model.pairs, consensus.estimate, consensus.votes
    S = estimate.S_dst_src
    every = whole.pairs
    after = np.flatnonzero(later.can_vote & (every.keyframes > c.keyframes[consensus.keyframes][-1]))
    misfits = np.flatnonzero(~later.agrees[after])
    change_point = int(every.keyframes[after[misfits[0]]]) if len(misfits) else None
    if limit is not None and limit != onset:
        change_point = limit if change_point is None else min(limit, change_point)
    holds = np.isin(every.keyframes, c.keyframes[consensus.keyframes])
    holds |= later.agrees & (every.keyframes < (np.inf if change_point is None else change_point))
    same = (whole.mahalanobis2(S) < PAIR_CHI2) & every.pairs_seen_in(holds)
    on = consensus.keyframes
    numbers = {
        "scale": float(sim3.scale(S)),
        **sigmas,
        "chi2": estimate.chi2_per_dof,
        "n_pairs": float(len(every)),
        "n_shared_pixel": float(every.shared_pixel.sum()),
        "n_hypotheses": float(estimate.n_iterations),
        "n_shared_keyframes": float(len(every.keyframes)),
        "n_agreeing_keyframes": float(on.sum()),
        "keyframe_rotation_deg": float(np.degrees(votes.rotation_rad[on]).max()),
        "keyframe_centre": float(votes.centre[on].max()),
        "inlier_ratio": consensus.inlier_ratio,
        "deformation": deformation,
    }
    return LinkEstimate(
        S_old_new=S,
        covariance=covariance,
        n_matches=int(consensus.seen.sum()),
        n_inliers=int(consensus.inliers.sum()),
        landmark_pairs=np.stack([every.landmark_old[same], every.landmark_new[same]], 1),
        agreeing_keyframes=c.keyframes[on],
        change_point=change_point,
        suspected_onset=onset,
        sigma_scale=sigmas["sigma_scale"],
        numbers=numbers,
    )
