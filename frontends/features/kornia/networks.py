"""Networks that detect and describe at once: XFeat, ALIKED and DISK, behind one face."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import kornia.feature as kf
import torch

from dualslam.core.types import FloatArray
from dualslam.frontends.features.kornia.weights import DETECTOR

OPTION = "weights"


class Network:
    """One of the networks.

    - `n_candidates`: keypoints per image, at most.
    - `weights`: see `KorniaOptions`.
    """

    def __init__(self, name: str, n_candidates: int, device: torch.device, weights: Path | None) -> None:
        self._name = name
        self._n = n_candidates
        DETECTOR[name].find(OPTION, weights)  # before the network is made, which takes seconds
        self._model: Any
        if name == "xfeat":
            self._model = kf.XFeat(top_k=n_candidates)
        elif name == "aliked":
            self._model = kf.ALIKED("aliked-n16", max_num_keypoints=n_candidates)
        else:
            self._model = kf.DISK()
        DETECTOR[name].load(OPTION, weights, self._model.net if name == "xfeat" else self._model)
        self._model.eval().to(device)

    def __call__(self, image: torch.Tensor) -> tuple[FloatArray, FloatArray, torch.Tensor]:
        """Return positions (N, 2), scores (N,) and descriptors (N, D), on the device, of an image (1, 3, H, W)."""
        if self._name == "xfeat":
            found = self._model.detectAndCompute(image)[0]
            # XFeat shrinks to multiples of 32 and scales pixel indices back, as if centres and not edges kept place.
            height, width = image.shape[2:]
            ratio = image.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
            return _on_host(found["keypoints"] + 0.5 * (ratio - 1.0), found["scores"], found["descriptors"])
        if self._name == "disk":
            found = self._model(image, n=self._n, pad_if_not_divisible=True)[0]
            return _on_host(found.keypoints, found.detection_scores, found.descriptors)
        found = self._model(image)[0]
        return _on_host(found.keypoints, found.keypoint_scores, found.descriptors)


def _on_host(uv_px: torch.Tensor, score: torch.Tensor, descriptors: torch.Tensor) -> Any:
    return uv_px.double().cpu().numpy(), score.double().cpu().numpy(), descriptors.float()
