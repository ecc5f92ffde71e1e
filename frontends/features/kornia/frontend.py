"""The kornia front end: what kornia.feature detects, describes and matches, behind the protocol of front ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from dualslam.core.errors import InputError
from dualslam.core.types import Features, FloatArray, Matches
from dualslam.frontends.features.corners import grades, select_spread
from dualslam.frontends.features.groups import NO_MATCHES, best_per_group, consistent_rotation
from dualslam.frontends.features.images import to_grey, to_rgb
from dualslam.frontends.features.kornia.levels import LevelFeatures
from dualslam.frontends.features.kornia.matchers import MIN_FEATURES, build_matcher
from dualslam.frontends.features.kornia.networks import Network
from dualslam.frontends.features.kornia.options import LEVELS_ZOOM, NETWORK_TURN_DEG, NETWORK_ZOOM, KorniaOptions
from dualslam.frontends.features.kornia.runtime import DeviceCopies, choose_device, inference
from dualslam.frontends.features.kornia.weights import WeightSource
from dualslam.frontends.features.optioned import OptionedFrontend

MIN_SIDE_PX = 33
"""Smaller images have no features: the patches of a descriptor, and the networks' strides, are as large."""
CANDIDATES = 2
"""Keypoints that a network is asked for, times those that are kept, so that there is something to spread."""
UNREFINED = 1.5
"""Noise of a maximum that stays at its pixel, times that of the others."""


class KorniaFrontend(OptionedFrontend):
    """Detectors, descriptors and matchers of kornia.feature, on the CPU or a CUDA device. Implements `Frontend`.

    Descriptors are float32 unit vectors, and distances those between them.

    Parameters
    ----------
    n_features : int
        Keypoints per image, at most.
    options : KorniaOptions, optional

    Raises
    ------
    ConfigError
        There is no such device; a checkpoint is not there or does not fit.
    """

    name = "kornia"
    options: KorniaOptions
    options_model = KorniaOptions

    def __init__(self, n_features: int = 1500, options: KorniaOptions | None = None) -> None:
        super().__init__(n_features, options)
        noise = self.options.noise
        self.max_distance, self.max_distance_strict = noise.max_distance, noise.max_distance_strict
        self._sigma_px = noise.sigma_px
        self._device = choose_device(self.options.device)
        self._copies = DeviceCopies(self._device)
        with torch.random.fork_rng(devices=[]):  # networks are made at random before their weights are read
            self._build()

    def _build(self) -> None:
        """Make detector, descriptor and matcher on the device."""
        options, checkpoints = self.options, self.options.checkpoints
        source = WeightSource("frontend.options.weights", options.weights, is_single=len(checkpoints) == 1)
        for checkpoint in checkpoints:  # all of them before any network is made, which takes seconds
            source.find(checkpoint)
        self._extract: Callable[[list[NDArray[np.uint8]]], list[Features]]
        if options.is_network:
            self.scale_factor, self.n_octaves = NETWORK_ZOOM, 1
            self.max_turn_deg, self.max_zoom = NETWORK_TURN_DEG, NETWORK_ZOOM
            n_candidates = CANDIDATES * self.n_features
            self._network = Network(options.detector, n_candidates, self._device, options.half, source)
            self._extract = self._by_network
        else:
            self.scale_factor, self.n_octaves = options.scale_factor, options.n_octaves
            self.max_turn_deg, self.max_zoom = 180.0, LEVELS_ZOOM
            self._levels = LevelFeatures(options, self.n_features, self._device, source)
            self._extract = self._by_levels
        self._match = build_matcher(options, self._device)

    def __reduce__(self) -> tuple[type[KorniaFrontend], tuple[int, KorniaOptions]]:
        """Go to another process as the options: it builds its own and reads the weights itself."""
        return type(self), (self.n_features, self.options)

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe up to `n_features` keypoints.

        Parameters
        ----------
        image : (H, W) or (H, W, 3) RGB uint8
            Of any size; a flat or a tiny one has no features.

        Raises
        ------
        InputError
            The array is no such image.
        """
        return self.extract_batch([image])[0]

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Features]:
        """Do the same for images of one size, all at once: on a GPU that is what keeps it busy.

        Raises
        ------
        InputError
            An array is no image, or they differ in size.
        """
        grey = [to_grey(image) for image in images]
        if len({image.shape for image in grey}) > 1:
            raise InputError(f"a batch must be of one size, not {sorted({image.shape for image in grey})}")
        # Flat images, too, have a best keypoint, for a network that keeps the best ones whatever they are.
        usable = [row for row, each in enumerate(grey) if min(each.shape) >= MIN_SIDE_PX and each.min() < each.max()]
        result = [self._no_features() for _ in images]
        if usable:
            with inference(self._device, self.options.half):
                chosen = [to_rgb(images[row]) if self.options.is_network else grey[row] for row in usable]
                for row, features in zip(usable, self._extract(chosen), strict=True):
                    result[row] = features
        return result

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Euclidean distance of paired unit vectors (N, D), (N, D) float32 -> (N,) float64, 0 to 2."""
        step = a.astype(np.float32) - b.astype(np.float32)
        return np.sqrt(np.einsum("ij,ij->i", step, step)).astype(np.float64)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Compare all with all: what the matcher finds, one to one, within `max_distance_strict`, turned alike."""
        if min(len(a), len(b)) < MIN_FEATURES:
            return NO_MATCHES
        with inference(self._device, self.options.half):
            of_a, of_b = self._copies.to_device(a.descriptors), self._copies.to_device(b.descriptors)
            pairs = self._match(a, b, of_a, of_b)
        distance = self.distance(a.descriptors[pairs[:, 0]], b.descriptors[pairs[:, 1]])
        kept = np.flatnonzero(distance <= self.max_distance_strict)
        for column, n in ((0, len(a)), (1, len(b))):
            kept = kept[best_per_group(pairs[kept, column], distance[kept], n)]
        kept = kept[np.argsort(pairs[kept, 0], kind="stable")]
        turned_alike = consistent_rotation(b.angle_rad[pairs[kept, 1]] - a.angle_rad[pairs[kept, 0]])
        return Matches(pairs[kept][turned_alike], distance[kept][turned_alike])

    def _by_levels(self, images: list[NDArray[np.uint8]]) -> list[Features]:
        """Pyramid, maxima, frames, descriptors."""
        batch = torch.from_numpy(np.stack(images)[:, None]).to(self._device).float() / 255.0
        result = []
        for image, found in zip(batch, self._levels.detect(batch), strict=True):
            if len(found.uv_px) == 0:
                result.append(self._no_features())
                continue
            angle, descriptors = self._levels.describe(image[None], found)
            scale = self.scale_factor ** found.octave.astype(np.float64)
            sigma = self._sigma_px * scale * np.where(found.refined, 1.0, UNREFINED)
            result.append(self._features(found.uv_px, sigma, scale, found.octave, angle, descriptors))
        return result

    def _by_network(self, images: list[NDArray[np.uint8]]) -> list[Features]:
        """One pass of the network."""
        batch = torch.from_numpy(np.stack(images)).to(self._device).permute(0, 3, 1, 2).float() / 255.0
        result = []
        for found in self._network(batch.contiguous()):
            rows = select_spread(found.uv_px.astype(np.int64), grades(found.score), self.n_features)
            n = len(rows)
            descriptors = found.descriptors[torch.from_numpy(rows).to(self._device)]
            sigma, one, zero = np.full(n, self._sigma_px), np.ones(n), np.zeros(n)
            result.append(self._features(found.uv_px[rows], sigma, one, np.zeros(n, np.int64), zero, descriptors))
        return result

    def _features(
        self,
        uv_px: FloatArray,
        sigma_px: FloatArray,
        scale: FloatArray,
        octave: NDArray[np.int64],
        angle_rad: FloatArray,
        descriptors: torch.Tensor,
    ) -> Features:
        unit = torch.nn.functional.normalize(descriptors.float(), dim=1)
        return Features(uv_px, uv_px, sigma_px, scale, octave, angle_rad, self._copies.to_host(unit))

    def _no_features(self) -> Features:
        none, dim = np.empty(0), self.options.descriptor_length
        uv = np.empty((0, 2))
        return Features(uv, uv, none, none, np.empty(0, np.int64), none, np.empty((0, dim), np.float32))
