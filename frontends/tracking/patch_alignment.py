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
from dualslam.frontends.direct.warp import (
    HALF,
    Pyramid,
    build_pyramid,
    correlate,
    inside,
    sample,
    sample_each,
    warp_points,
)
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.row_shifts import find_as_read
from dualslam.map.submap import Submap

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
class _Pairs:
    """M observations, and for each an older one of the same landmark."""

    row: IntArray  # (M,): of the submap's observations
    kf: IntArray  # (M,)
    feature: IntArray  # (M,): of the keyframe
    landmark: IntArray  # (M,)
    kf_there: IntArray  # (M,): whose patch is the reference
    feature_there: IntArray  # (M,)
    depth_there: FloatArray  # (M,)


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
        self._pyramids = {k: levels for k, levels in self._pyramids.items() if k in self._images}
        self._patches = {k: patches for k, patches in self._patches.items() if k in self._images}
        pairs = self._pairs(submap, rows)
        if not len(pairs.row):
            return
        aligned = self._align_pairs(submap, pairs)
        contradicted = []
        for k in np.unique(pairs.kf).tolist():
            of = np.flatnonzero(pairs.kf == k)
            tested, agrees = aligned.tested[of], aligned.agrees[of]
            self._move(submap, k, pairs.feature[of[agrees]], aligned.shift_px[of[agrees]])
            if np.count_nonzero(agrees) > MAJORITY * np.count_nonzero(tested):
                contradicted.append(pairs.row[of[tested & ~agrees]])
        if contradicted:
            submap.remove_outliers(np.concatenate(contradicted))

    def _move(self, submap: Submap, k: int, feature: IntArray, shift_px: FloatArray) -> None:
        """Move features of a keyframe in its image."""
        camera, keyframe = self._camera(), submap.keyframes[k]
        uv, uv_rect = keyframe.features.uv_px.copy(), keyframe.features.uv_rect_px.copy()
        before, after = np.split(camera.rectify(np.concatenate([uv[feature], uv[feature] + shift_px]))[0], 2)
        uv[feature] += shift_px
        uv_rect[feature] += after - before
        submap.keyframes[k] = replace(keyframe, features=replace(keyframe.features, uv_px=uv, uv_rect_px=uv_rect))
        if k in self._patches:
            self._patches[k].forget(feature)

    def _pairs(self, submap: Submap, rows: IntArray) -> _Pairs:
        """Return the observations that have a reference, each with it.

        The reference is the observation that first described the landmark. Its image may not be kept, or show the
        landmark in another size. Then it is the farthest in time of those that stay where they are.
        """
        obs, ids = submap.observations, np.array([k for k in submap.keyframes if k in self._images], np.int64)
        to_depth = np.full((int(max(submap.keyframes)) + 1, 4), np.nan)
        to_depth[ids] = se3.inverse(submap.keyframe_poses(ids))[:, 2]
        is_kept, first = np.isfinite(to_depth[:, 3]), submap.landmarks["first_kf"]
        rows = rows[is_kept[obs["kf"][rows]] & (first[obs["landmark"][rows]] != obs["kf"][rows])]
        others = submap.rows_of_landmarks(obs["landmark"][rows])
        others = np.setdiff1d(others[is_kept[obs["kf"][others]]], rows, assume_unique=True)
        at, there = _joined(obs["landmark"][rows], obs["landmark"][others])
        row, other = rows[at], others[there]
        landmark, kf, kf_there = obs["landmark"][row], obs["kf"][row], obs["kf"][other]
        xyz1 = np.column_stack([submap.landmarks["xyz_mu"][landmark], np.ones(len(landmark))])
        depth, depth_there = (np.einsum("ij,ij->i", to_depth[k], xyz1) for k in (kf, kf_there))
        zoom = depth_there / np.maximum(depth, 1e-9)
        fits = np.flatnonzero((kf_there != kf) & (zoom < MAX_ZOOM) & (zoom > 1 / MAX_ZOOM))
        is_first = kf_there[fits] == first[landmark[fits]]
        order = fits[np.lexsort((-kf_there[fits], -np.abs(kf_there - kf)[fits], ~is_first, at[fits]))]
        best = order[np.unique(at[order], return_index=True)[1]]
        feature, feature_there = obs["feature"][row[best]], obs["feature"][other[best]]
        return _Pairs(row[best], kf[best], feature, landmark[best], kf_there[best], feature_there, depth_there[best])

    def _align_pairs(self, submap: Submap, pairs: _Pairs) -> _Aligned:
        camera, n = self._camera(), len(pairs.row)
        templates = np.zeros((n, 2 * HALF + 3, 2 * HALF + 3), np.float32)
        uv, uv_there, scale, own_scale = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.zeros(n)
        T_submap_there, T_k_submap = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
        for other in np.unique(pairs.kf_there).tolist():
            of = np.flatnonzero(pairs.kf_there == other)
            T_submap_there[of], feature = submap.T_submap_kf[other], pairs.feature_there[of]
            uv_there[of] = self._as_read(submap, other, feature, camera)
            scale[of] = submap.keyframes[other].features.scale[feature]
            templates[of] = self._templates(other, feature, uv_there[of], scale[of])
        keyframes, image_of = np.unique(pairs.kf, return_inverse=True)
        for k in keyframes.tolist():
            of = np.flatnonzero(pairs.kf == k)
            T_k_submap[of] = se3.inverse(submap.T_submap_kf[k])
            uv[of] = self._as_read(submap, k, pairs.feature[of], camera)
            own_scale[of] = submap.keyframes[k].features.scale[pairs.feature[of]]
        steps = scale[:, None, None] * np.eye(2)
        axes = steps @ warp_points(camera, uv_there, pairs.depth_there, T_k_submap @ T_submap_there).J_b_a
        usable = inside(uv_there, steps, HALF + 1, camera.size_px) & np.isfinite(axes).all(axis=(1, 2))
        usable[usable] = inside(uv[usable], axes[usable], HALF, camera.size_px)
        images = [self._levels(k) for k in keyframes.tolist()]
        return _align(templates, images, image_of, uv, axes, usable, REFINED_PX * own_scale)

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


def _joined(left: IntArray, right: IntArray) -> tuple[IntArray, IntArray]:
    """Return the positions of all pairs of equal values, by ascending position on the left."""
    order = np.argsort(right, kind="stable")
    begin, end = (np.searchsorted(right[order], left, side=side) for side in ("left", "right"))
    at = np.repeat(np.arange(len(left)), end - begin)
    within = np.arange(len(at)) - np.repeat(np.cumsum(end - begin) - (end - begin), end - begin)
    return at, order[begin[at] + within]


def _align(
    templates: NDArray[np.float32],
    images: list[Pyramid],
    image_of: IntArray,
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
            found = sample_each(images, image_of[row], uv_px[row] + shift[row], axes[row], HALF).reshape(
                len(row), -1, 1
            )
            du, dv, contrast = np.matmul(to_parameters, found)[:, :, 0].astype(np.float64).T
            d = np.stack([du, dv], axis=1) / np.maximum(contrast, 0.3)[:, None]
            step[row] = np.linalg.norm(d, axis=1)
            d /= np.maximum(step[row], 1.0)[:, None]
            shift[row] -= np.einsum("nij,nj->ni", axes[row], d)
        found = sample_each(images, image_of[row], uv_px[row] + shift[row], axes[row], HALF)
        agrees[row] = correlate(inner[row].reshape(found.shape), found) > AGREES
    agrees &= (step < CONVERGED) & (np.linalg.norm(shift, axis=1) < max_shift_px)
    return _Aligned(shift, tested, agrees)
