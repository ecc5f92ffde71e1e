"""The kornia front end: what kornia.feature detects, describes and matches, behind the protocol of front ends."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock

import numpy as np
import torch
from numpy.typing import NDArray

from dualslam.core.errors import ConfigError
from dualslam.core.types import Features, FloatArray, Matches
from dualslam.frontends.features.corners import grades, select_spread
from dualslam.frontends.features.groups import NO_MATCHES, best_per_group, consistent_rotation
from dualslam.frontends.features.images import to_grey, to_rgb
from dualslam.frontends.features.kornia.levels import LevelFeatures
from dualslam.frontends.features.kornia.matchers import MIN_FEATURES, build_matcher
from dualslam.frontends.features.kornia.networks import Network
from dualslam.frontends.features.kornia.options import LEVELS_ZOOM, NETWORK_TURN_DEG, NETWORK_ZOOM, KorniaOptions
from dualslam.frontends.features.optioned import OptionedFrontend

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

    def __init__(self, n_features: int = 1500, options: KorniaOptions | None = None) -> None:
        super().__init__(n_features, options)
        options = self.options
        self.max_distance, self.max_distance_strict = options.noise.max_distance, options.noise.max_distance_strict
        self._device = choose_device(options.device)
        with torch.random.fork_rng(devices=[]):  # networks are made at random before their weights are read
            if options.is_network:
                self.scale_factor, self.n_octaves = NETWORK_ZOOM, 1
                self.max_turn_deg, self.max_zoom = NETWORK_TURN_DEG, NETWORK_ZOOM
                self._network = Network(options.detector, CANDIDATES * n_features, self._device, options.weights)
            else:
                self.scale_factor, self.n_octaves = options.scale_factor, options.n_octaves
                self.max_turn_deg, self.max_zoom = 180.0, LEVELS_ZOOM
                self._levels = LevelFeatures(options, n_features, self._device)
            self._match = build_matcher(options, self._device)

    def __reduce__(self) -> tuple[type[KorniaFrontend], tuple[int, KorniaOptions]]:
        """Go to another process as the options: it builds its own and reads the weights itself."""
        return type(self), (self.n_features, self.options)

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe up to `n_features` keypoints.

        `image` (H, W) or (H, W, 3) RGB uint8: of any size; a flat or a tiny one has no features.

        Raises `InputError`: the array is no such image.
        """
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

    What that takes belongs to the process, and is put back. Callers in other threads wait: they would put back each
    other's.
    """
    exact = one_thread() if device.type == "cpu" else deterministic_cuda()
    with _ONE_CALLER, torch.inference_mode(), exact:
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch in one thread.

    The order of a sum, and so its last bit, depends on their number, and our parallelism is processes
    (`dualslam.core.threads`).
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def deterministic_cuda() -> Iterator[None]:
    """Run torch on a CUDA device with sums in a fixed order, and in the precision of the CPU.

    The histograms of an orientation and of SIFT are atomic additions otherwise, whose order changes. torch warns where
    an operation has no such form.
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
