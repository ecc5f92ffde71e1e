"""The kornia front end: what kornia.feature detects, describes and matches, behind the protocol of front ends."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock

import kornia.feature as kf
import numpy as np
import torch
from kornia.geometry.subpix import nms2d
from numpy.typing import NDArray
from torch.nn.functional import interpolate

from dualslam.core.errors import ConfigError
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.corners import grades, quadratic_peak, select_spread, share_out
from dualslam.frontends.features.groups import NO_MATCHES, best_per_group, consistent_rotation
from dualslam.frontends.features.images import to_grey, to_rgb
from dualslam.frontends.features.kornia.matchers import MIN_FEATURES, build_matcher
from dualslam.frontends.features.kornia.options import MAX_ZOOM, NETWORK_TURN_DEG, KorniaOptions
from dualslam.frontends.features.kornia.weights import Network
from dualslam.frontends.registry import N_FEATURES, OptionedFrontend

MIN_SIDE_PX = 33
"""Smaller images have no features: the patches of a descriptor, and the networks' strides, are as large."""
CANDIDATES = 2
"""Keypoints that a network is asked for, times those that are kept, so that there is something to spread."""
UNREFINED = 1.5
"""Noise of a maximum that stays at its pixel, times that of the others."""
_ONE_CALLER = RLock()


class KorniaFrontend(OptionedFrontend):
    """Detectors, descriptors and matchers of kornia.feature, on the CPU or a CUDA device. Implements `Frontend`.

    Descriptors are float32 unit vectors, and distances those between them.

    `n_features`: keypoints per image, at most.

    Raises `ConfigError`: there is no such device; a checkpoint is not there or does not fit.
    """

    name = "kornia"
    options: KorniaOptions
    options_model = KorniaOptions

    def __init__(self, n_features: int = N_FEATURES, options: KorniaOptions | None = None) -> None:
        super().__init__(n_features, options)
        options = self.options
        self.max_distance, self.max_distance_strict = options.noise.max_distance, options.noise.max_distance_strict
        self._device = choose_device(options.device)
        with torch.random.fork_rng(devices=[]):  # networks are made at random before their weights are read
            if options.is_network:
                self.scale_factor, self.n_octaves = MAX_ZOOM, 1
                self.max_turn_deg, self.max_zoom = NETWORK_TURN_DEG, MAX_ZOOM
                self._network = Network(options.detector, CANDIDATES * n_features, self._device, options.weights)
            else:
                self.scale_factor, self.n_octaves = options.scale_factor, options.n_octaves
                self.max_turn_deg, self.max_zoom = 180.0, MAX_ZOOM
                self._levels = LevelFeatures(options, n_features, self._device)
            self._match = build_matcher(options, self._device)

    def __reduce__(self) -> tuple[type[KorniaFrontend], tuple[int, KorniaOptions]]:
        """Go to another process as the options: it builds its own and reads the weights itself."""
        return type(self), (self.n_features, self.options)

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe up to `n_features` keypoints, as `Frontend.extract` says."""
        grey = to_grey(image)
        # A flat image, too, has a best keypoint, for a network that keeps the best ones whatever they are.
        if min(grey.shape) < MIN_SIDE_PX or grey.min() == grey.max():
            return self._no_features()
        with inference(self._device):
            return self._by_network(to_rgb(image)) if self.options.is_network else self._by_levels(grey)

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Euclidean distance of paired unit vectors (N, D), (N, D) float32 -> (N,) float64, 0 to 2."""
        step = a.astype(np.float32) - b.astype(np.float32)
        return np.sqrt(np.einsum("ij,ij->i", step, step)).astype(np.float64)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Compare all with all: what the matcher finds, one to one, within `max_distance_strict`, turned alike."""
        if min(len(a), len(b)) < MIN_FEATURES:
            return NO_MATCHES
        with inference(self._device):
            of_a, of_b = (torch.tensor(each.descriptors, device=self._device) for each in (a, b))
            pairs = self._match(a, b, of_a, of_b)
        distance = self.distance(a.descriptors[pairs[:, 0]], b.descriptors[pairs[:, 1]])
        kept = np.flatnonzero(distance <= self.max_distance_strict)
        for column, n in ((0, len(a)), (1, len(b))):
            kept = kept[best_per_group(pairs[kept, column], distance[kept], n)]
        kept = kept[np.argsort(pairs[kept, 0], kind="stable")]
        turned_alike = consistent_rotation(b.angle_rad[pairs[kept, 1]] - a.angle_rad[pairs[kept, 0]])
        return Matches(pairs[kept][turned_alike], distance[kept][turned_alike])

    def _by_levels(self, grey: NDArray[np.uint8]) -> Features:
        """Pyramid, maxima, frames, descriptors."""
        image = torch.tensor(grey[None, None], device=self._device).float() / 255.0
        found = self._levels.detect(image)
        if len(found.uv_px) == 0:
            return self._no_features()
        angle, descriptors = self._levels.describe(image, found)
        scale = self.scale_factor ** found.octave.astype(np.float64)
        sigma = self.options.noise.sigma_px * scale * np.where(found.refined, 1.0, UNREFINED)
        return Features(found.uv_px, found.uv_px, sigma, scale, found.octave, angle, _unit(descriptors))

    def _by_network(self, rgb: NDArray[np.uint8]) -> Features:
        """One pass of the network."""
        image = torch.tensor(rgb[None], device=self._device).permute(0, 3, 1, 2).float() / 255.0
        uv, score, descriptors = self._network(image.contiguous())
        rows = select_spread(uv.astype(np.int64), grades(score), self.n_features)
        uv, sigma, one = uv[rows], np.full(len(rows), self.options.noise.sigma_px), np.ones(len(rows))
        octave = np.zeros(len(rows), np.int64)
        return Features(uv, uv, sigma, one, octave, np.zeros(len(rows)), _unit(descriptors)[rows])

    def _no_features(self) -> Features:
        none, uv = np.empty(0), np.empty((0, 2))
        length = 64 if self.options.detector == "xfeat" else 128
        return Features(uv, uv, none, none, np.empty(0, np.int64), none, np.empty((0, length), np.float32))


def choose_device(name: str) -> torch.device:
    """Return the device that the config names; `auto` is CUDA where torch sees it.

    Raises `ConfigError`: CUDA is asked for and torch sees none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"torch {torch.__version__} sees no CUDA device: install a torch built for CUDA, or choose cpu or auto",
            ("frontend", "options", "device"),
        )
    device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
    if device.type == "cuda":  # read when cuBLAS starts: without it the sums of a product may change their order
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    return device


@contextmanager
def inference(device: torch.device) -> Iterator[None]:
    """Run torch without gradients, and so that the same input gives the same output, bit for bit.

    The switches belong to the process, and are put back; callers in other threads wait meanwhile.
    """
    exact = one_thread() if device.type == "cpu" else deterministic_cuda()
    with _ONE_CALLER, torch.inference_mode(), exact:
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch in one thread: the order of a sum, and so its last bit, depends on their number."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def deterministic_cuda() -> Iterator[None]:
    """Run torch on a CUDA device with sums in a fixed order, and in the precision of the CPU.

    torch warns where an operation has no such form.
    """
    before, warns = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warns)


def _unit(descriptors: torch.Tensor) -> NDArray[np.float32]:
    unit: NDArray[np.float32] = torch.nn.functional.normalize(descriptors.float(), dim=1).cpu().numpy()
    return unit


PATCH_PX = 32
"""Side of the patch that the descriptor is given: each pixel of the level once."""
MARGIN_PX = PATCH_PX // 2
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
    """Detector, orientation and descriptor of `dog` and `harris`."""

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

    Returns the maxima (N, 2), row by row, whether the parabola has one within 0.75 px (else it is the pixel), and the
    response at the pixel.
    """
    v, u = torch.nonzero(peak, as_tuple=True)
    step = torch.arange(-1, 2, device=peak.device)
    r = response[v[:, None, None] + step[:, None], u[:, None, None] + step].double().cpu().numpy()
    offset, refined = quadratic_peak(r)
    xy = torch.stack([u, v], dim=1).double().cpu().numpy()
    return xy + np.where(refined[:, None], offset, 0.0), refined, r[:, 1, 1]
