"""A map and measurements from outside as a solver sees them: a pose graph, the camera's path, readings by source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dualslam.core.atlas_problem import AtlasEdges
from dualslam.core.geometry import so3
from dualslam.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class MeasurementRow:
    """A line of a file of measurements."""

    kind: str
    values: tuple[float, ...]
    where: str  # file and line, for messages


@dataclass(frozen=True, slots=True, eq=False)
class RowSource:
    """Contents of a file of measurements."""

    name: str
    rows: Sequence[MeasurementRow]
    has_clock: bool = True  # false: its times are those of the frames, and no offset is estimated
    origin: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees), height (metres) of the origin of east, north, up, if positions came as such."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementSource:
    """Readings on one clock. See `RowSource`."""

    name: str
    readings: Sequence[Any]
    has_clock: bool = True
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MetricProblem:
    """A linked set of submaps, and where its frames stand."""

    S_world_node: FloatArray  # (N, 4, 4): some of its keyframes, each in its submap's unit
    edges: AtlasEdges  # between nodes, with the map's own covariances
    times_s: FloatArray  # (F,): of the frames, ascending
    T_world_cam: FloatArray  # (F, 4, 4)
    node: IntArray  # (F,): the node that each frame goes by


@dataclass(frozen=True, slots=True, eq=False)
class MetricSolution:
    """The optimum of the joint graph."""

    S_metric_node: FloatArray  # (N, 4, 4)
    covariance: FloatArray  # (N, 7, 7): of the right perturbation of each node, in its own frame and unit
    believed: BoolArray  # (E,): false for connections between submaps that the measurements contradict
    # Readings by kind: those that count, those that were outvoted, those at times without a pose.
    used: Mapping[str, int]
    rejected: Mapping[str, int]
    outside: Mapping[str, int]
    repeated: int  # positions left out: they repeat the one before to the last digit
    normalised_rms: Mapping[str, float]  # RMS of the residuals that count, in their sigmas, by kind
    # By source: add the offset to the source's times to have the frames'.
    clock_offset_s: Mapping[str, float]
    clock_sigma_s: Mapping[str, float]
    # Of the world's unit in the middle of the map; its relative standard deviation.
    metres_per_unit: float
    scale_sigma: float
    # How well the frame of the measurements is known.
    rotation_sigma_rad: float
    translation_sigma_m: float
    drift: float  # how many times the map's own sigmas had to be taken
    misfit_sigmas: float  # excess of the joint cost over its expectation, in its standard deviations, at that drift
    exports: Mapping[str, str] = field(default_factory=dict)  # the graph as other programs read it, by file name


def pose_by_node(s: float, T_node_cam: FloatArray) -> FloatArray:
    """Return the derivative (6, 7) of a metric pose's right perturbation by its node's, whose scale is `s`."""
    Rt, c = T_node_cam[:3, :3].T, T_node_cam[:3, 3]
    J = np.zeros((6, 7))
    J[:3, :3] = Rt
    J[3:, :3] = -s * Rt @ so3.hat(c)
    J[3:, 3:6] = s * Rt
    J[3:, 6] = s * Rt @ c
    return J
