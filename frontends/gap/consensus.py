"""Whether two frames beyond a gap, each posed by itself, confirm each other.

Matches agree with the poses or not, within their pixels' noise and the poses' errors. An error of a pose moves all
matches together: Scheffe's bound for six parameters (a pose's derivative times any error within its 99 % ellipsoid)
allows for it. The two poses are taken to be wrong independently.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dualslam.core.chi_square import CHI2_95, CHI2_99
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points, projection_jacobians
from dualslam.core.geometry.triangulation import triangulate_two_view
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_distance
from dualslam.core.noise_model import MIN_CONSENSUS
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Rival
from dualslam.frontends.gap.relocalisation import GapPose

CONFIRMING_SHARE = 0.85
"""Of what two frames beyond a gap both see must agree with their poses. Of two right ones on rendered streets 95 to
100 % do; of one right and one wrong, three quarters at most."""
STEP = 1e-6
"""Of a pose, to differentiate by: its logarithm's unit is radians, and the submap's."""


@dataclass(frozen=True, slots=True, eq=False)
class BeyondGap:
    """A frame beyond a gap."""

    features: Features  # of the auxiliary front end
    rows: IntArray  # (N,): features whose tracks agree with the pose, as ``pose.inliers`` has them
    pose: GapPose


def confirmed_share(first: BeyondGap, second: BeyondGap, matches: IntArray, K: FloatArray) -> float:
    """Return the share of what two frames both see that agrees with their poses, the lesser of two.

    One is of tracks through the gap: points by the first pose, seen under the second. The other is of all else, which
    had no part in the poses: epipolar lines, in front of the cameras. Where the scene repeats itself, only that tells.

    - `K` (3, 3).
    - `matches` (M, 2): rows of their features.

    Returns float: zero where they share too little to tell.
    """
    T_b_a = second.pose.T_cam_submap @ se3.inverse(first.pose.T_cam_submap)
    Ad = se3.adjoint(T_b_a)
    within = CHI2_99[se3.DOF] * (second.pose.covariance + Ad @ first.pose.covariance @ Ad.T)
    point_of = np.full(len(first.features), -1)
    point_of[first.rows] = np.arange(len(first.rows))
    rows_a, rows_b = matches.T
    tracked = point_of[rows_a] >= 0
    if tracked.sum() < MIN_CONSENSUS:
        return 0.0
    uv_a, uv_b = first.features.uv_rect_px[rows_a], second.features.uv_rect_px[rows_b]
    variance = first.features.sigma_px[rows_a] ** 2 + second.features.sigma_px[rows_b] ** 2
    xyz = first.pose.xyz_mu[first.pose.inliers][point_of[rows_a[tracked]]]
    share = _share_in_place(xyz, uv_b[tracked], variance[tracked], K, second.pose.T_cam_submap, within)
    if (~tracked).sum() < MIN_CONSENSUS:
        return share
    return min(share, _static_share(uv_a[~tracked], uv_b[~tracked], variance[~tracked] / 2.0, K, T_b_a, within))


def are_no_copies(
    first: BeyondGap, second: BeyondGap, matches: IntArray, rivals: Iterable[Rival], K: FloatArray
) -> BoolArray:
    """Return which matches of two frames are of one thing: in repeated structure a copy may look more similar.

    A match counts if it is nearer to the poses' prediction than half way to that of another pose, at the median depth.

    - `K` (3, 3).
    - `matches` (M, 2): rows of their features.
    - `rivals`: other poses beyond the gap, of either frame.

    Returns (M,) bool.
    """
    T_first, T_second = first.pose.T_cam_submap, second.pose.T_cam_submap
    xyz = first.pose.xyz_mu[first.pose.inliers]
    uv, _ = project_points(K, T_second, xyz)
    period_px = np.inf
    for rival in rivals:
        uv_rival, _ = project_points(K, T_second @ se3.inverse(rival.T_rival_walked), xyz)
        apart_px = np.linalg.norm(uv_rival - uv, axis=1)
        apart_px[np.isnan(apart_px)] = np.inf  # behind one of the cameras: it shows no copy of that
        period_px = min(period_px, float(np.median(apart_px)))
    _, depth = project_points(K, T_first, xyz)
    uv_first = first.features.uv_rect_px[matches[:, 0]]
    rays = np.column_stack([(uv_first - K[:2, 2]) / (K[0, 0], K[1, 1]), np.ones(len(matches))])
    shown, _ = project_points(K, T_second @ se3.inverse(T_first), rays * float(np.median(depth)))
    apart_px = np.linalg.norm(second.features.uv_rect_px[matches[:, 1]] - shown, axis=1)
    return np.asarray(apart_px < period_px / 2)


def _share_in_place(
    xyz: FloatArray, uv_px: FloatArray, variance: FloatArray, K: FloatArray, T_cam: FloatArray, within: FloatArray
) -> float:
    """Share of points that are seen where they should be, by a camera that is off by an error `within` (6, 6)."""
    uv, _ = project_points(K, T_cam, xyz)
    J_pose, _ = projection_jacobians(K, T_cam, xyz)
    bound = CHI2_99[2] * variance[:, None, None] * np.eye(2) + J_pose @ within @ J_pose.swapaxes(1, 2)
    error = uv - uv_px
    return float((np.einsum("ni,nij,nj->n", error, np.linalg.inv(bound), error) < 1.0).mean())


def _static_share(
    uv_a: FloatArray, uv_b: FloatArray, variance: FloatArray, K: FloatArray, T_b_a: FloatArray, within: FloatArray
) -> float:
    """Share of matches of two views that a scene at rest allows under a relative pose with an error `within` (6, 6)."""

    def distance(xi: FloatArray) -> FloatArray:
        return sampson_distance(fundamental_from_pose(K, se3.exp(xi) @ T_b_a), uv_a, uv_b)

    J = np.column_stack([(distance(xi) - distance(-xi)) / (2 * STEP) for xi in STEP * np.eye(se3.DOF)])
    of_pose = np.einsum("ni,ij,nj->n", J, within, J)
    agrees = distance(np.zeros(se3.DOF)) ** 2 < CHI2_95[1] * variance + of_pose
    points = triangulate_two_view(uv_a, uv_b, K, se3.IDENTITY, se3.inverse(T_b_a))
    # So far away that an error decides on which side of infinity a point comes to lie, neither side says anything.
    angle2 = CHI2_95[1] * variance / K[0, 0] ** 2 + np.linalg.eigvalsh(se3.rotation(within))[-1]
    far = points.cos_parallax > np.cos(np.minimum(np.sqrt(angle2), np.pi))
    return float((agrees & (far | ((points.depth_a > 0) & (points.depth_b > 0)))).mean())
