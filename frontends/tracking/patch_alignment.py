"""Positions of a keyframe's observations, refined by aligning image patches with those of older keyframes.

A detector places a corner in each image anew. Two patches of the same surface tell their shift several times better,
and patches that do not look alike tell of a wrong match.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.noise_model import MAJORITY, TINY
from dualslam.core.types import REFINED_PX, BoolArray, FloatArray, IntArray
from dualslam.frontends.direct.patches import MIN_CONTRAST
from dualslam.frontends.direct.warp import (
    HALF,
    Pyramid,
    Sampler,
    build_pyramid,
    correlate,
    inside,
    warp_points,
)
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.turning import find_as_read
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

    def take(self, of: IntArray | BoolArray) -> _Pairs:
        """Return some of them."""
        return _Pairs(*(getattr(self, field.name)[of] for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """Of M observations."""

    shift_px: FloatArray  # (M, 2): in the image
    tested: BoolArray  # (M,): both patches are in their images, and of enough contrast
    agrees: BoolArray  # (M,)


@dataclass(frozen=True, slots=True, eq=False)
class _Templates:
    """N patches about older observations, in their octaves."""

    greys: NDArray[np.float32]  # (N, S, S), S = 2 HALF + 1
    to_parameters: NDArray[np.float32]  # (N, 3, S^2): takes greys to a shift and a contrast
    is_sound: BoolArray  # (N,): of enough contrast, in both directions

    @classmethod
    def of(cls, patches: NDArray[np.float32]) -> _Templates:
        """Make them of patches (N, S + 2, S + 2), whose rim serves their gradients.

        Gauss-Newton with the templates' gradients (Baker and Matthews, IJCV 2004).
        """
        p = np.ascontiguousarray(patches.transpose(1, 2, 0))
        by_u, by_v, grey = 0.5 * (p[1:-1, 2:] - p[1:-1, :-2]), 0.5 * (p[2:, 1:-1] - p[:-2, 1:-1]), p[1:-1, 1:-1]
        J = np.stack([by_u, by_v, grey], axis=2).reshape(-1, 3, len(patches))
        J -= J.mean(axis=0)  # which leaves the mean free
        J = np.ascontiguousarray(J.transpose(2, 0, 1))
        H = np.matmul(J.swapaxes(1, 2), J).astype(np.float64)
        low, high = np.linalg.eigvalsh(H[:, :2, :2]).T
        is_sound = (high < MAX_CONDITION * low) & (H[:, 2, 2] > MIN_CONTRAST**2 * J.shape[1])
        H[~is_sound] = np.eye(3)
        to_parameters = np.matmul(J.astype(np.float64), np.linalg.inv(H).swapaxes(1, 2)).swapaxes(1, 2)
        to_parameters = np.ascontiguousarray(to_parameters, np.float32)
        return cls(patches[:, 1:-1, 1:-1], to_parameters, is_sound)


class PatchAlignment:
    """Aligns observations of a submap with each other, as far as the images of their keyframes are kept."""

    def __init__(self, images: KeyframeImages, camera: Callable[[], Camera]) -> None:
        self._images, self._camera = images, camera
        self._pyramids: dict[int, Pyramid] = {}
        self._templates = defaultdict[int, dict[int, tuple[Any, ...]]](dict)  # by keyframe and feature, each made once

    def refine(self, submap: Submap, rows: IntArray) -> None:
        """Move the pixels of observations to where their patches match, and remove those that match nowhere near."""
        for k in [k for k in self._pyramids if k not in self._images]:
            del self._pyramids[k]
            self._templates.pop(k, None)
        pairs = self._pairs(submap, rows)
        tested, agrees = np.zeros(len(pairs.row), np.bool_), np.zeros(len(pairs.row), np.bool_)
        for of in _in_turn(pairs):
            part = pairs.take(of)
            aligned = self._align_pairs(submap, part)
            tested[of], agrees[of] = aligned.tested, aligned.agrees
            self._move(submap, part.take(aligned.agrees), aligned.shift_px[aligned.agrees])
        kf = pairs.kf
        most = np.bincount(kf, agrees) > MAJORITY * np.bincount(kf, tested)
        contradicted = pairs.row[tested & ~agrees & most[kf]]
        if len(contradicted):
            submap.remove_outliers(contradicted)

    def _move(self, submap: Submap, pairs: _Pairs, shift_px: FloatArray) -> None:
        """Move features in the images of their keyframes."""
        n, uv_px = len(pairs.kf), np.zeros((len(pairs.kf), 2))
        keyframes = {k: np.flatnonzero(pairs.kf == k) for k in np.unique(pairs.kf).tolist()}
        for k, of in keyframes.items():
            uv_px[of] = submap.keyframes[k].features.uv_px[pairs.feature[of]]
        # One call for all: taking a lens out costs more by the call than by the pixel.
        uv_rect_px, _ = self._camera().rectify(np.concatenate([uv_px, uv_px + shift_px]))
        for k, of in keyframes.items():
            keyframe, at = submap.keyframes[k], pairs.feature[of]
            features = keyframe.features
            uv, uv_rect = features.uv_px.copy(), features.uv_rect_px.copy()
            uv[at] += shift_px[of]
            uv_rect[at] += uv_rect_px[n + of] - uv_rect_px[of]
            submap.keyframes[k] = replace(keyframe, features=replace(features, uv_px=uv, uv_rect_px=uv_rect))
            for feature in at.tolist():
                self._templates[k].pop(feature, None)

    def _pairs(self, submap: Submap, rows: IntArray) -> _Pairs:
        """Return the observations that have a reference, each with it.

        The reference first described the landmark. Where its image is not kept, or shows another size, it is the
        farthest in time.
        """
        obs, first = submap.observations, submap.landmarks["first_kf"]
        kept = np.array(sorted(k for k in submap.keyframes if k in self._images), np.int64)
        rows = rows[np.isin(obs["kf"][rows], kept) & (first[obs["landmark"][rows]] != obs["kf"][rows])]
        others = submap.rows_of_landmarks(obs["landmark"][rows])
        others = others[np.isin(obs["kf"][others], kept)]
        at, there = _joined(obs["landmark"][rows], obs["landmark"][others])
        row, other = rows[at], others[there]
        landmark, kf, kf_there = obs["landmark"][row], obs["kf"][row], obs["kf"][other]
        ids, column = np.unique(landmark, return_inverse=True)
        depths = [submap.depths(ids, se3.inverse(submap.T_submap_kf[k])) for k in kept.tolist()]
        at_kf = np.searchsorted(kept, (kf, kf_there))
        depth, depth_there = np.array(depths).reshape(len(kept), len(ids))[at_kf, column]
        zoom = depth_there / np.maximum(depth, TINY)
        fits = np.flatnonzero((kf_there != kf) & (zoom < MAX_ZOOM) & (zoom > 1 / MAX_ZOOM))
        is_first = kf_there[fits] == first[landmark[fits]]
        order = fits[np.lexsort((-kf_there[fits], -np.abs(kf_there - kf)[fits], ~is_first, at[fits]))]
        best = order[np.unique(at[order], return_index=True)[1]]
        feature, feature_there = obs["feature"][row[best]], obs["feature"][other[best]]
        return _Pairs(row[best], kf[best], feature, landmark[best], kf_there[best], feature_there, depth_there[best])

    def _align_pairs(self, submap: Submap, pairs: _Pairs) -> _Aligned:
        camera, n = self._camera(), len(pairs.row)
        uv, uv_there, scale, own_scale = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.zeros(n)
        T_submap_there, T_k_submap = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
        for other in np.unique(pairs.kf_there).tolist():
            of = np.flatnonzero(pairs.kf_there == other)
            T_submap_there[of], feature = submap.T_submap_kf[other], pairs.feature_there[of]
            uv_there[of] = self._as_read(submap, other, feature, camera)
            scale[of] = submap.keyframes[other].features.scale[feature]
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
        templates = self._templates_about(pairs, uv_there, steps)
        return _align(templates, images, image_of, uv, axes, usable, REFINED_PX * own_scale)

    def _templates_about(self, pairs: _Pairs, uv_px: FloatArray, steps: FloatArray) -> _Templates:
        """Return the templates about the older observations."""
        keys = list(zip(pairs.kf_there.tolist(), pairs.feature_there.tolist(), strict=True))
        row_of_new = {(k, feature): row for row, (k, feature) in enumerate(keys) if feature not in self._templates[k]}
        if row_of_new:  # one call for all
            row = np.array(list(row_of_new.values()))
            new, image_of = np.unique(pairs.kf_there[row], return_inverse=True)
            images = [self._levels(k) for k in new.tolist()]
            made = _Templates.of(Sampler(images, image_of, steps[row], HALF + 1)(uv_px[row]))
            each = zip(made.greys, made.to_parameters, made.is_sound, strict=True)
            for (k, feature), template in zip(row_of_new, each, strict=True):
                self._templates[k][feature] = template
        side = 2 * HALF + 1
        greys, to_parameters, is_sound = zip(*(self._templates[k][feature] for k, feature in keys), strict=True)
        return _Templates(
            np.concatenate(greys).reshape(-1, side, side),
            np.concatenate(to_parameters).reshape(-1, 3, side**2),
            np.array(is_sound),
        )

    def _as_read(self, submap: Submap, k: int, feature: IntArray, camera: Camera) -> FloatArray:
        """Return where a keyframe's image shows features."""
        features, turn_rad = submap.keyframes[k].features, self._images[k].turn_rad
        uv = features.uv_px[feature]
        return uv if turn_rad is None else find_as_read(uv, features.uv_rect_px[feature], camera, turn_rad)

    def _levels(self, k: int) -> Pyramid:
        if k not in self._pyramids:
            self._pyramids[k] = build_pyramid(self._images[k].image.pixels())
        return self._pyramids[k]


def _in_turn(pairs: _Pairs) -> list[IntArray]:
    """Return which pairs to align at once: as keyframe by keyframe, each against patches that have moved before."""
    n = 1 + int(max(pairs.feature.max(initial=0), pairs.feature_there.max(initial=0)))
    at, moves = _joined(pairs.kf_there * n + pairs.feature_there, pairs.kf * n + pairs.feature)
    first = pairs.kf[moves] < pairs.kf[at]
    at, moves = at[first], moves[first]
    turn, later = np.full(len(pairs.kf), -1), np.zeros(len(pairs.kf), np.int64)
    while not np.array_equal(turn, later):
        turn = later.copy()
        later[at] = turn[moves] + 1
    return [np.flatnonzero(turn == k) for k in range(1 + int(turn.max(initial=-1)))]


def _joined(left: IntArray, right: IntArray) -> tuple[IntArray, IntArray]:
    """Return the positions of all pairs of equal values, by ascending position on the left."""
    order = np.argsort(right, kind="stable")
    begin, end = (np.searchsorted(right[order], left, side=side) for side in ("left", "right"))
    at = np.repeat(np.arange(len(left)), end - begin)
    within = np.arange(len(at)) - np.repeat(np.cumsum(end - begin) - (end - begin), end - begin)
    return at, order[begin[at] + within]


def _align(
    templates: _Templates,
    images: list[Pyramid],
    image_of: IntArray,
    uv_px: FloatArray,
    axes: FloatArray,
    usable: BoolArray,
    max_shift_px: FloatArray,
) -> _Aligned:
    """Shift patches of an image until they look like templates, up to contrast and mean."""
    n, tested = len(uv_px), usable & templates.is_sound
    row, shift, agrees = np.flatnonzero(tested), np.zeros((n, 2)), np.zeros(n, np.bool_)
    if len(row):
        to_parameters, axes, begin, moved = templates.to_parameters[row], axes[row], uv_px[row], shift[row]
        sampler = Sampler(images, image_of[row], axes, HALF)
        for _ in range(N_ITERATIONS):
            found = sampler(begin + moved).reshape(len(row), -1, 1)
            du, dv, contrast = np.matmul(to_parameters, found)[:, :, 0].astype(np.float64).T
            d = np.stack([du, dv], axis=1) / np.maximum(contrast, 0.3)[:, None]
            step = np.linalg.norm(d, axis=1)
            d /= np.maximum(step, 1.0)[:, None]
            moved -= np.einsum("nij,nj->ni", axes, d)
        similar = correlate(templates.greys[row], sampler(begin + moved)) > AGREES
        agrees[row] = similar & (step < CONVERGED) & (np.linalg.norm(moved, axis=1) < max_shift_px[row])
        shift[row] = moved
    return _Aligned(shift, tested, agrees)
