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
    max_depth_sigma: float = Field(0.25, gt=0)
    """A landmark enters the graph once its views fix its distance to this relative standard deviation (0.25 is about
    half a degree of parallax at 1 px and a focal length of 700 px); it leaves at twice that."""
    enter_sigmas: float = Field(6.0, gt=0)
    """Observations of a landmark that is new to the graph must fit within so many sigmas: two views of which one is
    wrong throw their point behind a camera, and the solver fails."""
    insert_sigmas: float = Field(25.0, gt=0)
    """Observations of a landmark that is in the graph are refused only beyond this; the robust kernel has the rest."""
    min_ties: int = Field(6, ge=3)
    """Keyframes tied to the graph by fewer landmarks are held at their pose by a loose prior, until they have more."""
    read_window: int = Field(20, ge=0)
    """Keyframes (the last inserted ones, and their landmarks) whose estimate is read after each update; 0 reads all."""
    read_all_every: int = Field(10, ge=1)
    """Each so-many-th update reads the whole estimate."""
    rebuild_iterations: int = Field(8, ge=1)
    """Batch iterations at most when a graph is made anew."""


class Config(StrictModel):
    """The root of the configuration."""

    seed: int = Field(0, ge=0)
    """Seed of every random choice of the run."""
    frontend: FrontendConfig = FrontendConfig()
    graph: GraphConfig = GraphConfig()
