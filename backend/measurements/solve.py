"""A map in the frame of measurements: the joint graph's solution, or the sentence that refuses the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dualslam.backend.measurements.joint_graph import DRIFTS, MAX_RUN, JointGraph
from dualslam.backend.measurements.misreadings import misreadings
from dualslam.backend.measurements.start import MAX_OFFSET_S, QUANTILE_99
from dualslam.backend.solver import GTSAM_ERRORS, SolverFailure
from dualslam.core.errors import InputError, SolverError
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, MetricSolution

MAX_REJECTED = 0.4
"""Share of readings of a kind that may be outvoted: beyond, it is not known who is wrong."""
MISREAD = 2.0 * float(np.log(1000.0))
"""Difference of costs, twice a logarithm of likelihoods: one file in a thousand is wrong in a given way."""


def solve_metric(
    problem: MetricProblem,
    sources: Sequence[MeasurementSource],
    known_offsets_s: Mapping[str, float] | None = None,
) -> MetricSolution:
    """Put a map into the frame of measurements.

    `known_offsets_s`: of clocks, by source, that were estimated with another map: they are not estimated again.

    Raises `InputError`, in one sentence, where the measurements cannot belong to the map: where they do not fit as they
    are, and fit far better read otherwise. Raises `SolverError`.
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
