"""Photometric check of tracked frames against the patches of older keyframes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, IntArray, View
from dualslam.frontends.direct.warp import (
    AGREES,
    HALF,
    MIN_CONTRAST,
    build_pyramid,
    correlate,
    inside,
    sample,
    warp_points,
)
from dualslam.frontends.tracking.turning import find_as_read
from dualslam.map.submap import NO_LANDMARK, Submap

SPACING_PX = 2.0
"""Pixels of the image per pixel of a patch: half the resolution tolerates an error of a pixel."""
N_PATCHES = 120
"""Per keyframe: a share of them is known to within 0.05."""
N_KEYFRAMES = 60
"""Keyframes whose patches are kept: 10 KB each."""
MAX_AGE_S = 0.8
"""Of the keyframe that a frame is compared with, where there is such a one. Over longer times a camera in a hand sees
surfaces from other sides, and walls hide others: of a right map's patches none may be left."""
MAX_ZOOM = 2.0
"""Change of size that the patch's plane, taken parallel to the image, tolerates."""
MIN_IN_VIEW = 0.3
"""Share of a keyframe's patches that a frame must be able to show to be compared with it."""
MIN_PATCHES = 25


@dataclass(frozen=True, slots=True, eq=False)
class _Patches:
    """N patches of one keyframe: its time, the rows of its features, and grey values (N, S, S)."""

    timestamp_s: float
    feature: IntArray
    greys: NDArray[np.uint8]


class PatchAudit:
    """Keeps small patches of keyframes, and measures how well a frame at its estimated pose agrees with them."""

    def __init__(self, camera: Callable[[], Camera]) -> None:
        self._camera = camera
        self._kept: dict[int, _Patches] = {}

    def remember(self, submap: Submap, view: View) -> None:
        """Keep patches of a view that has become a keyframe of a submap."""
        if view.image is None:
            return
        features, landmark_of = submap.keyframes[view.index].features, submap.landmark_of[view.index]
        rows = _spread(np.flatnonzero(landmark_of >= 0), features.uv_px)
        uv, camera = features.uv_px[rows], self._camera()
        if view.turn_rad is not None:
            uv = find_as_read(uv, features.uv_rect_px[rows], camera, view.turn_rad)
        levels = build_pyramid(view.image.pixels())
        axes = np.broadcast_to(SPACING_PX * np.eye(2), (len(rows), 2, 2))
        greys = sample(levels, uv, axes, HALF)
        usable = inside(uv, axes, HALF, camera.size_px) & (greys.std(axis=(1, 2)) >= MIN_CONTRAST)
        self._kept[view.index] = _Patches(view.timestamp_s, rows[usable], np.rint(greys[usable]).astype(np.uint8))
        while len(self._kept) > N_KEYFRAMES:
            del self._kept[next(iter(self._kept))]

    def measure(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> float | None:
        """Return the share of patches that look as predicted; see `PatchCheck.measure`.

        They are of the oldest recent keyframe that shows enough of the same. A map that follows a moving thing agrees
        with its newest keyframes only.
        """
        if view.image is None:
            return None
        reference = self._reference(submap, view, T_cam_submap)
        if reference is None:
            return None
        k, rows = reference
        patches, camera = self._kept[k], self._camera()
        feature, T_submap_kf = patches.feature[rows], submap.T_submap_kf[k]
        depth = submap.depths(submap.landmark_of[k][feature], se3.inverse(T_submap_kf))
        warp = warp_points(camera, submap.keyframes[k].features.uv_px[feature], depth, T_cam_submap @ T_submap_kf)
        uv, axes = warp.uv_px, SPACING_PX * warp.J_b_a
        if view.turn_rad is not None:
            uv = find_as_read(uv, warp.uv_rect_px, camera, view.turn_rad)
        usable = inside(uv, axes, HALF, camera.size_px)
        if usable.sum() < MIN_PATCHES:
            return None
        found = sample(build_pyramid(view.image.pixels()), uv[usable], axes[usable], HALF)
        return float((correlate(patches.greys[rows[usable]], found) > AGREES).mean())

    def _reference(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> tuple[int, IntArray] | None:
        """Return the keyframe to compare a frame with, and the rows of its patches that the frame may show."""
        K, size_px = submap.K, np.array(self._camera().size_px)
        known = [k for k in self._kept if k in submap.keyframes and k != view.index]
        recent = [k for k in known if abs(view.timestamp_s - self._kept[k].timestamp_s) <= MAX_AGE_S]
        for k in [*recent, *(k for k in reversed(known) if k not in recent)]:
            patches = self._kept[k]
            # Another map of the same frame has its features, without those that the first one found again by patches.
            landmark_of = submap.landmark_of[k]
            ids = np.full(len(patches.feature), NO_LANDMARK, np.int64)
            is_shared = patches.feature < len(landmark_of)
            ids[is_shared] = landmark_of[patches.feature[is_shared]]
            rows = np.flatnonzero(ids >= 0)
            uv, depth = project_points(K, T_cam_submap, submap.landmarks["xyz_mu"][ids[rows]])
            zoom = submap.depths(ids[rows], se3.inverse(submap.T_submap_kf[k])) / np.maximum(depth, TINY)
            in_view = (depth > 0) & (zoom < MAX_ZOOM) & (zoom > 1 / MAX_ZOOM) & ((uv > 0) & (uv < size_px)).all(axis=1)
            if in_view.sum() >= max(MIN_PATCHES, MIN_IN_VIEW * len(patches.feature)):
                return k, rows[in_view]
        return None


def _spread(rows: IntArray, uv_px: FloatArray) -> IntArray:
    """Return at most `N_PATCHES` of the rows, spread over the image."""
    cell = (uv_px[rows] // 64).astype(np.int64)
    order = rows[np.lexsort((rows, cell[:, 0], cell[:, 1]))]
    if len(order) <= N_PATCHES:
        return order
    return order[np.linspace(0, len(order) - 1, N_PATCHES).astype(np.int64)]
