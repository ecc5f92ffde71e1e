"""The turn between two frames by their whole images: a first guess where nothing else is known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray
from dualslam.frontends.direct.warp import Pyramid, project_with_jacobians

SMALL_PX = 100
"""Width down to which the images are halved."""
BLUR_PX = 1.2
N_ITERATIONS = 25
MIN_SHARE = 0.1
"""Of the image that both must show."""
CONVERGED_RAD = 1e-3
SAME_RAD = np.radians(1.0)


def turns(before: Pyramid, after: Pyramid, camera: Camera, R_predicted: FloatArray) -> list[FloatArray]:
    """Return rotations ``R_after_before``, the best first: from the predicted one, from rest, and by correlation."""
    level = min(int(np.ceil(np.log2(max(before[0].shape[1] / SMALL_PX, 1)))), len(before) - 1)
    a, b = (cv2.GaussianBlur(levels[level], (0, 0), BLUR_PX) for levels in (before, after))
    height, width = a.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(np.float64)
    rays = camera.unproject(grid * 2.0**level)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    du, dv = (cv2.Scharr(a, cv2.CV_32F, *order, scale=1 / 32).ravel() / 2.0**level for order in ((1, 0), (0, 1)))
    _, J_point = project_with_jacobians(camera, rays)
    by_point = du[:, None] * J_point[:, 0] + dv[:, None] * J_point[:, 1]
    held = np.flatnonzero(np.isfinite(by_point).all(axis=1))
    reference = _Small(a.ravel()[held].astype(np.float64), rays[held], -np.cross(by_point, rays)[held])
    (shift_u, shift_v), _ = cv2.phaseCorrelate(a, b, cv2.createHanningWindow((width, height), cv2.CV_32F))
    K = camera.K / 2.0**level
    by_shift = so3.exp(np.array([-shift_v / K[1, 1], shift_u / K[0, 0], 0.0]))
    found: list[tuple[float, FloatArray]] = []
    for start in (R_predicted, np.eye(3), by_shift):
        correlation, R = reference.turn_to(np.asarray(b, np.float32), camera, start, 2.0**level)
        if correlation > 0 and not any(np.linalg.norm(so3.log(R.T @ other)) < SAME_RAD for _, other in found):
            found.append((correlation, R))
    return [R for _, R in sorted(found, key=lambda each: -each[0])]


class _Small:
    """A small image: greys (N,), rays (N, 3), and derivatives (N, 3) of the greys by a turn of the rays."""

    def __init__(self, greys: FloatArray, rays: FloatArray, J: FloatArray) -> None:
        self._greys, self._rays, self._J = greys, rays, J

    def turn_to(self, other: NDArray[np.float32], camera: Camera, R: FloatArray, px: float) -> tuple[float, FloatArray]:
        """Return the turn to another small image, and the correlation under it; -1 where they share too little."""
        size = np.array(other.shape[::-1])
        contrast, mean = 1.0, 0.0
        for _ in range(N_ITERATIONS):
            uv = camera.project(self._rays @ R.T) / px
            seen = np.flatnonzero(((uv > 1) & (uv < size - 2)).all(axis=1))
            if len(seen) < MIN_SHARE * len(self._greys):
                return -1.0, R
            u, v = uv[seen].astype(np.float32).T
            grey = cv2.remap(other, u[None], v[None], cv2.INTER_LINEAR)[0].astype(np.float64)
            r = contrast * self._greys[seen] + mean - grey
            s = 1.4826 * float(np.median(np.abs(r))) + 1.0
            A = np.column_stack([contrast * self._J[seen], self._greys[seen], np.ones(len(seen))])
            Aw = A / (5.0 + (r / s) ** 2)[:, None]
            step = -np.linalg.solve(Aw.T @ A + 1e-6 * np.eye(5), Aw.T @ r)
            R = R @ so3.exp(-step[:3])
            contrast, mean = float(np.clip(contrast + step[3], 0.05, 8.0)), mean + float(step[4])
            if np.linalg.norm(step[:3]) < CONVERGED_RAD:
                break
        return float(np.corrcoef(self._greys[seen], grey)[0, 1]), R
