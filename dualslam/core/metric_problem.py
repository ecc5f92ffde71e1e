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
    """A line of a file of measurements.

    Attributes
    ----------
    kind : str
    values : tuple of float
    where : str
        File and line, for messages.
    """

    kind: str
    values: tuple[float, ...]
    where: str


@dataclass(frozen=True, slots=True, eq=False)
class RowSource:
    """Contents of a file of measurements.

    Attributes
    ----------
    name : str
    rows : sequence of MeasurementRow
    has_clock : bool
        False: its times are those of the frames, and no offset is estimated.
    origin : (float, float, float) or None
        Latitude, longitude (degrees) and height (metres) of the origin, if positions came as such. They are then east,
        north, up.
    """

    name: str
    rows: Sequence[MeasurementRow]
    has_clock: bool = True
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementSource:
    """Readings on one clock. See `RowSource`.

    Attributes
    ----------
    name : str
    readings : sequence of Measurement
    has_clock : bool
    origin : (float, float, float) or None
    """

    name: str
    readings: Sequence[Any]
    has_clock: bool = True
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MetricProblem:
    """A linked set of submaps, and where its frames stand.

    Attributes
    ----------
    S_world_node : (N, 4, 4)
        Some of its keyframes, each in its submap's unit.
    edges : AtlasEdges
        Between nodes, with the map's own covariances.
    times_s : (F,)
        Of the frames, ascending.
    T_world_cam : (F, 4, 4)
    node : (F,) int64
        The node that each frame goes by.
    """

    S_world_node: FloatArray
    edges: AtlasEdges
    times_s: FloatArray
    T_world_cam: FloatArray
    node: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class MetricSolution:
    """The optimum of the joint graph.

    Attributes
    ----------
    S_metric_node : (N, 4, 4)
    covariance : (N, 7, 7)
        Of the right perturbation of each node, in its own frame and unit.
    believed : (E,) bool
        False for connections between submaps that the measurements contradict.
    used, rejected, outside : mapping of str to int
        Readings by kind: those that count, those that were outvoted, those at times without a pose.
    normalised : mapping of str to float
        RMS of the residuals that count, in their sigmas, by kind.
    clock_offset_s, clock_sigma_s : mapping of str to float
        By source: add the offset to the source's times to have the frames'.
    metres_per_unit, scale_sigma : float
        Of the world's unit in the middle of the map; its relative standard deviation.
    rotation_sigma_rad, translation_sigma_m : float
        How well the frame of the measurements is known.
    drift : float
        How many times the map's own sigmas had to be taken.
    misfit : float
        Excess of the joint cost over its expectation, in its standard deviations, at that drift.
    exports : mapping of str to str
        The graph as other programs read it, by file name.
    """

    S_metric_node: FloatArray
    covariance: FloatArray
    believed: BoolArray
    used: Mapping[str, int]
    rejected: Mapping[str, int]
    outside: Mapping[str, int]
    normalised: Mapping[str, float]
    clock_offset_s: Mapping[str, float]
    clock_sigma_s: Mapping[str, float]
    metres_per_unit: float
    scale_sigma: float
    rotation_sigma_rad: float
    translation_sigma_m: float
    drift: float
    misfit: float
    exports: Mapping[str, str] = field(default_factory=dict)


def pose_by_node(s: float, T_node_cam: FloatArray) -> FloatArray:
    """Return the derivative (6, 7) of a metric pose's right perturbation by its node's, whose scale is `s`."""
    Rt, c = T_node_cam[:3, :3].T, T_node_cam[:3, 3]
    J = np.zeros((6, 7))
    J[:3, :3] = Rt
    J[3:, :3] = -s * Rt @ so3.hat(c)
    J[3:, 3:6] = s * Rt
    J[3:, 6] = s * Rt @ c
    return J
