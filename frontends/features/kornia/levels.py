"""Keypoints of an image pyramid: maxima of a response at each level, described by what is around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import kornia.feature as kf
import numpy as np
import torch
from kornia.geometry.subpix import nms2d
from torch.nn.functional import interpolate

from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.features.corners import grades, quadratic_peak, select_spread, share_out
from dualslam.frontends.features.kornia.checkpoints import AFFNET, HARDNET, KEYNET, ORINET
from dualslam.frontends.features.kornia.options import KorniaOptions
from dualslam.frontends.features.kornia.weights import WeightSource

PATCH_PX = 32
"""Side of the patch that a descriptor is given."""
FRAME_RADIUS_PX = {"sift": 16.0, "hardnet": 22.0}
"""Half the side of what it shows, pixels of the level: for RootSIFT each pixel once, for HardNet as it was trained."""
MARGIN_PX = 16
"""Rim of each level without keypoints: half of a patch."""
NMS_PX = 5
ORIENTATION_PATCH_PX = 19
GREY = 1.0 / 255.0
"""One grey level."""

Response = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Keypoints of one image, finest octave first.

    Attributes
    ----------
    uv_px : (N, 2) float64
    octave : (N,) int64
    refined : (N,) bool
        Whether the maximum was found between the pixels too.
    """

    uv_px: FloatArray
    octave: IntArray
    refined: BoolArray


class LevelFeatures:
    """Detector, orientation, affine shape and descriptor of `dog`, `harris` and `keynet`.

    Parameters
    ----------
    options : KorniaOptions
    n_features : int
        Keypoints per image, at most.
    device : torch.device
    source : WeightSource
        Of the learned parts.
    """

    def __init__(self, options: KorniaOptions, n_features: int, device: torch.device, source: WeightSource) -> None:
        self._n_features = n_features
        self._scale_factor, self._n_octaves = options.scale_factor, options.n_octaves
        self._radius_px = FRAME_RADIUS_PX[options.described_by]
        self._response, self._least_response = _response(options.detector, device, source)
        self._shape: torch.nn.Module = kf.PassLAF()
        self._orientation: torch.nn.Module = kf.LAFOrienter(ORIENTATION_PATCH_PX).to(device)
        if options.detector == "keynet":
            self._shape, orinet = kf.LAFAffNetShapeEstimator(pretrained=False), kf.OriNet(pretrained=False)
            source.load(AFFNET, self._shape)
            source.load(ORINET, orinet)
            self._orientation = kf.LAFOrienter(PATCH_PX, angle_detector=orinet).eval().to(device)
            self._shape.to(device)
        self._descriptor: torch.nn.Module = kf.SIFTDescriptor(PATCH_PX, rootsift=True)
        if options.described_by == "hardnet":
            self._descriptor = kf.HardNet(pretrained=False)
            source.load(HARDNET, self._descriptor)
        self._descriptor.to(device)

    def detect(self, images: torch.Tensor) -> list[Detections]:
        """Find well-spread keypoints in grey images (B, 1, H, W) of 0 to 1, `n_features` each at most."""
        found: list[list[Detections]] = [[] for _ in images]
        strength: list[list[FloatArray]] = [[] for _ in images]
        for octave, level in enumerate(self._pyramid(images)):
            response = self._response(level)
            peaks = nms2d(response, (NMS_PX, NMS_PX), mask_only=True) & (response > self._least_response)
            peaks[:, :, :MARGIN_PX], peaks[:, :, -MARGIN_PX:] = False, False
            peaks[:, :, :, :MARGIN_PX], peaks[:, :, :, -MARGIN_PX:] = False, False
            ratio = np.array([images.shape[3] / level.shape[3], images.shape[2] / level.shape[2]])
            for each, (peak, one) in enumerate(zip(peaks[:, 0], response[:, 0], strict=True)):
                xy, offset, refined, height = _between_pixels(peak, one)
                # Levels share the outer edges of the image, so it is pixel edges that scale, not centres.
                uv = (xy + offset + 0.5) * ratio - 0.5
                found[each].append(Detections(uv, np.full(len(uv), octave), refined))
                strength[each].append(height)
        return [self._choose(levels, heights) for levels, heights in zip(found, strength, strict=True)]

    def describe(self, image: torch.Tensor, detections: Detections) -> tuple[FloatArray, torch.Tensor]:
        """Return the orientations (N,), clockwise from +u in radians, and unit descriptors (N, D) on the device.

        Parameters
        ----------
        image : (1, 1, H, W)
            That the detections came from.
        """
        centre = torch.from_numpy(detections.uv_px).to(image)[None]
        scale = torch.from_numpy(self._radius_px * self._scale_factor**detections.octave).to(image)
        frames = kf.laf_from_center_scale_ori(centre, scale.reshape(1, -1, 1, 1), torch.zeros_like(centre[..., :1]))
        frames = self._orientation(self._shape(frames, image), image)
        descriptors = kf.get_laf_descriptors(image, frames, self._descriptor, PATCH_PX)[0]
        axis = frames[0, :, :, 0].double().cpu().numpy()
        return np.arctan2(axis[:, 1], axis[:, 0]), descriptors

    def _pyramid(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Levels from the images themselves down to the last that is wider than two rims."""
        levels = [images]
        height, width = images.shape[2:]
        for octave in range(1, self._n_octaves):
            size = (round(height / self._scale_factor**octave), round(width / self._scale_factor**octave))
            if min(size) <= 2 * MARGIN_PX:
                break
            levels.append(interpolate(levels[-1], size, mode="bilinear", align_corners=False, antialias=True))
        return levels

    def _choose(self, levels: Sequence[Detections], strength: Sequence[FloatArray]) -> Detections:
        """Keep the strongest that cover each level; as many per octave as its side is long."""
        weights = self._scale_factor ** -np.arange(len(levels), dtype=np.float64)
        quotas = share_out([len(level.uv_px) for level in levels], weights, self._n_features)
        rows = [
            select_spread(level.uv_px.astype(np.int64), grades(height), quota)
            for level, height, quota in zip(levels, strength, quotas, strict=True)
        ]
        chosen = list(zip(levels, rows, strict=True))
        return Detections(
            np.concatenate([level.uv_px[row] for level, row in chosen]),
            np.concatenate([level.octave[row] for level, row in chosen]),
            np.concatenate([level.refined[row] for level, row in chosen]),
        )


def _response(detector: str, device: torch.device, source: WeightSource) -> tuple[Response, float]:
    """What a level's maxima are maxima of, and the least height of one: what one grey level of contrast makes."""
    if detector == "dog":
        return lambda level: kf.dog_response_single(level).abs(), GREY
    if detector == "harris":  # of the fourth order in the gradient
        return kf.harris_response, GREY**4
    keynet = kf.KeyNet(pretrained=False)
    source.load(KEYNET, keynet)
    return keynet.to(device), 0.0  # its last layer cuts off what it does not take for a keypoint


def _between_pixels(peak: torch.Tensor, response: torch.Tensor) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """Fit a parabola to the 3 x 3 neighbourhood of each peak of a level.

    Parameters
    ----------
    peak : (H, W) bool
        None of it at the edge.
    response : (H, W)

    Returns
    -------
    xy : (N, 2) float64
        Pixels of the peaks, row by row.
    offset : (N, 2) float64
        (du, dv) from there to the parabola's maximum; zero where there is none within 0.75 px.
    refined : (N,) bool
    height : (N,) float64
        Response at the pixel.
    """
    v, u = torch.nonzero(peak, as_tuple=True)
    step = torch.arange(-1, 2, device=peak.device)
    patch = response[v[:, None, None] + step[:, None], u[:, None, None] + step]
    xy = torch.stack([u, v], dim=1).double().cpu().numpy()
    r = patch.double().cpu().numpy()
    offset, refined = quadratic_peak(r)
    return xy, np.where(refined[:, None], offset, 0.0), refined, r[:, 1, 1]
