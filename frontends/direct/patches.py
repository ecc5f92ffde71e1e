"""Patches of landmarks in posed images, as templates for another image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.matchers import PosedImage
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.direct.warp import HALF, Pyramid, build_pyramid, inside, sample

MIN_LENGTH_PX = 1.2
"""Shorter smears leave an image as it is."""


@dataclass(frozen=True, slots=True)
class Smear:
    """A straight smear, its middle where the pixel was: direction (clockwise from +u) and length in the image."""

    angle_rad: float = 0.0
    length_px: float = 0.0

    def of(self, image: NDArray[np.float32], level: int) -> NDArray[np.float32]:
        """Return a level of a pyramid as the smear leaves it."""
        kernel = _line(self.angle_rad, self.length_px / 2.0**level)
        if kernel is None:
            return image
        return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)

    def about(self) -> list[Smear]:
        """Return the smears half a step away in direction and in length."""
        by = (-0.5, 0.5)
        return [
            *(Smear(self.angle_rad + each * np.pi / N_ANGLES, self.length_px) for each in by),
            *(Smear(self.angle_rad, self.length_px * HALF_STEP**sign) for sign in (-1, 1)),
        ]


SHARP = Smear()
HALF_STEP = 1.25
"""In length: of the ratio of two that are tried."""
LENGTHS_PX = (6.0, 12.0, 24.0, 40.0, 60.0)
"""Smears of an image of 640 pixels that are tried: steps of 1.5 to 2 cost a correlation of 0.02 at most."""
N_ANGLES = 8


def smears(width_px: int) -> list[Smear]:
    """Return the smears that are tried in an image so wide."""
    angles = np.arange(N_ANGLES) * np.pi / N_ANGLES
    return [Smear(float(a), n * width_px / 640) for n in LENGTHS_PX for a in angles]


def _line(angle_rad: float, length_px: float) -> NDArray[np.float32] | None:
    """Return the kernel of a smear; None where it is too short to matter."""
    if length_px < MIN_LENGTH_PX:
        return None
    half = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    along = np.linspace(-length_px / 2, length_px / 2, max(int(4 * length_px), 9))
    x, y = half + along * np.cos(angle_rad), half + along * np.sin(angle_rad)
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - column, y - row
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (fy if down else 1 - fy) * (fx if right else 1 - fx)
        np.add.at(kernel, (row + down, column + right), weight)
    return np.asarray(kernel / kernel.sum(), np.float32)


MAX_LEVELS = 5
MIN_CONTRAST = 3.0
"""Standard deviation of a patch's greys: less is noise."""
MIN_SHARPNESS = 0.5
"""Gradient energy of a reference relative to the sharpest one's: below, it is blurred, and its patches are not used."""
MAX_PATCHES = 400


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Patches at one level of the pyramid, under one smear; the mean of each is 0."""

    greys: NDArray[np.float32]  # (N, 9, 9)
    gradient: FloatArray  # (N, 49, 2): of the inner 7 x 7 pixels by the patch's own columns and rows
    usable: BoolArray  # (N,): in the image, and of enough contrast


@dataclass(frozen=True, eq=False)
class Patches:
    """N landmarks with a patch each, of one of several references."""

    landmark_ids: IntArray  # (N,)
    xyz: FloatArray  # (N, 3): where the landmark's pixel is, in the submap
    J: FloatArray  # (N, 3, 2): how that place moves with the pixel, the plane of the patch parallel to its image
    of: IntArray  # (N,): row of its reference
    uv_px: FloatArray  # (N, 2): where the reference shows it
    references: list[Pyramid]
    _kept: dict[tuple[int, Smear], Templates] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.landmark_ids)

    @property
    def side(self) -> int:
        """Pixels along a side of a patch."""
        return 2 * HALF + 1

    def templates(self, level: int, smear: Smear) -> Templates:
        """Return the patches at a level, smeared; each kind is made once."""
        if (level, smear) not in self._kept:
            greys = self.greys(np.arange(len(self)), level, smear)
            axes = np.broadcast_to(2.0**level * np.eye(2), (len(self), 2, 2))
            usable = inside(self.uv_px, axes, HALF, self.references[0][0].shape[::-1])
            usable &= greys.std(axis=(1, 2)) >= MIN_CONTRAST
            du, dv = greys[:, 1:-1, 2:] - greys[:, 1:-1, :-2], greys[:, 2:, 1:-1] - greys[:, :-2, 1:-1]
            gradient = np.stack([du, dv], axis=-1).reshape(len(self), -1, 2).astype(np.float64) / 2
            self._kept[level, smear] = Templates(greys, gradient, usable)
        return self._kept[level, smear]

    def greys(self, rows: IntArray, level: int, smear: Smear) -> NDArray[np.float32]:
        """Return patches (N, 9, 9) at a level, smeared."""
        greys = np.zeros((len(rows), self.side, self.side), np.float32)
        for i in np.unique(self.of[rows]).tolist():
            of = np.flatnonzero(self.of[rows] == i)
            smeared = list(self.references[i])
            smeared[level] = smear.of(smeared[level], level)
            axes = np.broadcast_to(2.0**level * np.eye(2), (len(of), 2, 2))
            greys[of] = sample(smeared, self.uv_px[rows[of]], axes, HALF)
        return greys


def patches_of(references: Sequence[PosedImage], camera: Camera) -> Patches | None:
    """Take each landmark's patch from the first sharp reference that shows it; None without any."""
    pyramids = [build_pyramid(reference.image, MAX_LEVELS) for reference in references]
    energy = np.array([_gradient_energy(levels) for levels in pyramids])
    sharp = np.flatnonzero(energy >= MIN_SHARPNESS * energy.max())
    ids, of, row = (np.zeros(0, np.int64) for _ in range(3))
    for i in sharp.tolist():
        new = np.flatnonzero(~np.isin(references[i].landmark_ids, ids))
        ids = np.concatenate([ids, references[i].landmark_ids[new]])
        of, row = np.concatenate([of, np.full(len(new), i)]), np.concatenate([row, new])
    if len(ids) == 0:
        return None
    chosen = np.unique(np.linspace(0, len(ids) - 1, min(len(ids), MAX_PATCHES)).astype(np.int64))
    ids, of, row = ids[chosen], of[chosen], row[chosen]
    xyz, J, uv = np.empty((len(ids), 3)), np.empty((len(ids), 3, 2)), np.empty((len(ids), 2))
    for i in sharp.tolist():
        mine, reference = of == i, references[i]
        uv[mine], depth = reference.uv_px[row[mine]], reference.depth_mu[row[mine]]
        moved = (uv[mine] + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[:, None]).reshape(-1, 2)
        rays = camera.unproject(moved)
        here, right, down = (rays * (np.tile(depth, 3) / rays[:, 2])[:, None]).reshape(3, -1, 3)
        T_submap_cam = se3.inverse(reference.T_cam_submap)
        xyz[mine] = se3.act(T_submap_cam, here)
        J[mine] = se3.rotation(T_submap_cam) @ np.stack([right - here, down - here], axis=2)
    return Patches(ids, xyz, J, of, uv, pyramids)


def _gradient_energy(levels: Pyramid) -> float:
    """Return the mean squared difference of neighbouring pixels, relative to the image's variance."""
    image = levels[min(1, len(levels) - 1)]
    steps = float((np.diff(image, axis=0) ** 2).mean() + (np.diff(image, axis=1) ** 2).mean())
    return steps / max(float(image.var()), 1e-6)
