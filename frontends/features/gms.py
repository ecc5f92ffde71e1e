"""ORB features matched by grid-based motion statistics where there is no other guide (Bian et al., CVPR 2017)."""

from __future__ import annotations

from pydantic import Field

from dualslam.core.types import Features, Matches
from dualslam.frontends.features.motion_statistics import THRESHOLD, match_by_motion
from dualslam.frontends.features.orb import OrbFrontend, OrbOptions
from dualslam.frontends.registry import N_FEATURES


class GmsOptions(OrbOptions):
    """`frontend.options` of the GMS front end: those of ORB, and how motions are compared."""

    rotation: bool = False
    """Also look for images that are turned against each other, in steps of 45 degrees; takes eight times as long."""
    zoom: bool = False
    """Also look for images of half to twice the size; takes five times as long."""
    threshold: float = Field(THRESHOLD, gt=0.0)
    """Standard deviations by which a pair of cells must have more matches than chance would give it."""


class GmsFrontend(OrbFrontend):
    """ORB with another `match_wide`; all else is ORB's. Implements `Frontend`."""

    name = "gms"
    options: GmsOptions
    options_model = GmsOptions

    def __init__(self, n_features: int = N_FEATURES, options: GmsOptions | None = None) -> None:
        super().__init__(n_features, options)
        # The cells about a cell are where they are expected to within half a cell: at a distance of one cell, a turn by
        # 30 degrees or a zoom by 1.5. A step of 45 degrees leaves 22.5, a step of 1.41 in size 1.2.
        self.max_turn_deg = 180.0 if self.options.rotation else 30.0
        self.max_zoom = 1.7 if self.options.zoom else 1.4

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Compare all with all, and keep the nearest that move as their neighbours do."""
        motion = self.options
        return match_by_motion(self, a, b, rotation=motion.rotation, zoom=motion.zoom, threshold=motion.threshold)
