"""The built-in pixel matcher: sparse direct alignment of landmarks' patches, through motion blur and fast turns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.camera.base import Camera
from dualslam.core.config.problems import StrictModel
from dualslam.core.geometry import se3, so3
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.noise_model import DAMPING, GATE_SIGMAS, TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.direct.patches import MAX_LEVELS, SHARP, Patches, Smear, patches_of, smears
from dualslam.frontends.direct.warp import (
    AGREES,
    HALF,
    Pyramid,
    build_pyramid,
    correlate,
    inside,
    project_with_jacobians,
    sample,
)
from dualslam.frontends.registry import MATCHERS, parse_options

COARSE, SMEAR_LEVEL = (4, 3), 2
"""Levels of the pyramid for the first poses, and the one at which the smear is found."""
BETTER = 0.02
"""By how much a smear must raise the mean correlation, or the image counts as sharp."""
LONG_SMEAR_PX = 20.0
"""From this smear on (image of 640 pixels) the finest level is 2, not 1: what is finer is gone."""
N_FOR_SMEAR = 60
"""Patches by which the smear is found."""
N_STARTS = 2
"""Coarse poses that are refined: those under which most patches agree."""
PRIOR_PX = 1.0
"""By how much a patch may be from where the pose puts it, in pixels of the level: errors of depths and of the map."""
MIN_SIGMA_PX = 0.35
"""Noise of a patch's place, in pixels of its level."""
SMALL_PX = 100
"""Width down to which the images are halved."""
BLUR_PX = 1.2
TURN_ITERATIONS = 25
MIN_SHARE = 0.1
"""Of the image that both must show."""
CONVERGED_RAD = 1e-3
SAME_RAD = np.radians(1.0)
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


class DirectOptions(StrictModel):
    """`pixels.options` of this matcher."""

    min_share: float = Field(0.4, gt=0, le=1)
    """Share of the patches in view that must agree with the image (correlation above 0.7)."""
    min_patches: int = Field(30, ge=10)
    """Patches that must agree."""


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A pose, the smear under which it was found, and how many patches agree with it, times their share."""

    T_cam_submap: FloatArray
    smear: Smear
    score: float


class DirectMatcher:
    """Aligns an image with the patches of landmarks in older images, and follows each patch from there.

    1. Whole images give up to three turns from the last frame.
    2. Each is refined over the pose on coarse levels; the poses under which most patches agree stay.
    3. The straight smear of the patches that fits the image best is found.
    4. The pose is refined on finer levels, with the smear found once more.
    5. Patches are followed from where the pose puts them. Those that agree with the image are matches.
    """

    name = "direct"

    def __init__(self, options: DirectOptions | None = None) -> None:
        self.options = options or DirectOptions()

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> DirectMatcher:
        """Build from the config."""
        return cls(parse_options(DirectOptions, cls.name, options, MATCHERS))

    def find(
        self, references: tuple[PosedImage, ...], image: NDArray[np.uint8], camera: Camera, T_cam_submap: FloatArray
    ) -> PixelMatches:
        """Find landmarks of the references in an image: see `PixelMatcher.find`."""
        patches = patches_of(references, camera)
        if patches is None:
            return PixelMatches.none()
        levels = build_pyramid(image, MAX_LEVELS)
        scene = _Scene(patches, levels, camera)
        trials = [scene.coarse(T) for T in _starts(references[0], patches.references[0], levels, camera, T_cam_submap)]
        best = sorted((t for t in trials if t is not None), key=lambda t: -t.score)[:N_STARTS]
        refined = [t for t in map(scene.refined, best) if t is not None]
        if not refined:
            return PixelMatches.none()
        return self._followed(scene, max(refined, key=lambda t: t.score))

    def _followed(self, scene: _Scene, trial: _Trial) -> PixelMatches:
        """Return the patches that agree with the image near where the pose puts them, if enough do."""
        level, options = scene.finest(trial.smear), self.options
        given = scene.patches, scene.levels
        placed, _ = agreement(*given, scene.camera, trial.T_cam_submap, level, trial.smear)
        if len(placed.row) < options.min_patches:
            return PixelMatches.none()
        prior_px = PRIOR_PX * 2.0**level
        uv_px, sigma_px, correlation = shift(*given, placed, level, trial.smear, prior_px)
        kept = (correlation > AGREES) & (np.linalg.norm(uv_px - placed.uv_px, axis=1) < GATE_SIGMAS * prior_px)
        kept &= ((uv_px >= 0) & (uv_px <= np.array(scene.camera.size_px) - 1)).all(axis=1)
        if kept.sum() < max(options.min_patches, options.min_share * len(kept)):
            return PixelMatches.none()
        sigma_px = np.hypot(sigma_px[kept], MIN_SIGMA_PX * 2.0**level)
        return PixelMatches(scene.patches.landmark_ids[placed.row[kept]], uv_px[kept], sigma_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Patches, the image in which they are looked for, and its camera."""

    patches: Patches
    levels: Pyramid
    camera: Camera

    def finest(self, smear: Smear) -> int:
        """Return the finest level at which a pose is refined."""
        return 2 if smear.length_px > LONG_SMEAR_PX * self.camera.width / 640 else 1

    def coarse(self, T_cam_submap: FloatArray) -> _Trial | None:
        """Refine a first pose on coarse levels."""
        return self._trial(T_cam_submap, SHARP, COARSE)

    def refined(self, trial: _Trial) -> _Trial | None:
        """Find the smear and refine the pose with it, twice."""
        found: _Trial | None = trial
        for finest in (SMEAR_LEVEL, None):
            if found is None:
                return None
            smear = self.smear(found.T_cam_submap, found.smear)
            last = self.finest(smear) if finest is None else finest
            found = self._trial(found.T_cam_submap, smear, tuple(range(3, last - 1, -1)))
        return found

    def smear(self, T_cam_submap: FloatArray, known: Smear) -> Smear:
        """Return the smear of the patches that fits the image best under a pose; one near it may be known already."""
        placed, _ = agreement(self.patches, self.levels, self.camera, T_cam_submap, SMEAR_LEVEL, SHARP)
        chosen = np.arange(0, len(placed.row), max(len(placed.row) // N_FOR_SMEAR, 1))
        if len(chosen) == 0:
            return SHARP
        found = sample(self.levels, placed.uv_px[chosen], placed.axes[chosen], (self.patches.side - 1) // 2)

        def fit(smear: Smear) -> float:
            return float(correlate(self.patches.greys(placed.row[chosen], SMEAR_LEVEL, smear), found).mean())

        if known is SHARP:
            best = max(((fit(smear), smear) for smear in smears(self.camera.width)), key=lambda each: each[0])
            if best[0] < fit(SHARP) + BETTER:
                return SHARP
        else:
            best = fit(known), known
        about = [best, *((fit(smear), smear) for smear in best[1].about())]
        return max(about, key=lambda each: each[0])[1]

    def _trial(self, T_cam_submap: FloatArray, smear: Smear, levels: tuple[int, ...]) -> _Trial | None:
        T: FloatArray | None = T_cam_submap
        for level in levels:
            if level < len(self.levels) and T is not None:
                T = align(self.patches, self.levels, self.camera, T, level, smear)
        if T is None:
            return None
        level = min(levels[-1], len(self.levels) - 1)
        placed, correlation = agreement(self.patches, self.levels, self.camera, T, level, smear)
        n = int((correlation > AGREES).sum())
        return _Trial(T, smear, n * n / max(len(placed.row), 1))


def _starts(
    last: PosedImage, before: Pyramid, levels: Pyramid, camera: Camera, T_predicted: FloatArray
) -> list[FloatArray]:
    """Return first poses: the predicted place, turned as whole images say; and the prediction itself."""
    R_last, centre = se3.rotation(last.T_cam_submap), se3.translation(se3.inverse(T_predicted))
    found = turns(before, levels, camera, se3.rotation(T_predicted) @ R_last.T)
    poses = [T_predicted]
    for R_after_before in found:
        R = R_after_before @ R_last
        poses.append(se3.from_parts(R, -R @ centre))
    return poses


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
    for start in (R_predicted, so3.IDENTITY, by_shift):
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
        for _ in range(TURN_ITERATIONS):
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
