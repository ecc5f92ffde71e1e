"""Epipolar geometry and decompositions, OpenCV as oracle."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.triangulation import in_front, triangulate_two_view
from dualslam.core.geometry.two_view import (
    decompose_homography,
    essential_from_pose,
    fundamental_from_pose,
    homography_transfer_error,
    sampson_distance,
    sampson_error,
)
from dualslam.testing.two_maps import K, two_views

EXACT = 1e-9
NORMAL = np.array([0.1, -0.3, -0.95]) / np.linalg.norm([0.1, -0.3, -0.95])


def relative(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (T_b_a, uv_a, uv_b)."""
    v = two_views(seed)
    return se3.inverse(v.T_w_b) @ v.T_w_a, v.uv_a, v.uv_b


def homography_from_pose(T_b_a: np.ndarray, normal_a: np.ndarray, distance: float) -> np.ndarray:
    """Return H, (3, 3), of the plane ``normal_a' X_a == distance``: K (R + t n' / d) K^-1. Ma, eq. (5.66)."""
    plane = T_b_a[:3, :3] + np.outer(T_b_a[:3, 3], normal_a) / distance
    return np.asarray(K @ plane @ np.linalg.inv(K))


def test_true_matches_have_no_epipolar_error() -> None:
    """Sampson's error is zero; the essential and the fundamental matrix agree."""
    T, uv_a, uv_b = relative(0)
    F = fundamental_from_pose(K, T)
    assert sampson_error(F, uv_a, uv_b).max() < EXACT
    E = K.T @ F @ K
    np.testing.assert_allclose(E, essential_from_pose(T), atol=EXACT)


def test_sampson_error_is_opencvs_and_nearly_the_reprojection_error() -> None:
    """Equal to cv2.sampsonDistance; close to the minimal reprojection error at a pixel of noise."""
    T, uv_a, uv_b = relative(2)
    rng = np.random.default_rng(2)
    uv_a, uv_b = uv_a + rng.normal(size=uv_a.shape), uv_b + rng.normal(size=uv_b.shape)
    F = fundamental_from_pose(K, T)
    ours = sampson_error(F, uv_a, uv_b)
    pairs = zip(np.c_[uv_a, np.ones(len(uv_a))], np.c_[uv_b, np.ones(len(uv_b))], strict=True)
    theirs = [cv2.sampsonDistance(a, b, F) for a, b in pairs]
    np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-12)
    points = triangulate_two_view(uv_a, uv_b, K, np.eye(4), se3.inverse(T))
    np.testing.assert_allclose(points.error2_a + points.error2_b, ours, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("sign", [1.0, -2.5])
def test_homography_decomposition_agrees_with_opencv(seed: int, sign: float) -> None:
    """Random planes and motions: the same four solutions as OpenCV, the true one among them."""
    rng = np.random.default_rng(seed)
    normal = np.array([0.3, 0.2, 1.0]) * rng.choice([-1, 1], 3) * rng.uniform(0.5, 1, 3)
    normal[2] = abs(normal[2])
    normal /= np.linalg.norm(normal)
    T = se3.exp(np.concatenate([0.1 * rng.normal(size=3), 0.4 * rng.normal(size=3)]))
    H = sign * homography_from_pose(T, normal, 2.0)
    ours = decompose_homography(H, K)
    n, rotations, translations, normals = cv2.decomposeHomographyMat(H / H[2, 2], K)
    assert n == len(ours.T_b_a) == 4
    for R, t, m in zip(rotations, translations, normals, strict=True):
        gap = [
            np.abs(P[:3, :3] - R).max() + np.abs(P[:3, 3] - t[:, 0]).max() + np.abs(q - m[:, 0]).max()
            for P, q in zip(ours.T_b_a, ours.normal_a, strict=True)
        ]
        assert min(gap) < 1e-5
    truth = np.abs(ours.T_b_a - se3.from_parts(T[:3, :3], T[:3, 3] / 2.0)).max((1, 2)) + np.abs(
        ours.normal_a - normal
    ).max(1)
    assert truth.min() < 1e-8


def test_homography_of_a_rotation_has_one_pose() -> None:
    """No translation, no plane to be found."""
    R = so3.exp([0.05, -0.1, 0.02])
    poses = decompose_homography(K @ R @ np.linalg.inv(K), K)
    assert poses.T_b_a.shape == (1, 4, 4)
    np.testing.assert_allclose(poses.T_b_a[0], se3.from_parts(R, np.zeros(3)), atol=EXACT)


def test_homography_transfer_and_cheirality_on_a_plane() -> None:
    """Points of a plane transfer exactly both ways; positive depth leaves at most two poses, the true one with all."""
    T, uv_a, _ = relative(3)
    normal, distance = -NORMAL, 4.0
    rays = np.c_[(uv_a - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(len(uv_a))]
    depth = distance / (rays @ normal)
    plane = rays[depth > 0] * depth[depth > 0, None]
    moved = se3.act(T, plane) @ K.T
    uv_a, uv_b = uv_a[depth > 0], moved[:, :2] / moved[:, 2:]
    H = homography_from_pose(T, normal, distance)
    assert homography_transfer_error(H, uv_a, uv_b).max() < EXACT
    shifted = homography_transfer_error(H, uv_a, uv_b + [[3.0, 4.0]])
    np.testing.assert_allclose(shifted[:, 1], 25.0, atol=1e-6)
    assert (shifted[:, 0] > 1.0).all()
    poses = decompose_homography(H, K).T_b_a
    points = [triangulate_two_view(uv_a, uv_b, K, np.eye(4), se3.inverse(pose)) for pose in poses]
    counts = np.array([in_front(p.depth_a, p.depth_b).sum() for p in points])
    assert (counts > 0.5 * len(uv_a)).sum() <= 2
    truth = np.abs(poses - se3.from_parts(T[:3, :3], T[:3, 3] / distance)).max((1, 2))
    assert counts[int(np.argmin(truth))] == len(uv_a)


def test_sampson_distance_is_the_root_of_the_error_with_a_sign() -> None:
    T, uv_a, uv_b = relative(3)
    F = fundamental_from_pose(K, T)
    line = F @ np.c_[uv_a, np.ones(len(uv_a))].T
    aside = (line[:2] / np.linalg.norm(line[:2], axis=0)).T
    above, below = (sampson_distance(F, uv_a, uv_b + side) for side in (aside, -aside))
    np.testing.assert_allclose(above**2, sampson_error(F, uv_a, uv_b + aside))
    np.testing.assert_allclose(above, -below, rtol=0.05)
    assert (above > 0.1).all()
