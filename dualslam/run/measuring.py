"""Measurements at the end of a run: the joint graph of each linked set, and what it says of the run."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.metric import MetricMap
from dualslam.atlas.trajectory import FramePose
from dualslam.build.parts import MetricParts
from dualslam.core.arrays import concatenate
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.errors import InputError, SolverError
from dualslam.core.metric_problem import MeasurementSource, MetricSolution, RowSource
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray
from dualslam.io.export.metric import write_scale
from dualslam.io.measurements import read_measurements
from dualslam.io.metric_files import write_covariances, write_metric

log = logging.getLogger(__name__)

MAX_SCALE_SIGMA, MAX_TURN_RAD = 0.1, 0.2
"""A map that measurements place no better has no place among the others: its scale or turn is not known."""
MAX_METRIC_SIGMA = 0.5
"""Of the logarithm of the scale: beyond, a trajectory is not in metres."""
MAX_MISFIT = 5.0
"""Standard deviations of the joint cost over its expectation, at the largest drift: measurements and map disagree."""
MANY_REJECTED = 0.2
REPORTED = (
    *("used", "rejected", "outside", "repeated", "normalised_rms", "clock_offset_s", "clock_sigma_s"),
    *("metres_per_unit", "scale_sigma", "rotation_sigma_rad", "translation_sigma_m", "drift", "misfit_sigmas"),
)
"""Fields of the solution that ``summary.json`` has."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A run in the frame of its measurements."""

    frames: Trajectory  # all frames that could be placed, by their numbers
    covariance: FloatArray  # (F, 6, 6)
    main: MetricSolution  # of the main map
    placed_alone: list[int] = field(default_factory=list)  # submaps outside the main map that only measurements place
    undone: list[Link] = field(default_factory=list)  # connections that the measurements contradict
    origin: tuple[float, float, float] | None = None

    @property
    def is_consistent(self) -> bool:
        """Whether map and measurements agree within their sigmas."""
        return self.main.misfit_sigmas <= MAX_MISFIT

    @property
    def rejected_share(self) -> float:
        """Share of the measurements that were outvoted."""
        n_rejected, n_used = sum(self.main.rejected.values()), sum(self.main.used.values())
        return n_rejected / max(n_rejected + n_used, 1)

    def line(self) -> str:
        """Return the outcome in one line."""
        s = self.main
        used = ", ".join(f"{n} of {kind}" for kind, n in s.used.items())
        parts = [f"{used} used, {sum(s.rejected.values())} rejected, {sum(s.outside.values())} without a pose"]
        parts.append(f"scale known to {100 * s.scale_sigma:.2g} %")
        parts += [f"clock of {name} {t:+.2f} s" for name, t in s.clock_offset_s.items() if t]
        if self.placed_alone:
            parts.append(f"submaps placed by measurements alone: {', '.join(map(str, self.placed_alone))}")
        return f"measurements: {'; '.join(parts)}"

    def summary(self) -> dict[str, Any]:
        """Return what ``summary.json`` holds."""
        return {name: getattr(self.main, name) for name in REPORTED} | {
            "frames": len(self.frames),
            "submaps_placed_by_measurements_alone": self.placed_alone,
            "joins_undone": [[link.a, link.b] for link in self.undone],
            "origin": None if self.origin is None else list(self.origin),
        }


def read_rows(
    paths: Sequence[Path],
    sigma: float | None,
    clock_offset_s: float,
    frame_times_s: FloatArray | None,
    origin: tuple[float, float, float] | None = None,
) -> list[RowSource]:
    """Read files of measurements; positions by latitude and longitude have the origin given, or the first one's.

    Raises `InputError`.
    """
    found: list[RowSource] = []
    for path in paths:
        found.append(read_measurements(path, sigma, clock_offset_s, frame_times_s, origin))
        origin = origin or found[-1].origin
    return found


def measure(
    atlas: Atlas,
    poses: Mapping[int, FramePose],
    main: list[int],
    sources: Sequence[MeasurementSource],
    parts: MetricParts,
) -> Measured:
    """Put all maps that measurements can place into their frame.

    Connections that the measurements contradict are marked as rejected in the atlas, and the main map is solved again.

    `main`: submaps of the main map.

    Raises `InputError`: in one sentence, where the measurements cannot belong to the main map.
    Raises `SolverError`.
    """
    undone: list[Link] = []
    names, n_posed = ", ".join(s.name for s in sources), Counter(pose.submap_id for pose in poses.values())
    while True:
        metric = MetricMap.of(atlas, list(poses.values()), main, parts.covariances)
        if metric is None:
            raise InputError(f"{names}: no map to measure: too few frames have poses.")
        solution = parts.solve(metric.problem, sources, None)
        refuted = metric.refuted(solution)
        if not refuted:
            break
        undone += refuted
        atlas.links = [replace(link, rejected=True) if link in refuted else link for link in atlas.links]
        left = [c for c in atlas.components() if set(c) <= set(main)]
        main = max(left, key=lambda c: sum(n_posed[m] for m in c))
    if solution.scale_sigma > MAX_METRIC_SIGMA:
        raise InputError(
            f"{names}: these measurements do not fix the scale of the map; add positions, distances or odometry."
        )
    clocks = {s.name: solution.clock_offset_s.get(s.name, 0.0) for s in sources}
    placed, alone = [(metric, solution)], list[int]()
    for component in atlas.components():
        if component == main:
            continue
        try:
            other = MetricMap.of(atlas, list(poses.values()), component, parts.covariances)
            of_other = parts.solve(other.problem, sources, clocks) if other else None
        except (InputError, SolverError) as error:
            log.info("submaps %s are not placed by measurements: %s", component, error)
            continue
        if (
            other
            and of_other
            and of_other.scale_sigma <= MAX_SCALE_SIGMA
            and of_other.rotation_sigma_rad <= MAX_TURN_RAD
        ):
            placed.append((other, of_other))
            alone += component
    origin = next((s.origin for s in sources if s.origin is not None), None)
    covariance = np.concatenate([m.covariances(s.S_metric_node, s.covariance) for m, s in placed])
    return Measured(concatenate([m.placed(s) for m, s in placed]), covariance, solution, alone, undone, origin)


def write_relative(
    folder: Path,
    atlas: Atlas,
    poses: Mapping[int, FramePose],
    main: list[int],
    solver: AtlasSolver,
    index_of: Mapping[int, int],
) -> None:
    """Write the covariances of the main map's frames relative to the first one, for a run without measurements."""
    try:
        metric = MetricMap.of(atlas, list(poses.values()), main, solver.edge_covariances)
        covariance = None if metric is None else metric.relative_covariances(solver)
    except SolverError as error:
        log.warning("the frames have no covariances: %s", error)
        return
    if metric is not None and covariance is not None:
        frames, covariance = _of_source(metric.frames, covariance, index_of)
        write_covariances(folder, frames, covariance)


def _of_source(
    frames: Trajectory, covariance: FloatArray, index_of: Mapping[int, int]
) -> tuple[Trajectory, FloatArray]:
    """Return those frames that the source has, by its numbers."""
    kept = np.array([i in index_of for i in frames.index.tolist()], bool)
    frames = frames.take(kept)
    index = np.array([index_of[i] for i in frames.index.tolist()], np.int64)
    return replace(frames, index=index), covariance[kept]


def write_measured(folder: Path, measured: Measured, index_of: Mapping[int, int]) -> None:
    """Write the metric files of a run folder; `index_of`: of a frame's number in the source, where it has one."""
    frames, covariance = _of_source(measured.frames, measured.covariance, index_of)
    write_metric(folder, frames, covariance, measured.main.exports, measured.origin)
    write_scale(folder, measured.main.metres_per_unit, measured.main.scale_sigma, "measurements")
