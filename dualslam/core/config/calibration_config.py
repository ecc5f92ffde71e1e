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
    min_rotation_deg: float = Field(15.0, ge=0)
    """Turning, summed over the window, below which nothing is tried: the focal length could not be known."""
    max_keyframes: int = Field(60, ge=10)
    """Keyframes of the window, neighbours in time; of all such windows the one with most turning."""
    max_observations: int = Field(15000, ge=1000)
    """Observations that go into the estimate: they bound its time (about 1 s)."""
    log_focal_sigma: float = Field(0.05, ge=1e-6)
    """Prior of the log of both focal lengths. A chequerboard gives 0.003, a data sheet 0.05, the depth camera's focal
    length taken for the colour camera's 0.1. It need not be tight: where the motion does not fix the focal length,
    nothing is changed at all."""
    inflation: float = Field(4.0, ge=1)
    """How much larger than the residuals say the errors of the pixels are taken to be, because neighbouring ones err
    alike. With the exact camera (rendered images) corrections came out up to 3.8 times as far from zero as the
    Hessian's sigmas say."""
    max_sigma_ratio: float = Field(0.2, gt=0, le=1)
    """The focal length counts as observed where its sigma is below this share of its prior's; else nothing changes. In
    a right-angled bend 1 % of focal length costs 10 % of scale and more: half as sure an answer does more harm than
    good (a car driving backwards round a bend: 6 % off, with a sigma of 1.3 %)."""
