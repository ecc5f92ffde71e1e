"""The pose under which an image looks like the patches of older ones, and where it shows each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.noise_model import DAMPING, TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.direct.patches import Patches, Smear
from dualslam.frontends.direct.warp import HALF, Pyramid, correlate, inside, project_with_jacobians, sample

INNER = HALF - 1
N_ITERATIONS = 8
CONVERGED_PX = 0.02
"""Median step of the patches, in pixels of the level."""
NOISE = 3.0
"""Grey levels: least scale of the residuals, as cameras and interpolation have it."""
STUDENT = 5.0
"""Degrees of freedom of the residuals' distribution, as images have it (Kerl, ICRA 2013)."""
MIN_PATCHES = 20
MAX_ZOOM = 2.0
"""Change of size that the patch's plane, taken parallel to its image, tolerates."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where a pose puts M of the patches in the image."""

    row: IntArray  # (M,): of the patches: those that are wholly in the image and of enough contrast
    uv_px: FloatArray  # (M, 2)
    axes: FloatArray  # (M, 2, 2): steps in the image from one pixel of the patch to its neighbours
    J_pose: FloatArray  # (M, 2, 6): of the pixel by a left perturbation of the pose (rotation, translation)


def place(patches: Patches, camera: Camera, T_cam_submap: FloatArray, level: int, usable: BoolArray) -> Placed:
    """Project patches into the image by a pose."""
    R = se3.rotation(T_cam_submap)
    p = patches.xyz @ R.T + se3.translation(T_cam_submap)
    uv, J_point = project_with_jacobians(camera, p)
    axes = 2.0**level * (J_point @ (R @ patches.J))
    zoom2 = np.abs(axes[:, 0, 0] * axes[:, 1, 1] - axes[:, 0, 1] * axes[:, 1, 0]) / 4.0**level
    ok = usable & (p[:, 2] > 0) & (zoom2 < MAX_ZOOM**2) & (zoom2 > MAX_ZOOM**-2)
    row = np.flatnonzero(ok & inside(uv, axes, HALF, camera.size_px))
    by_turn = np.cross(J_point[row], p[row, None]) * -1.0  # d(R p) = turn x p
    return Placed(row, uv[row], axes[row], np.concatenate([by_turn, J_point[row]], axis=2))


def align(
    patches: Patches, levels: Pyramid, camera: Camera, T_cam_submap: FloatArray, level: int, smear: Smear
) -> FloatArray | None:
    """Refine a pose at one level of the pyramid; None where too few patches are in the image.

    Gauss-Newton over the pose. Each patch has a mean of its own in the image, all have one contrast. Pixels weigh as
    Student's t distribution has it. The gradients are those of the templates (Baker and Matthews, IJCV 2004).
    """
    templates, T = patches.templates(level, smear), T_cam_submap
    for _ in range(N_ITERATIONS):
        placed = place(patches, camera, T, level, templates.usable)
        if len(placed.row) < MIN_PATCHES:
            return None
        found = sample(levels, placed.uv_px, placed.axes, INNER)
        M, m = _normal_parts(templates.greys[placed.row], templates.gradient[placed.row], found)
        B = np.linalg.inv(placed.axes)
        J = B @ placed.J_pose
        H = np.einsum("nia,nij,njb->ab", J, M, J, optimize=True)
        g = np.einsum("nia,ni->a", J, m)
        scale = np.sqrt(np.diag(H)) + TINY
        xi = -np.linalg.solve(H / np.outer(scale, scale) + DAMPING * np.eye(se3.DOF), g / scale) / scale
        T = np.asarray(se3.exp(xi) @ T)
        if np.median(np.linalg.norm(J @ xi, axis=1)) < CONVERGED_PX:
            break
    return T


def _normal_parts(
    greys: NDArray[np.float32], gradient: FloatArray, found: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray]:
    """Return, for each patch, the normal equations of its shift in its own pixels: (M, 2, 2) and (M, 2)."""
    template = greys[:, 1:-1, 1:-1].reshape(len(greys), -1).astype(np.float64)
    image = found.reshape(len(found), -1).astype(np.float64)
    template = template - template.mean(axis=1, keepdims=True)
    image = image - image.mean(axis=1, keepdims=True)
    contrast = max(float((template * image).sum() / max(float((template * template).sum()), TINY)), 0.1)
    r = image - contrast * template
    s = max(1.4826 * float(np.median(np.abs(r))), NOISE)
    w = (STUDENT + 1) / (STUDENT + (r / s) ** 2) / s**2
    g = contrast * gradient
    wg = w[..., None] * g
    return wg.swapaxes(1, 2) @ g, (wg.swapaxes(1, 2) @ r[..., None])[..., 0]


def agreement(
    patches: Patches, levels: Pyramid, camera: Camera, T_cam_submap: FloatArray, level: int, smear: Smear
) -> tuple[Placed, FloatArray]:
    """Return where a pose puts the patches, and how well the image agrees with each there (correlation)."""
    templates = patches.templates(level, smear)
    placed = place(patches, camera, T_cam_submap, level, templates.usable)
    found = sample(levels, placed.uv_px, placed.axes, HALF)
    return placed, correlate(templates.greys[placed.row], found)


def shift(
    patches: Patches, levels: Pyramid, placed: Placed, level: int, smear: Smear, prior_px: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Follow each patch from where the pose puts it.

    Returns pixels (M, 2); their sigmas (M,) in the direction that is known worse, with a prior of `prior_px` about the
    pose's place; and correlations (M,).
    """
    templates = patches.templates(level, smear)
    greys, gradient = templates.greys[placed.row], templates.gradient[placed.row]
    B = np.linalg.inv(placed.axes)
    d = np.zeros((len(placed.row), 2))
    H = np.zeros((len(placed.row), 2, 2))
    for _ in range(3):
        found = sample(levels, placed.uv_px + d, placed.axes, INNER)
        M, m = _normal_parts(greys, gradient, found)
        H = B.swapaxes(1, 2) @ M @ B + np.eye(2) / prior_px**2
        g = (B.swapaxes(1, 2) @ m[..., None])[..., 0] + d / prior_px**2
        d = d - np.linalg.solve(H, g[..., None])[..., 0]
    uv = placed.uv_px + d
    correlation = correlate(greys, sample(levels, uv, placed.axes, HALF))
    return uv, np.sqrt(np.linalg.eigvalsh(np.linalg.inv(H))[:, -1]), correlation
