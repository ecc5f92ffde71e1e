"""What can be chosen, and the numbers that go with each choice. Imports neither torch nor kornia.

Numbers of `dog` and `harris` with `sift` were measured (docs/frontends.md); those of the learned ones could not be, for
want of their weights: they are stated with their reason, and every one can be set in the config.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from dualslam.config.settings import StrictModel
from dualslam.frontends.features.kornia.checkpoints import DESCRIPTORS, DETECTORS, Checkpoint

NETWORKS = ("xfeat", "aliked", "disk", "dedode")
"""One network each that detects and describes, at one scale and without an orientation."""
LIGHTGLUE_FOR = ("xfeat", "aliked", "disk")
"""Those that LightGlue was trained for and whose input a `Features` holds. Missing on purpose: KeyNet-AffNet-HardNet,
whose LightGlue wants affine frames, and DeDoDe, whose LightGlue wants descriptors that are not unit vectors."""
NETWORK_ZOOM = 1.7
"""A network sees one scale. This change of size it bears, as the published evaluations have it; not measured here."""
NETWORK_TURN_DEG = 30.0
"""Nor does it know of orientations: it bears about this much turning."""
LEVELS_ZOOM = 1.7
"""The change of size that features of a pyramid bear: its coarser half meets the other view's finer half."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Positions' noise (pixels of the octave) and descriptor distances up to which features may be the same point."""

    sigma_px: float
    max_distance: float
    max_distance_strict: float


NOISE = {
    "sift": Noise(0.5, 0.5, 0.4),
    # The paper's distances (fig. 5 of Mishchuk et al. 2017): same patch about 0.6, the hardest other one about 1.1.
    "hardnet": Noise(0.6, 1.0, 0.85),
    # The authors ask for a cosine of 0.82 without a guide; with one 0.6. Maxima lie on whole pixels of a resized image.
    "xfeat": Noise(1.0, 0.9, 0.6),
    # No threshold is published. A cosine of 0.68 (0.5 with a guide) is 8 (6) standard deviations of that of two random
    # unit vectors of 128 numbers. Maxima lie on whole pixels, of ALIKED between them.
    "aliked": Noise(0.7, 1.0, 0.8),
    "disk": Noise(1.0, 1.0, 0.8),
    "dedode": Noise(1.0, 1.0, 0.8),
}


class KorniaOptions(StrictModel):
    """`frontend.options` of the kornia front end."""

    detector: Literal["dog", "harris", "keynet", "xfeat", "aliked", "disk", "dedode"] = "dog"
    """`dog` (difference of Gaussians) and `harris` need no weights; `keynet` is KeyNet with AffNet and OriNet; the
    others are networks that describe what they detect."""
    descriptor: Literal["auto", "sift", "hardnet"] = "auto"
    """Of `dog`, `harris` and `keynet`: RootSIFT, which needs no weights, or HardNet. `auto`: RootSIFT, for `keynet`
    HardNet. A network describes by itself (`auto`)."""
    matcher: Literal["smnn", "adalam", "lightglue"] = "adalam"
    """Without a guide: mutual nearest neighbours with a ratio test both ways, AdaLAM, or LightGlue (for `xfeat`,
    `aliked`, `disk`)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` takes a CUDA device where torch sees one."""
    half: bool = True
    """Networks in half precision; on a CUDA device only."""
    weights: Path | None = None
    """Checkpoint of the detector and descriptor: the file where one is needed, else a folder that holds the files under
    their published names. Without it they are sought in torch's cache. Nothing is ever downloaded."""
    matcher_weights: Path | None = None
    """The same for LightGlue."""
    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Ratio of the sizes of neighbouring pyramid levels; of `dog`, `harris` and `keynet`."""
    n_octaves: int = Field(8, ge=1, le=16)
    """Number of pyramid levels; of `dog`, `harris` and `keynet`."""
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
        if self.is_network and self.descriptor != "auto":
            raise ValueError(f"detector '{self.detector}' describes by itself: leave descriptor at auto")
        if self.matcher == "lightglue" and self.detector not in LIGHTGLUE_FOR:
            raise ValueError(f"matcher 'lightglue' goes with the detectors {', '.join(LIGHTGLUE_FOR)}")
        return self

    @property
    def is_network(self) -> bool:
        """Whether one network detects and describes."""
        return self.detector in NETWORKS

    @property
    def described_by(self) -> str:
        """Name of the descriptor: a key of `NOISE`."""
        if self.is_network:
            return self.detector
        if self.descriptor == "auto":
            return "hardnet" if self.detector == "keynet" else "sift"
        return self.descriptor

    @property
    def descriptor_length(self) -> int:
        """Numbers in a descriptor."""
        return {"xfeat": 64, "dedode": 256}.get(self.described_by, 128)

    @property
    def checkpoints(self) -> tuple[Checkpoint, ...]:
        """Files that `weights` stands for."""
        return DETECTORS[self.detector] + DESCRIPTORS.get(self.described_by, ())

    @property
    def noise(self) -> Noise:
        """What the user set, and the descriptor's own numbers for the rest."""
        default = NOISE[self.described_by]
        return Noise(
            self.sigma_px or default.sigma_px,
            self.max_distance or default.max_distance,
            self.max_distance_strict or default.max_distance_strict,
        )
