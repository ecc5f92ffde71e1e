"""The gates of a link: a wide enough overlap, and the same shape of both maps there."""

from __future__ import annotations

import math

import numpy as np

from dualslam.core.config import LinkingConfig
from dualslam.core.geometry import sim3
from dualslam.core.submap import Submap
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray
from dualslam.linking.pairs import PairModel

UNTESTABLE = 3.0
"""A part whose own sigma is this many times the allowed deformation says nothing about it."""

ROTATION_SHARE = 0.25
"""How much less orientation drifts (rad) than scale does (relative)."""


def check_own_pixels(model: PairModel, views: BoolArray, config: LinkingConfig) -> Failure | None:
    """Refuse where either map's points do not lie on that map's own pixels: mirrored or bent copies give way here."""
    in_old, in_new = model.own_reprojection2()
    for name, chi2 in (("old", in_old), ("new", in_new)):
        share = float((chi2[views] < config.pixel_chi2).mean())
        if share <= config.min_majority:
            detail = f"{share:.0%} of the {name} map's matched points lie on their own pixels"
            return Failure(FailureReason.REPROJECTION, detail, {f"own_share_{name}": share})
    return None


def check_reprojection(
    model: PairModel, S_old_new: FloatArray, views: BoolArray, config: LinkingConfig
) -> Failure | None:
    """Refuse where the points of one map do not fall on the pixels of the other, in either direction."""
    in_old, in_new = model.reprojection2(S_old_new)
    for name, chi2 in (("old", in_old), ("new", in_new)):
        share = float((chi2[views] < config.pixel_chi2).mean())
        if share <= config.min_majority:
            detail = f"{share:.0%} of the points of the other map fall on the {name} map's pixels"
            return Failure(FailureReason.REPROJECTION, detail, {f"share_in_{name}": share})
    return None


def check_spread(
    model: PairModel, old: Submap, pair_mask: BoolArray, keyframes: BoolArray, config: LinkingConfig
) -> Failure | None:
    """Refuse where the agreeing landmarks cover too little of the image, along either axis, or of depth."""
    c = model.pairs
    views = pair_mask[c.view_pair] & keyframes[c.view_keyframe]
    ids = c.keyframes[keyframes]
    features = np.concatenate([old.keyframes[k].features.uv_rect_px for k in ids.tolist()])
    covered = np.ptp(np.percentile(c.uv_old[views], [5, 95], axis=0), axis=0)
    share = covered / np.maximum(np.ptp(np.percentile(features, [5, 95], axis=0), axis=0), 1e-9)
    numbers = {"spread_u": float(share[0]), "spread_v": float(share[1])}
    if share.min() < config.min_image_spread:
        return Failure(FailureReason.SPREAD, f"{share.min():.0%} of the image is covered", numbers)
    T = model.T_kf_old[c.view_keyframe]
    xyz = c.xyz_old[c.view_pair]
    depth = (T[:, 2, :3] * xyz).sum(1) + T[:, 2, 3]
    ranges = []
    for k in np.flatnonzero(keyframes).tolist():
        near, middle, far = np.percentile(depth[views & (c.view_keyframe == k)], [10, 50, 90])
        ranges.append((far - near) / middle)
    numbers["spread_depth"] = float(np.median(ranges))
    if np.median(ranges) < config.min_depth_spread:
        return Failure(FailureReason.SPREAD, f"depths differ by {np.median(ranges):.1%}", numbers)
    return None


def check_sigmas(
    model: PairModel, S_old_new: FloatArray, covariance: FloatArray, config: LinkingConfig
) -> Failure | None:
    """Refuse a similarity that the landmarks do not fix (collinear, all at one place), by its own covariance."""
    numbers = sigma_numbers(model, S_old_new, covariance)
    if numbers["sigma_scale"] > config.max_scale_sigma:
        return Failure(FailureReason.SCALE, f"scale known to {numbers['sigma_scale']:.1%}", numbers)
    if numbers["sigma_rot_deg"] > config.max_rotation_sigma_deg:
        return Failure(FailureReason.DEGENERATE, f"rotation known to {numbers['sigma_rot_deg']:.2f} deg", numbers)
    if numbers["sigma_trans_mu"] > config.max_position_sigma * numbers["depth_mu"]:
        return Failure(FailureReason.DEGENERATE, f"position known to {numbers['sigma_trans_mu']:.3g}", numbers)
    return None


def sigma_numbers(model: PairModel, S_old_new: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Return the sigmas of scale (relative), rotation, and position of the overlap's centre (unit of the old map)."""
    at_centre = sim3.adjoint(_shift(-model.centre_new))
    C = at_centre @ covariance @ at_centre.T
    distance = np.linalg.norm(model.pairs.xyz_old[:, None] - model.T_old_kf[None, :, :3, 3], axis=2)
    return {
        "sigma_scale": math.sqrt(C[6, 6]),
        "sigma_rot_deg": math.degrees(math.sqrt(np.linalg.eigvalsh(C[:3, :3])[-1])),
        "sigma_trans_mu": float(sim3.scale(S_old_new)) * math.sqrt(np.linalg.eigvalsh(C[3:6, 3:6])[-1]),
        "depth_mu": float(np.median(distance)),
    }


def deformation_covariance(model: PairModel, config: LinkingConfig) -> FloatArray:
    """Return (7, 7) that the maps' deformation adds to a link's covariance (right perturbation, frame new).

    The pairs all bend together, so that more of them do not help. Where drift is a random walk, the mean over the
    overlap is off by about half of what its ends differ; in scale and position, that is: orientation drifts less.
    """
    distance = np.linalg.norm(model.pairs.xyz_new[:, None] - model.T_new_kf[None, :, :3, 3], axis=2)
    half = 0.5 * config.deformation_sigma
    sigma = np.repeat([ROTATION_SHARE * half, half * float(np.median(distance)), half], [3, 3, 1])
    from_centre = sim3.adjoint(_shift(model.centre_new))
    return np.asarray(from_centre @ np.diag(sigma**2) @ from_centre.T, np.float64)


def _shift(t: FloatArray) -> FloatArray:
    S = np.eye(4)
    S[:3, 3] = t
    return S


def check_shape(
    model: PairModel, S_old_new: FloatArray, inliers: BoolArray, keyframes: BoolArray, config: LinkingConfig
) -> Failure | None:
    """Refuse maps of different shape: stretched or sheared as a whole, or parts that want another scale or rotation.

    The strain between the maps is estimated together with the similarity and compared with its covariance plus the
    deformation that healthy maps may have. Then each half of the pairs (left and right, top and bottom, near and far,
    early and late) takes a Gauss-Newton step from the common similarity; its scale and rotation may move as little.
    """
    H, g = model.normal_equations(S_old_new, inliers)
    allowed2 = config.deformation_sigma**2
    try:
        strain = np.linalg.solve(H, g)[7:]
        covariance = np.linalg.inv(H)[7:, 7:]
    except np.linalg.LinAlgError:
        return Failure(FailureReason.DEGENERATE, "the landmarks do not fix their own shape")
    chi2 = float(strain @ np.linalg.solve(covariance + allowed2 * np.eye(5), strain))
    numbers = {"strain": float(np.linalg.norm(strain)), "strain_chi2": chi2}
    if chi2 > config.strain_chi2:
        return Failure(FailureReason.DEFORMED, f"stretched by {numbers['strain']:.1%}", numbers)
    for name, part in _halves(model, inliers, keyframes).items():
        moved = _part_moves(model, S_old_new, part, config)
        if moved is not None:
            numbers |= {"log_scale": moved[0], "rotation_deg": moved[1]}
            detail = f"the {name} half differs by {moved[0]:+.1%} in scale, {moved[1]:.2f} deg"
            return Failure(FailureReason.DEFORMED, detail, numbers)
    return None


def check_cameras(
    model: PairModel, S_old_new: FloatArray, keyframes: BoolArray, config: LinkingConfig
) -> Failure | None:
    """Refuse where the cameras' path wants another scale than the landmarks: in one of the maps these two disagree.

    A centre is taken to be known to one pixel's worth at the landmarks' distance; a path too short for that says
    nothing.
    """
    centres = model.T_old_kf[keyframes, :3, 3]
    moved = sim3.act(S_old_new, model.T_new_kf[keyframes, :3, 3])
    centres, moved = centres - centres.mean(0), moved - moved.mean(0)
    length2 = float((moved**2).sum())
    noise = float(np.median(np.linalg.norm(model.pairs.xyz_old - model.T_old_kf[keyframes, :3, 3].mean(0), axis=1)))
    noise /= model.K_old[0, 0]
    if not length2 > (noise / (UNTESTABLE * config.deformation_sigma)) ** 2:
        return None
    difference = float((centres * moved).sum()) / length2 - 1.0
    sigma2 = noise**2 / length2 + config.deformation_sigma**2
    if difference**2 > config.gate_sigmas**2 * sigma2:
        detail = f"the cameras' path differs by {difference:+.1%} in scale from the landmarks"
        return Failure(FailureReason.DEFORMED, detail, {"path_scale": 1.0 + difference})
    return None


def _halves(model: PairModel, inliers: BoolArray, keyframes: BoolArray) -> dict[str, BoolArray]:
    """Split the inlier pairs at the median of image position, depth and time."""
    c = model.pairs
    n = len(c)
    views = inliers[c.view_pair] & keyframes[c.view_keyframe]
    T = model.T_kf_old[c.view_keyframe]
    depth_view = (T[:, 2, :3] * c.xyz_old[c.view_pair]).sum(1) + T[:, 2, 3]
    count = np.maximum(np.bincount(c.view_pair[views], minlength=n), 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(c.view_pair[views], values[views], n) / count, np.float64)

    halves = {}
    for low, high, value in (
        ("left", "right", mean(c.uv_old[:, 0])),
        ("upper", "lower", mean(c.uv_old[:, 1])),
        ("near", "far", mean(depth_view)),
        ("early", "late", mean(c.view_keyframe.astype(np.float64))),
    ):
        below = value <= np.median(value[inliers])
        halves[low], halves[high] = inliers & below, inliers & ~below
    return halves


def _part_moves(
    model: PairModel, S_old_new: FloatArray, part: BoolArray, config: LinkingConfig
) -> tuple[float, float] | None:
    """Return (log-scale, degrees) by which a part of the pairs wants to move, None if no more than it may."""
    if np.count_nonzero(part) < config.min_pairs_per_keyframe:
        return None
    H, g = model.normal_equations(S_old_new, part)
    try:
        step, C = np.linalg.solve(H[:7, :7], g[:7]), np.linalg.inv(H[:7, :7])
    except np.linalg.LinAlgError:
        return None
    allowed2, gate2 = config.deformation_sigma**2, config.gate_sigmas**2
    untestable = (UNTESTABLE * config.deformation_sigma) ** 2
    scale_moves = C[6, 6] < untestable and step[6] ** 2 > gate2 * (C[6, 6] + allowed2)
    C_rotation = C[:3, :3] + allowed2 * np.eye(3)
    turn = float(np.linalg.norm(step[:3]))
    axis = step[:3] / max(turn, 1e-12)
    turns = axis @ C[:3, :3] @ axis < untestable and turn**2 > gate2 * float(axis @ C_rotation @ axis)
    return (float(step[6]), math.degrees(turn)) if scale_moves or turns else None
