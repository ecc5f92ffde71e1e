"""Keypoints of an image pyramid: maxima of a response at each level, described by RootSIFT."""

from __future__ import annotations

from dataclasses import dataclass

import kornia.feature as kf
import numpy as np
import torch
from kornia.geometry.subpix import nms2d
from torch.nn.functional import interpolate

from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.features.corners import grades, quadratic_peak, select_spread, share_out
from dualslam.frontends.features.kornia.options import KorniaOptions

PATCH_PX = 32
"""Side of the patch that the descriptor is given: each pixel of the level once."""
MARGIN_PX = 16
"""Rim of each level without keypoints: half of a patch."""
NMS_PX = 5
ORIENTATION_PATCH_PX = 19
GREY = 1.0 / 255.0
"""One grey level: the least height of a maximum is what so much contrast makes."""


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Keypoints of one image, finest octave first."""

    uv_px: FloatArray  # (N, 2)
    octave: IntArray  # (N,)
    refined: BoolArray  # (N,): whether the maximum was found between the pixels too


class LevelFeatures:
    """Detector, orientation and descriptor of `dog` and `harris`.

    `n_features`: keypoints per image, at most.
    """

    def __init__(self, options: KorniaOptions, n_features: int, device: torch.device) -> None:
        self._is_harris = options.detector == "harris"
        self._n_features = n_features
        self._scale_factor, self._n_octaves = options.scale_factor, options.n_octaves
        self._orientation = kf.LAFOrienter(ORIENTATION_PATCH_PX).to(device)
        self._descriptor = kf.SIFTDescriptor(PATCH_PX, rootsift=True).to(device)

    def detect(self, image: torch.Tensor) -> Detections:
        """Find at most `n_features` well-spread keypoints in a grey image (1, 1, H, W) of 0 to 1."""
        levels, heights = [], []
        for octave, level in enumerate(self._pyramid(image)):
            response = kf.harris_response(level) if self._is_harris else kf.dog_response_single(level).abs()
            least = GREY**4 if self._is_harris else GREY  # Harris' response is of the fourth order in the gradient
            peaks = nms2d(response, (NMS_PX, NMS_PX), mask_only=True) & (response > least)
            peaks[:, :, :MARGIN_PX], peaks[:, :, -MARGIN_PX:] = False, False
            peaks[:, :, :, :MARGIN_PX], peaks[:, :, :, -MARGIN_PX:] = False, False
            ratio = np.array([image.shape[3] / level.shape[3], image.shape[2] / level.shape[2]])
            xy, refined, height = _between_pixels(peaks[0, 0], response[0, 0])
            # Levels share the outer edges of the image, so it is pixel edges that scale, not centres.
            levels.append(Detections((xy + 0.5) * ratio - 0.5, np.full(len(xy), octave), refined))
            heights.append(height)
        return self._choose(levels, heights)

    def describe(self, image: torch.Tensor, detections: Detections) -> tuple[FloatArray, torch.Tensor]:
        """Return the orientations (N,), clockwise from +u in radians, and descriptors (N, 128) on the device."""
        centre = torch.from_numpy(detections.uv_px).to(image)[None]
        scale = torch.from_numpy(PATCH_PX / 2 * self._scale_factor**detections.octave).to(image)
        frames = kf.laf_from_center_scale_ori(centre, scale.reshape(1, -1, 1, 1), torch.zeros_like(centre[..., :1]))
        frames = self._orientation(frames, image)
        descriptors = kf.get_laf_descriptors(image, frames, self._descriptor, PATCH_PX)[0]
        axis = frames[0, :, :, 0].double().cpu().numpy()
        return np.arctan2(axis[:, 1], axis[:, 0]), descriptors

    def _pyramid(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Levels from the image itself down to the last that is wider than two rims."""
        levels = [image]
        height, width = image.shape[2:]
        for octave in range(1, self._n_octaves):
            size = (round(height / self._scale_factor**octave), round(width / self._scale_factor**octave))
            if min(size) <= 2 * MARGIN_PX:
                break
            levels.append(interpolate(levels[-1], size, mode="bilinear", align_corners=False, antialias=True))
        return levels

    def _choose(self, levels: list[Detections], heights: list[FloatArray]) -> Detections:
        """Keep the strongest that cover each level; as many per octave as its side is long."""
        weights = self._scale_factor ** -np.arange(len(levels), dtype=np.float64)
        quotas = share_out([len(level.uv_px) for level in levels], weights, self._n_features)
        chosen = [
            (level, select_spread(level.uv_px.astype(np.int64), grades(height), quota))
            for level, height, quota in zip(levels, heights, quotas, strict=True)
        ]
        return Detections(
            np.concatenate([level.uv_px[rows] for level, rows in chosen]),
            np.concatenate([level.octave[rows] for level, rows in chosen]),
            np.concatenate([level.refined[rows] for level, rows in chosen]),
        )


def _between_pixels(peak: torch.Tensor, response: torch.Tensor) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Fit a parabola to the 3 x 3 neighbourhood of each peak (H, W) of a level; none of them is at the edge.

    Returns the maxima (N, 2), row by row, whether the parabola has one within 0.75 px, and the response at the pixel.
    Without one, the maximum is the pixel.
    """
    v, u = torch.nonzero(peak, as_tuple=True)
    step = torch.arange(-1, 2, device=peak.device)
    r = response[v[:, None, None] + step[:, None], u[:, None, None] + step].double().cpu().numpy()
    offset, refined = quadratic_peak(r)
    xy = torch.stack([u, v], dim=1).double().cpu().numpy()
    return xy + np.where(refined[:, None], offset, 0.0), refined, r[:, 1, 1]
