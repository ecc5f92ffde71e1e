"""Positions of a keyframe's observations, refined by aligning image patches with those of older keyframes.

A detector places a corner in each image anew. Two patches of the same surface tell their shift several times better,
and patches that do not look alike tell of a wrong match.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.noise_model import MAJORITY
from dualslam.core.types import REFINED_PX, BoolArray, FloatArray, IntArray
from dualslam.frontends.direct.patches import MIN_CONTRAST
from dualslam.frontends.direct.warp import HALF, Pyramid, build_pyramid, correlate, inside, sample, warp_points
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.row_shifts import find_as_read
from dualslam.map.submap import NO_LANDMARK, Submap

N_ITERATIONS = 4
MAX_ZOOM = 1.5
"""Change of size between two patches that are compared: beyond, one is sampled too coarsely for the other."""
MAX_CONDITION = 100.0
"""Ratio of a patch's gradients across and along an edge (squared): above, the edge leaves one direction open."""
CONVERGED = 0.1
"""Last step in pixels of the patch."""
AGREES = 0.85
"""Correlation of two patches of the same surface."""


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """Of M observations."""

    shift_px: FloatArray  # (M, 2): in the image
    tested: BoolArray  # (M,): both patches are in their images, and of enough contrast
    agrees: BoolArray  # (M,)


@dataclass(frozen=True, slots=True, eq=False)
class _Patches:
    """Of a keyframe's features, as far as they were asked for."""

    greys: NDArray[np.float32]  # (N, 2 HALF + 3, 2 HALF + 3)
    is_known: BoolArray  # (N,)

    @classmethod
    def of_size(cls, n: int) -> _Patches:
        """Return none yet."""
        return cls(np.zeros((n, 2 * HALF + 3, 2 * HALF + 3), np.float32), np.zeros(n, np.bool_))

    def forget(self, feature: IntArray) -> None:
        """Forget those of features that have moved."""
        self.is_known[feature[feature < len(self.is_known)]] = False


class PatchAlignment:
    """Aligns observations of a submap with each other, as far as the images of their keyframes are kept."""

    def __init__(self, images: KeyframeImages, camera: Callable[[], Camera]) -> None:
        self._images, self._camera = images, camera
        self._pyramids: dict[int, Pyramid] = {}
        self._patches: dict[int, _Patches] = {}

    def refine(self, submap: Submap, rows: IntArray) -> None:
        """Move the pixels of observations to where their patches match, and remove those that match nowhere near."""
        kf = submap.observations["kf"][rows]
        self._pyramids = {k: levels for k, levels in self._pyramids.items() if k in self._images}
        self._patches = {k: patches for k, patches in self._patches.items() if k in self._images}
        contradicted = [self._refine_in(submap, k, rows[kf == k]) for k in np.unique(kf).tolist() if k in self._images]
        if contradicted:
            submap.remove_outliers(np.concatenate(contradicted))

    def _refine_in(self, submap: Submap, k: int, rows: IntArray) -> IntArray:
        """Refine a keyframe's observations; return the rows that its image contradicts."""
        ids, feature = (submap.observations[name][rows] for name in ("landmark", "feature"))
        reference, feature_there = self._references(submap, k, ids)
        known = np.flatnonzero(reference >= 0)
        if not len(known):
            return rows[:0]
        rows, ids, feature = rows[known], ids[known], feature[known]
        camera, keyframe = self._camera(), submap.keyframes[k]
        aligned = self._align_in(submap, k, ids, feature, reference[known], feature_there[known])
        n_tested, moved = np.count_nonzero(aligned.tested), aligned.agrees
        features, at = keyframe.features, feature[moved]
        uv, uv_rect = features.uv_px.copy(), features.uv_rect_px.copy()
        uv[at] += aligned.shift_px[moved]
        uv_rect[at] += camera.rectify(uv[at])[0] - camera.rectify(features.uv_px[at])[0]
        submap.keyframes[k] = replace(keyframe, features=replace(features, uv_px=uv, uv_rect_px=uv_rect))
        if k in self._patches:
            self._patches[k].forget(at)
        wrong = rows[aligned.tested & ~aligned.agrees]
        return wrong if np.count_nonzero(moved) > MAJORITY * n_tested else wrong[:0]

    def _references(self, submap: Submap, k: int, ids: IntArray) -> tuple[IntArray, IntArray]:
        """Return the keyframe that each landmark's patch is taken from, or -1, and the feature there.

        It is the one that first described the landmark. Where its image is not kept, or shows the landmark in another
        size, it is the farthest in time.
        """
        reference, feature = np.full(len(ids), -1), np.full(len(ids), -1)
        first, depth = submap.landmarks["first_kf"][ids], submap.depths(ids, se3.inverse(submap.T_submap_kf[k]))
        feature_of = np.full(len(submap.landmarks), -1)
        others = [other for other in submap.keyframes_near(k) if other in self._images and other != k]
        for other in reversed(others):
            landmark_of = submap.landmark_of[other]
            seen = np.flatnonzero(landmark_of != NO_LANDMARK)
            feature_of[:] = -1
            feature_of[landmark_of[seen]] = seen
            zoom = submap.depths(ids, se3.inverse(submap.T_submap_kf[other])) / np.maximum(depth, 1e-9)
            fits = (feature_of[ids] >= 0) & (zoom < MAX_ZOOM) & (zoom > 1 / MAX_ZOOM) & (first != k)
            takes = fits & ((reference < 0) | (first == other))
            reference[takes], feature[takes] = other, feature_of[ids[takes]]
        return reference, feature

    def _align_in(
        self, submap: Submap, k: int, ids: IntArray, feature: IntArray, reference: IntArray, feature_there: IntArray
    ) -> _Aligned:
        camera, n = self._camera(), len(ids)
        templates = np.zeros((n, 2 * HALF + 3, 2 * HALF + 3), np.float32)
        uv_there, scale, T_k_there, depth = np.zeros((n, 2)), np.zeros(n), np.zeros((n, 4, 4)), np.zeros(n)
        T_k_submap = se3.inverse(submap.T_submap_kf[k])
        for other in np.unique(reference).tolist():
            of = np.flatnonzero(reference == other)
            T_submap_other = submap.T_submap_kf[other]
            uv_there[of] = self._as_read(submap, other, feature_there[of], camera)
            scale[of] = submap.keyframes[other].features.scale[feature_there[of]]
            depth[of] = submap.depths(ids[of], se3.inverse(T_submap_other))
            T_k_there[of] = T_k_submap @ T_submap_other
            templates[of] = self._templates(other, feature_there[of], uv_there[of], scale[of])
        steps = scale[:, None, None] * np.eye(2)
        axes = steps @ warp_points(camera, uv_there, depth, T_k_there).J_b_a
        uv = self._as_read(submap, k, feature, camera)
        usable = inside(uv_there, steps, HALF + 1, camera.size_px) & np.isfinite(axes).all(axis=(1, 2))
        usable[usable] = inside(uv[usable], axes[usable], HALF, camera.size_px)
        own_scale = submap.keyframes[k].features.scale[feature]
        return _align(templates, self._levels(k), uv, axes, usable, REFINED_PX * own_scale)

    def _templates(self, k: int, feature: IntArray, uv_px: FloatArray, scale: FloatArray) -> NDArray[np.float32]:
        """Return patches about features of a keyframe, in their octaves; each is sampled once."""
        kept = self._patches.get(k)
        if kept is None or len(kept.is_known) <= feature.max():
            kept = self._patches[k] = _Patches.of_size(int(feature.max()) + 1000)
        new = np.flatnonzero(~kept.is_known[feature])
        if len(new):
            axes = scale[new, None, None] * np.eye(2)
            kept.greys[feature[new]] = sample(self._levels(k), uv_px[new], axes, HALF + 1)
            kept.is_known[feature[new]] = True
        return kept.greys[feature]

    def _as_read(self, submap: Submap, k: int, feature: IntArray, camera: Camera) -> FloatArray:
        """Return where a keyframe's image shows features."""
        features, turn_rad = submap.keyframes[k].features, self._images[k].turn_rad
        uv = features.uv_px[feature]
        return uv if turn_rad is None else find_as_read(uv, features.uv_rect_px[feature], camera, turn_rad)

    def _levels(self, k: int) -> Pyramid:
        if k not in self._pyramids:
            self._pyramids[k] = build_pyramid(self._images[k].image.pixels())
        return self._pyramids[k]


def _align(
    templates: NDArray[np.float32],
    levels: Pyramid,
    uv_px: FloatArray,
    axes: FloatArray,
    usable: BoolArray,
    max_shift_px: FloatArray,
) -> _Aligned:
    """Shift patches of an image until they look like templates (N, 2 HALF + 3, 2 HALF + 3), up to contrast and mean.

    Gauss-Newton with the templates' gradients (Baker and Matthews, IJCV 2004).
    """
    n = len(uv_px)
    inner = templates[:, 1:-1, 1:-1].reshape(n, -1)
    by_u = 0.5 * (templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2]).reshape(n, -1)
    by_v = 0.5 * (templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1]).reshape(n, -1)
    J = np.stack([by_u, by_v, inner], axis=2)
    J -= J.mean(axis=1, keepdims=True)  # which leaves the mean free
    H = np.matmul(J.swapaxes(1, 2), J).astype(np.float64)
    low, high = np.linalg.eigvalsh(H[:, :2, :2]).T
    tested = usable & (high < MAX_CONDITION * low) & (H[:, 2, 2] > MIN_CONTRAST**2 * inner.shape[1])
    row, shift, step = np.flatnonzero(tested), np.zeros((n, 2)), np.full(n, np.inf)
    agrees = np.zeros(n, np.bool_)
    if len(row):
        to_parameters = np.matmul(np.linalg.inv(H[row]), J[row].swapaxes(1, 2)).astype(np.float32)
        for _ in range(N_ITERATIONS):
            found = sample(levels, uv_px[row] + shift[row], axes[row], HALF).reshape(len(row), -1, 1)
            du, dv, contrast = np.matmul(to_parameters, found)[:, :, 0].astype(np.float64).T
            d = np.stack([du, dv], axis=1) / np.maximum(contrast, 0.3)[:, None]
            step[row] = np.linalg.norm(d, axis=1)
            d /= np.maximum(step[row], 1.0)[:, None]
            shift[row] -= np.einsum("nij,nj->ni", axes[row], d)
        found = sample(levels, uv_px[row] + shift[row], axes[row], HALF)
        agrees[row] = correlate(inner[row].reshape(found.shape), found) > AGREES
    agrees &= (step < CONVERGED) & (np.linalg.norm(shift, axis=1) < max_shift_px)
    return _Aligned(shift, tested, agrees)
