"""The gates of a link: the old map must have given way where the maps part, and the landmarks fix the similarity."""

from __future__ import annotations

import math

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FloatArray, IntArray
from dualslam.linking.join_test import LinkEvidence, parting_gate, similarity_gates, support_gate
from dualslam.linking.pairs import PairModel
from dualslam.linking.scale_observability import scale_sigma_between
from dualslam.map.submap import Submap


def judge_parting(
    model: PairModel,
    S_old_new: FloatArray,
    old: Submap,
    new: Submap,
    agreeing: IntArray,
    parted: IntArray,
) -> LinkEvidence:
    """Judge maps that agree on a similarity at some keyframes (ids), and part at newer ones."""
    sigma_old, sigma_new = (scale_sigma_between(m, agreeing, parted) for m in (old, new))
    apart = _log_scale_at(model, parted) - math.log(sim3.scale(S_old_new))
    return LinkEvidence((parting_gate(apart, sigma_old, sigma_new, len(parted)),))


def _log_scale_at(model: PairModel, keyframes: IntArray) -> float:
    """Return the log of the scale of the old map to the new one, as some keyframes (ids) see their points."""
    in_old, in_new = model.depths_old(), model.depths_new()
    seen = np.isin(model.pairs.keyframes, keyframes)[model.pairs.view_keyframe] & (in_old > 0) & (in_new > 0)
    return float(np.median(np.log(in_old[seen] / in_new[seen]))) if seen.any() else math.inf


def judge_overlap(sigmas: dict[str, float], n_keyframes: int, config: LinkingConfig) -> LinkEvidence:
    """Judge, by `sigma_numbers`, whether keyframes agree on a similarity, and the landmarks fix it."""
    position = sigmas["sigma_trans_mu"] / sigmas["depth_mu"]
    gates = similarity_gates(sigmas["sigma_scale"], sigmas["sigma_rot_deg"], position, config)
    return LinkEvidence.of([support_gate(n_keyframes, config.min_keyframes), *gates])


def sigma_numbers(model: PairModel, S_old_new: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Return the sigmas of scale (relative), rotation, and position of the overlap's centre (unit of the old map)."""
    at_centre = sim3.adjoint(se3.from_parts(so3.IDENTITY, -model.centre_new))
    C = at_centre @ covariance @ at_centre.T
    distance = np.linalg.norm(model.pairs.xyz_old[:, None] - se3.translation(model.T_old_kf)[None], axis=2)
    return {
        "sigma_scale": math.sqrt(C[6, 6]),
        "sigma_rot_deg": math.degrees(math.sqrt(np.linalg.eigvalsh(C[:3, :3])[-1])),
        "sigma_trans_mu": float(sim3.scale(S_old_new)) * math.sqrt(np.linalg.eigvalsh(C[3:6, 3:6])[-1]),
        "depth_mu": float(np.median(distance)),
    }
