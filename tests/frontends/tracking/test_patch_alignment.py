"""Noisy observations of a plane move to where it is seen; wrong ones are removed, unless the image is blurred."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.geometry import se3
from dualslam.core.grey_image import GreyImage
from dualslam.core.types import FloatArray, Keyframe
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.patch_alignment import PatchAlignment
from dualslam.map.submap import Submap
from tests.frontends.direct.test_warp import CAMERA, T_CAM_KF, lift, views

WRONG = slice(60, 80)
"""Rows of the grid in the middle of the image."""


def seen_twice(noise_px: float, blur_px: float = 0.0) -> tuple[Submap, PatchAlignment, FloatArray]:
    """Return a map whose second keyframe sees a plane with noise and some wrong matches, and the true pixels."""
    first, second, submap = views()
    truth = CAMERA.project(lift(first.features.uv_px) @ T_CAM_KF[:3, :3].T + T_CAM_KF[:3, 3])
    uv = truth + np.random.default_rng(0).normal(0.0, noise_px, truth.shape)
    uv[WRONG] += 25.0
    features = replace(second.features, uv_px=uv, uv_rect_px=uv)
    submap.add_keyframe(Keyframe(30, 1.0, features), se3.inverse(T_CAM_KF))
    row = np.arange(len(uv))
    submap.add_observations(30, row, row)
    images = KeyframeImages()
    assert second.image is not None
    image = blurred(second.image.pixels(), blur_px)
    images.remember(first)
    images.remember(replace(second, features=features, image=GreyImage.of(image)))
    return submap, PatchAlignment(images, lambda: CAMERA), truth


def blurred(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    """Blur an image; not at all by 0."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8) if sigma_px else image


def errors(submap: Submap, truth: FloatArray) -> FloatArray:
    """Return how far the second keyframe's features are from the truth, pixels."""
    return np.asarray(np.linalg.norm(submap.keyframes[30].features.uv_rect_px - truth, axis=1))


def rows_of(submap: Submap, k: int) -> NDArray[np.int64]:
    """Return the live observations of a keyframe."""
    return np.flatnonzero((submap.observations["kf"] == k) & submap.observations["alive"])


def test_pixels_move_to_where_the_patches_match() -> None:
    submap, alignment, truth = seen_twice(noise_px=0.4)
    reference, was_px, before = submap.keyframes[0].features, submap.keyframes[30].features.uv_px, errors(submap, truth)
    alignment.refine(submap, rows_of(submap, 30))
    is_moved = (submap.keyframes[30].features.uv_px != was_px).any(axis=1)
    assert is_moved.sum() > 60
    assert np.median(errors(submap, truth)[is_moved]) < 0.3 * np.median(before[is_moved])
    assert submap.keyframes[0].features is reference


def test_wrong_matches_are_removed() -> None:
    submap, alignment, _ = seen_twice(noise_px=0.2)
    alignment.refine(submap, rows_of(submap, 30))
    is_seen = submap.landmark_of[30] >= 0
    assert is_seen[WRONG].mean() < 0.3  # those left are of edges, or of little contrast
    assert np.delete(is_seen, WRONG).mean() > 0.9


def test_a_blurred_image_contradicts_nothing() -> None:
    submap, alignment, _ = seen_twice(noise_px=0.2, blur_px=8.0)
    alignment.refine(submap, rows_of(submap, 30))
    assert (submap.landmark_of[30] >= 0).all()


def test_observations_without_an_image_stay_as_they_are() -> None:
    submap, _, _ = seen_twice(noise_px=0.4)
    before = submap.keyframes[30].features
    PatchAlignment(KeyframeImages(), lambda: CAMERA).refine(submap, rows_of(submap, 30))
    assert submap.keyframes[30].features is before
    assert (submap.landmark_of[30] >= 0).all()


def seen_thrice() -> tuple[Submap, PatchAlignment]:
    """Return a map whose second keyframe is there twice, with other noise; the first one's image is not kept."""
    submap, _, _ = seen_twice(noise_px=0.2)
    second, (_, view, _) = submap.keyframes[30], views()
    uv = second.features.uv_px + np.random.default_rng(1).normal(0.0, 0.2, second.features.uv_px.shape)
    third = Keyframe(60, 2.0, replace(second.features, uv_px=uv, uv_rect_px=uv))
    submap.add_keyframe(third, se3.inverse(T_CAM_KF))
    row = np.arange(len(uv))
    submap.add_observations(60, row, row)
    images = KeyframeImages()
    for keyframe in (second, third):
        images.remember(replace(view, index=keyframe.id, features=keyframe.features))
    return submap, PatchAlignment(images, lambda: CAMERA)


def test_keyframes_are_aligned_in_turn() -> None:
    """The third one's reference is the second, after this has moved."""
    together, alignment = seen_thrice()
    alignment.refine(together, np.concatenate([rows_of(together, 60), rows_of(together, 30)]))
    in_turn, alignment = seen_thrice()
    for k in (30, 60):
        alignment.refine(in_turn, rows_of(in_turn, k))
    before, _ = seen_thrice()
    for k in (30, 60):
        uv, expected, was = (each.keyframes[k].features.uv_px for each in (together, in_turn, before))
        assert (expected != was).any(axis=1).sum() > 60
        np.testing.assert_array_equal(uv, expected)
