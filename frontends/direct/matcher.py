"""The built-in pixel matcher: sparse direct alignment of landmarks' patches, through motion blur and fast turns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.camera.base import Camera
from dualslam.core.config.strict_model import StrictModel
from dualslam.core.geometry import se3
from dualslam.core.pixels import PixelMatches, PosedImage
from dualslam.core.types import FloatArray
from dualslam.frontends.direct.alignment import agreement, align, shift
from dualslam.frontends.direct.patches import MAX_LEVELS, Patches, patches_of
from dualslam.frontends.direct.smear import SHARP, Smear, smears
from dualslam.frontends.direct.turn import turns
from dualslam.frontends.direct.warp import Pyramid, build_pyramid, correlate, sample
from dualslam.frontends.registry import MATCHERS, parse_options

AGREES = 0.7
"""Correlation of a patch that is where the pose puts it, as in the photometric audit."""
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
        self,
        references: tuple[PosedImage, ...],
        image: NDArray[np.uint8],
        camera: Camera,
        T_cam_submap: FloatArray,
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
        kept = (correlation > AGREES) & (np.linalg.norm(uv_px - placed.uv_px, axis=1) < 3.0 * prior_px)
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
    R_last, centre = last.T_cam_submap[:3, :3], se3.inverse(T_predicted)[:3, 3]
    found = turns(before, levels, camera, T_predicted[:3, :3] @ R_last.T)
    poses = [T_predicted]
    for R_after_before in found:
        R = R_after_before @ R_last
        poses.append(se3.from_parts(R, -R @ centre))
    return poses
