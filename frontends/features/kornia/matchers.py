"""Matching without a guide, on the device: mutual nearest neighbours with ratio, AdaLAM, LightGlue."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import kornia.feature as kf
import numpy as np
import torch

from dualslam.core.types import Features, IntArray
from dualslam.frontends.features.kornia.options import KorniaOptions
from dualslam.frontends.features.kornia.weights import LIGHTGLUE

Matcher = Callable[[Features, Features, torch.Tensor, torch.Tensor], IntArray]
"""Features and descriptors (N, D) of two images to pairs (M, 2); one to one is not asked for."""

MIN_FEATURES = 2
"""There is no second best among fewer."""


def build_matcher(options: KorniaOptions, device: torch.device) -> Matcher:
    """Return the matcher that the options name.

    Raises `ConfigError`: LightGlue's checkpoint is not there or does not fit.
    """
    if options.matcher == "smnn":
        return lambda a, b, of_a, of_b: _to_host(kf.match_smnn(of_a, of_b, options.ratio)[1])
    if options.matcher == "adalam":
        oriented = not options.is_network
        return lambda a, b, of_a, of_b: _match_adalam(a, b, of_a, of_b, oriented)
    return LightGlueMatcher(options, device)


class LightGlueMatcher:
    """LightGlue for the features of the detector that the options name."""

    def __init__(self, options: KorniaOptions, device: torch.device) -> None:
        # Its constructor downloads for a name, and builds the same from the name's settings.
        settings = {**kf.LightGlue.features[options.detector], "weights": None}
        self._model = kf.LightGlue(None, **settings)
        rename = {"matcher.": ""}
        for layer in range(self._model.conf.n_layers):
            for block in ("self_attn", "cross_attn"):
                rename[f"{block}.{layer}."] = f"transformers.{layer}.{block}."
        LIGHTGLUE[options.detector].load("matcher_weights", options.matcher_weights, self._model, rename)
        if device.type == "cpu":
            for layer in self._model.transformers:
                layer.cross_attn.forward = partial(_cross_attention, layer.cross_attn)
        self._model.to(device)

    def __call__(self, a: Features, b: Features, of_a: torch.Tensor, of_b: torch.Tensor) -> IntArray:
        """Match; descriptors (N, D) on the model's device."""
        # The size of the image is not known here. Both sets come from one camera, so the box around both will do.
        low = np.minimum(a.uv_px.min(axis=0), b.uv_px.min(axis=0))
        extent = np.maximum(a.uv_px.max(axis=0), b.uv_px.max(axis=0)) - low
        size = torch.from_numpy(np.maximum(extent, 1.0)[None]).to(of_a)
        found = self._model(
            {
                f"image{which}": {
                    "keypoints": torch.from_numpy((features.uv_px - low)[None]).to(of_a),
                    "descriptors": descriptors[None],
                    "image_size": size,
                }
                for which, (features, descriptors) in enumerate(((a, of_a), (b, of_b)))
            }
        )
        return _to_host(found["matches"][0])


def _cross_attention(
    block: Any, x0: torch.Tensor, x1: torch.Tensor, mask: None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Do what kornia's `CrossBlock` does with torch's fused attention, which halves LightGlue's time on a CPU."""
    (qk0, v0), (qk1, v1) = (
        [
            projected.unflatten(-1, (block.heads, -1)).transpose(1, 2).contiguous()
            for projected in (block.to_qk(x), block.to_v(x))
        ]
        for x in (x0, x1)
    )

    def updated(x: torch.Tensor, query: torch.Tensor, key: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        message = torch.nn.functional.scaled_dot_product_attention(query, key, value)
        message = block.to_out(message.transpose(1, 2).flatten(start_dim=-2))
        return x + block.ffn(torch.cat([x, message], -1))

    return updated(x0, qk0, qk1, v1), updated(x1, qk1, qk0, v0)


def _match_adalam(a: Features, b: Features, of_a: torch.Tensor, of_b: torch.Tensor, oriented: bool) -> IntArray:
    """AdaLAM (Cavalli et al. 2020); without orientations and scales it goes by positions alone."""
    thresholds = {} if oriented else {"orientation_difference_threshold": None, "scale_rate_threshold": None}
    # kornia takes an area from the size alone, and without one from the keypoints; both images have the same.
    both = np.concatenate([a.uv_px, b.uv_px])
    size = [int(extent) for extent in np.ceil(np.ptp(both, axis=0)) + 1]
    _, pairs = kf.match_adalam(of_a, of_b, _frames(a, of_a), _frames(b, of_b), thresholds, hw1=size, hw2=size)
    return _to_host(pairs)


def _frames(features: Features, like: torch.Tensor) -> torch.Tensor:
    """Position, scale and orientation as kornia holds them, (1, N, 2, 3)."""
    uv, scale, angle = (torch.from_numpy(x).to(like) for x in (features.uv_px, features.scale, features.angle_rad))
    # kornia counts degrees against the clock.
    return kf.laf_from_center_scale_ori(uv[None], scale.reshape(1, -1, 1, 1), -torch.rad2deg(angle).reshape(1, -1, 1))


def _to_host(pairs: torch.Tensor) -> IntArray:
    return np.asarray(pairs.cpu().numpy(), np.int64).reshape(-1, 2)
