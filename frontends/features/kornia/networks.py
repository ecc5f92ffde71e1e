"""Networks that detect and describe at once: XFeat, ALIKED, DISK and DeDoDe, behind one face."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import kornia.feature as kf
import numpy as np
import torch

from dualslam.core.types import FloatArray
from dualslam.frontends.features.kornia.checkpoints import ALIKED, DEDODE_DESCRIPTOR, DEDODE_DETECTOR, DISK, XFEAT
from dualslam.frontends.features.kornia.weights import WeightSource


@dataclass(frozen=True, slots=True, eq=False)
class NetworkKeypoints:
    """What a network finds in one image.

    Attributes
    ----------
    uv_px : (N, 2) float64
    score : (N,) float64
    descriptors : (N, D)
        On the device, of any length.
    """

    uv_px: FloatArray
    score: FloatArray
    descriptors: torch.Tensor


class Network:
    """One of the networks.

    Parameters
    ----------
    name : {"xfeat", "aliked", "disk", "dedode"}
    n_candidates : int
        Keypoints per image, at most.
    device : torch.device
    half : bool
        Half precision, for the one network that does not leave it to the caller.
    source : WeightSource
    """

    def __init__(self, name: str, n_candidates: int, device: torch.device, half: bool, source: WeightSource) -> None:
        self._name = name
        self._n = n_candidates
        self._model: Any
        if name == "xfeat":
            self._model = kf.XFeat(top_k=n_candidates)
            source.load(XFEAT, self._model.net)
        elif name == "aliked":
            self._model = kf.ALIKED("aliked-n16", max_num_keypoints=n_candidates)
            source.load(ALIKED, self._model)
        elif name == "disk":
            self._model = kf.DISK()
            source.load(DISK, self._model)
        else:
            self._model = kf.DeDoDe("L", "B", amp_dtype=torch.float16 if half else torch.float32)
            source.load(DEDODE_DETECTOR, self._model.detector)
            source.load(DEDODE_DESCRIPTOR, self._model.descriptor)
        self._model.eval().to(device)

    def __call__(self, images: torch.Tensor) -> list[NetworkKeypoints]:
        """Detect and describe in RGB images (B, 3, H, W) of 0 to 1, all at once."""
        if self._name == "xfeat":
            return self._xfeat(images)
        if self._name == "dedode":
            uv, score, descriptors = self._model(images, n=self._n)
            # DeDoDe puts the centre of the first pixel at (0.5, 0.5).
            return [_keypoints(*each) for each in zip(uv - 0.5, score, descriptors, strict=True)]
        if self._name == "disk":
            found = self._model(images, n=self._n, pad_if_not_divisible=True)
            return [_keypoints(each.keypoints, each.detection_scores, each.descriptors) for each in found]
        return [_keypoints(each.keypoints, each.keypoint_scores, each.descriptors) for each in self._model(images)]

    def _xfeat(self, images: torch.Tensor) -> list[NetworkKeypoints]:
        """XFeat shrinks to multiples of 32 and scales pixel indices back, as if centres and not edges kept place."""
        height, width = images.shape[2:]
        ratio = images.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
        return [
            _keypoints(each["keypoints"] + 0.5 * (ratio - 1.0), each["scores"], each["descriptors"])
            for each in self._model.detectAndCompute(images)
        ]


def _keypoints(uv_px: torch.Tensor, score: torch.Tensor, descriptors: torch.Tensor) -> NetworkKeypoints:
    return NetworkKeypoints(
        np.asarray(uv_px.double().cpu().numpy()), np.asarray(score.double().cpu().numpy()), descriptors.float()
    )
