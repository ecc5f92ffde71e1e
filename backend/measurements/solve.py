"""A map in the frame of measurements: the joint graph's solution, or the sentence that refuses the measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dualslam.backend.measurements.base import Mount
from dualslam.backend.measurements.joint_graph import DRIFTS, MAX_RUN, JointGraph
from dualslam.backend.measurements.kinds import RotationRate
from dualslam.backend.measurements.start import MAX_OFFSET_S, POSITION, QUANTILE_99
from dualslam.backend.solver import GTSAM_ERRORS, SolverFailure
from dualslam.core.errors import InputError, SolverError
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, MetricSolution
from dualslam.core.types import FloatArray

MAX_REJECTED = 0.4
"""Share of readings of a kind that may be outvoted: beyond, it is not known who is wrong."""
MISREAD = 2.0 * float(np.log(1000.0))
"""Difference of costs, twice a logarithm of likelihoods: one file in a thousand is wrong in a given way."""
FOOT_M = 0.3048
Misreading = tuple[str, list[MeasurementSource], float]
"""What is wrong, in words; the sources without the mistake; what is to be added to their cost. A density whose sigmas
are in a larger unit is lower: the addition is twice the logarithm of the factor."""


def solve_metric(
    problem: MetricProblem,
    sources: Sequence[MeasurementSource],
    known_offsets_s: Mapping[str, float] | None = None,
) -> MetricSolution:
    """Put a map into the frame of measurements.

    `known_offsets_s`: of clocks, by source, that were estimated with another map: they are not estimated again.

    Raises `InputError`, in one sentence, where the measurements do not fit the map as they are. Raises `SolverError`.
    """
    known = known_offsets_s or {}
    names = ", ".join(source.name for source in sources)
    try:
        joint = JointGraph.solved(problem, sources, known, DRIFTS)
        if not joint.is_plain:
            read_otherwise = [  # if the file is wrong, the map is right
                (JointGraph.solved(problem, others, known, DRIFTS[:1]).cost + price, words)
                for words, others, price in misreadings(sources, joint.jumps_s)
            ]
            cost, words = min(read_otherwise, default=(np.inf, ""))
            if cost < joint.cost - joint.rebate() - MISREAD:
                raise InputError(f"{names}: {words}; correct the file.")
        solution = joint.solution()
    except GTSAM_ERRORS as error:
        raise SolverError(
            f"the joint graph of {len(problem.S_world_node)} nodes failed: {SolverFailure.of(error)}"
        ) from error
    _check(solution, joint, names)
    return solution


def _check(solution: MetricSolution, joint: JointGraph, names: str) -> None:
    """Refuse measurements that are outvoted, that jump where the map bends, or whose clock is far off."""
    for kind, n in solution.rejected.items():
        total = n + solution.used.get(kind, 0)
        if total >= 3 and n > MAX_REJECTED * total:
            raise InputError(
                f"{names}: {n} of {total} measurements of {kind} contradict the map and the others: they are of "
                "another recording, or their sigmas are too small."
            )
    run = joint.longest_run()
    if len(run) > MAX_RUN and joint.drift > 1:
        raise InputError(
            f"{names}: the positions from {run[0]:.1f} to {run[-1]:.1f} s contradict the map, and so do those "
            "before or after: they jump. Remove what is wrong (multipath, a clock that was set)."
        )
    for name, offset in solution.clock_offset_s.items() if solution.believed.all() else ():
        if abs(offset) > MAX_OFFSET_S + QUANTILE_99 * solution.clock_sigma_s[name]:
            raise InputError(
                f"{name}: its clock would be {offset:+.1f} s off, more than {MAX_OFFSET_S:.0f} s: give --clock-offset, "
                "or the file of this recording."
            )


def misreadings(sources: Sequence[MeasurementSource], jumps_s: Mapping[int, float]) -> Iterator[Misreading]:
    """Yield what may be wrong with sources; `jumps_s`: by source, where its clock would jump if it does."""
    for i, source in enumerate(sources):
        before, after = sources[:i], sources[i + 1 :]
        n = sum(r.kind == POSITION for r in source.readings)
        for words, A in _axes(source).items() if n else ():
            yield words, [*before, _transformed(source, A), *after], 0.0
            shrunk = -2.0 * n * float(np.log(abs(np.linalg.det(A))))
            if shrunk > 1:  # sigmas in metres beside lengths in feet
                yield words, [*before, _transformed(source, A, keep_sigmas=True), *after], shrunk
        for words, change in _TURNS.items():
            read = [change(r) for r in source.readings]
            if any(a is not b for a, b in zip(read, source.readings, strict=True)):
                yield words, [*before, replace(source, readings=read), *after], 0.0
        if i in jumps_s:
            parts = [[r for r in source.readings if (r.times_s[0] >= jumps_s[i]) is late] for late in (False, True)]
            split = [replace(source, readings=part) for part in parts]
            yield f"its clock seems to jump at about {jumps_s[i]:.0f} s", [*before, *split, *after], 0.0


def _without_mount(r: Any) -> Any:
    return replace(r, mount=Mount()) if getattr(r, "mount", Mount()).is_given else r


def _from_degrees(r: Any) -> Any:
    return replace(r, turn_rad=np.radians(r.turn_rad)) if r.kind == RotationRate.kind else r


_TURNS: Mapping[str, Callable[[Any], Any]] = {
    "its mount contradicts the turns of the camera": _without_mount,
    "its rates seem to be in degrees a second": _from_degrees,
}


def _axes(source: MeasurementSource) -> dict[str, FloatArray]:
    found = {
        "its axes are mirrored": np.diag([1.0, 1.0, -1.0]),
        "its heights seem to be in feet": np.diag([1.0, 1.0, FOOT_M]),
        "its x and y seem to be in feet": np.diag([FOOT_M, FOOT_M, 1.0]),
    }
    if source.origin is not None:
        latitude, longitude = np.radians(source.origin[:2])
        A = np.eye(3)
        A[:2, :2] = [[0.0, np.cos(longitude)], [1.0 / np.cos(latitude), 0.0]]
        found = {"its latitude and longitude seem to be swapped": A} | found
    return found


def _transformed(source: MeasurementSource, A: FloatArray, keep_sigmas: bool = False) -> MeasurementSource:
    """Return the source with its positions transformed about their median."""
    middle = np.median([r.xyz_m for r in source.readings if r.kind == POSITION], axis=0)

    def other(r: Any) -> Any:
        if r.kind != POSITION:
            return r
        x, y, z = (A @ (np.asarray(r.xyz_m) - middle) + middle).tolist()
        sx, sy, sz = (r.sigmas if keep_sigmas else np.sqrt(A**2 @ r.sigmas**2)).tolist()
        return replace(r, xyz_m=(x, y, z), sigma_m=(sx, sy, sz))

    return replace(source, readings=[other(r) for r in source.readings])
