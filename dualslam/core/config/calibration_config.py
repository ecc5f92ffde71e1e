"""The section of the config on self-calibration."""

from __future__ import annotations

from pydantic import Field

from dualslam.core.config.strict_model import StrictModel


class CalibrationConfig(StrictModel):
    """Self-calibration: when a submap estimates its camera, and when the estimate is used."""

    refine: bool = True
    """Whether to do it at all."""
    first_keyframes: int = Field(30, ge=10)
    """Keyframes at which a submap is asked for the first time."""
    max_observations: int = Field(15000, ge=1000)
    """Observations that go into the estimate: they bound its time (about 1 s)."""
    log_focal_sigma: float = Field(0.05, ge=1e-6)
    """Prior of the log of both focal lengths. A chequerboard gives 0.003, a data sheet 0.05, the depth camera's focal
    length taken for the colour camera's 0.1. It need not be tight: where the motion does not fix the focal length,
    nothing is changed at all."""

    @property
    def max_focal_sigma(self) -> float:
        """Sigma of the log focal length up to which it counts as observed: a fifth of its prior's.

        In a right-angled bend 1 % of focal length costs 10 % of scale and more. There half as sure an answer does more
        harm than good (a car driving backwards round a bend: 6 % off, with a sigma of 1.3 %).
        """
        return 0.2 * self.log_focal_sigma
