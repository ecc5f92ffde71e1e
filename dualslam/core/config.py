"""Every setting of a run, with its meaning: strict pydantic models, read from and written to YAML."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class StrictModel(BaseModel):
    """A frozen section of the config that refuses unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class FrontendConfig(StrictModel):
    """Features and their comparison."""

    name: str = "orb"
    """Which front end: `orb`, or one that another package offers as an entry point of `dualslam.frontends`."""
    n_features: int = Field(1500, ge=50, le=20000)
    """Keypoints per image."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Settings of the chosen front end alone; it checks their names itself."""


class GraphConfig(StrictModel):
    """The factor graph of a submap and its solver."""

    robust_k: float = Field(1.345, gt=0)
    """Huber threshold in sigmas: 1.345 keeps 95 % efficiency under Gaussian noise."""
    outlier_chi2: float = Field(5.991, gt=0)
    """Squared whitened residual above which an observation is an outlier: chi-square, 2 degrees of freedom, 95 %."""
    max_keyframes: int = Field(500, ge=20, le=1000)
    """Keyframes at which a submap rolls over into the next (the solver's Cholesky rejects much longer chains)."""


class Config(StrictModel):
    """The root of the configuration."""

    seed: int = Field(0, ge=0)
    """Seed of every random choice of the run."""
    frontend: FrontendConfig = FrontendConfig()
    graph: GraphConfig = GraphConfig()
