"""Patches of a plane are where pose and depth put them in another view, and agree with it there alone."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.models import PinholeCamera
from dualslam.core.geometry import se3, so3
from dualslam.core.grey_image import GreyImage
from dualslam.core.types import Features, FloatArray, Keyframe, View
from dualslam.frontends.direct.patch_audit import PatchAudit
from dualslam.frontends.direct.warp import build_pyramid, correlate, sample, warp_points
from dualslam.map.submap import Submap
from tests.frontends.conftest import textured

CAMERA = PinholeCamera(640, 480, 450.0, 450.0, 319.5, 239.5)
DEPTH = 2.0
T_CAM_KF = se3.from_parts(so3.exp(np.array([0.02, -0.06, 0.1])), np.array([0.15, -0.1, -0.25]))
"""Nearer to the plane by an eighth, turned by 6 degrees."""


def seen_from(T_cam_kf: FloatArray, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Render the plane, whose texture is the keyframe's image."""
    normal = np.array([[0.0, 0.0, 1.0 / DEPTH]])
    H = CAMERA.K @ (T_cam_kf[:3, :3] + T_cam_kf[:3, 3:] @ normal) @ np.linalg.inv(CAMERA.K)
    return np.asarray(cv2.warpPerspective(image, H, CAMERA.size_px, flags=cv2.INTER_LINEAR), np.uint8)


def grid() -> FloatArray:
    """Return places all over the image."""
    return np.stack(np.meshgrid(np.linspace(60, 580, 14), np.linspace(60, 420, 10)), axis=-1).reshape(-1, 2)


def lift(uv: FloatArray) -> FloatArray:
    """Return points of the plane at pixels of the keyframe."""
    return DEPTH * np.column_stack([(uv - CAMERA.K[:2, 2]) / 450.0, np.ones(len(uv))])


def views() -> tuple[View, View, Submap]:
    """Make the keyframe, another view of the plane, and a map of the plane."""
    image, uv = textured(480, 640), grid()
    n = len(uv)
    features = Features(
        uv, uv, np.full(n, 0.5), np.ones(n), np.zeros(n, np.int64), np.zeros(n), np.zeros((n, 32), np.uint8)
    )
    submap = Submap(0, CAMERA.K, features.descriptors[0])
    submap.add_keyframe(Keyframe(0, 0.0, features), np.eye(4))
    submap.add_observations(0, np.arange(n), submap.add_landmarks(lift(uv), features.descriptors, np.ones(n), 0))
    keyframe = View(0, 0.0, features, GreyImage.of(image))
    other = View(30, 1.0, features, GreyImage.of(seen_from(T_CAM_KF, image)))
    return keyframe, other, submap


def test_points_are_warped_by_pose_and_depth() -> None:
    uv = grid()
    warp = warp_points(CAMERA, uv, np.full(len(uv), DEPTH), T_CAM_KF)
    expected = CAMERA.project(lift(uv) @ T_CAM_KF[:3, :3].T + T_CAM_KF[:3, 3])
    np.testing.assert_allclose(warp.uv_px, expected, atol=1e-9)
    np.testing.assert_allclose(warp.uv_rect_px, expected, atol=1e-9)
    np.testing.assert_allclose(warp.uv_rect_a_px, uv, atol=1e-9)
    # Its derivative, by differences of a tenth of a pixel.
    for axis in range(2):
        step = 0.1 * np.eye(2)[axis]
        moved = warp_points(CAMERA, uv + step, np.full(len(uv), DEPTH), T_CAM_KF).uv_px
        np.testing.assert_allclose(warp.J_b_a[:, :, axis], (moved - warp.uv_px) / 0.1, atol=2e-3)


def test_warped_patches_agree_and_shifted_ones_do_not() -> None:
    keyframe, other, _ = views()
    assert keyframe.image is not None
    assert other.image is not None
    uv = grid()
    warp = warp_points(CAMERA, uv, np.full(len(uv), DEPTH), T_CAM_KF)
    axes = np.tile(2.0 * np.eye(2), (len(uv), 1, 1))
    reference = sample(build_pyramid(keyframe.image.pixels()), uv, axes, 4)
    levels = build_pyramid(other.image.pixels())
    inside = ((warp.uv_px > 20) & (warp.uv_px < np.array(CAMERA.size_px) - 20)).all(axis=1)
    there = correlate(reference, sample(levels, warp.uv_px, 2.0 * warp.J_b_a, 4))
    beside = correlate(reference, sample(levels, warp.uv_px + [12.0, 5.0], 2.0 * warp.J_b_a, 4))
    assert np.median(there[inside]) > 0.95
    assert abs(np.median(beside[inside])) < 0.3


def test_a_flat_patch_agrees_with_nothing() -> None:
    flat, ramp = np.full((1, 9, 9), 80.0), np.arange(81.0).reshape(1, 9, 9)
    assert correlate(flat, ramp).tolist() == [0.0]
    np.testing.assert_allclose(correlate(ramp, 3 * ramp - 7), 1.0)
    np.testing.assert_allclose(correlate(ramp, -ramp), -1.0)


def test_a_frame_agrees_with_an_older_keyframe_at_its_own_pose_alone() -> None:
    keyframe, other, submap = views()
    audit = PatchAudit(lambda: CAMERA)
    assert audit.measure(submap, other, T_CAM_KF) is None, "there is nothing to compare with"
    audit.remember(submap, keyframe)
    right = audit.measure(submap, other, T_CAM_KF)
    assert right is not None
    assert right > 0.9
    wrong = audit.measure(submap, other, T_CAM_KF @ se3.from_parts(np.eye(3), np.array([0.1, 0.05, 0.0])))
    assert wrong is not None
    assert wrong < 0.1
    away = se3.from_parts(so3.exp(np.array([0.0, 1.2, 0.0])), np.zeros(3))
    assert audit.measure(submap, other, away) is None, "it shows another place"


def test_a_map_whose_keyframe_has_fewer_features_is_compared_by_those_that_it_has() -> None:
    keyframe, other, submap = views()
    audit = PatchAudit(lambda: CAMERA)
    audit.remember(submap, keyframe)
    n = 100  # of 140: another map of the same frame lacks the last ones
    features = keyframe.features.take(np.arange(n))
    second = Submap(1, CAMERA.K, features.descriptors[0])
    second.add_keyframe(Keyframe(0, 0.0, features), np.eye(4))
    ids = second.add_landmarks(lift(grid()[:n]), features.descriptors, np.ones(n), 0)
    second.add_observations(0, np.arange(n), ids)
    right = audit.measure(second, other, T_CAM_KF)
    assert right is not None
    assert right > 0.9


def test_what_something_hides_does_not_agree() -> None:
    keyframe, other, submap = views()
    assert other.image is not None
    audit = PatchAudit(lambda: CAMERA)
    audit.remember(submap, keyframe)
    pixels = other.image.pixels().copy()
    pixels[:, :448] = textured(480, 640, seed=9)[:, :448]
    hidden = audit.measure(submap, View(31, 1.1, other.features, GreyImage.of(pixels)), T_CAM_KF)
    assert hidden is not None
    assert 0.15 < hidden < 0.45, "30 % of the image is left"
