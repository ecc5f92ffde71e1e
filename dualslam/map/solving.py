"""A submap to which much was added at once, solved in batch."""

from __future__ import annotations

from collections.abc import Callable

from dualslam.core.interfaces import SubmapGraph
from dualslam.map.submap import Submap


def open_graph(submap: Submap, new_graph: Callable[[], SubmapGraph]) -> SubmapGraph:
    """Return a graph of a submap as it is, solved in batch, from which covariances can be asked.

    The submap stays as it is.

    Raises `SolverError`.
    """
    graph = new_graph()
    graph.rebuild(submap.copy(), near_optimum=True)
    return graph


def solve(submap: Submap, graph: SubmapGraph, near_optimum: bool = False) -> int:
    """Solve a submap in a graph made anew, and drop what the solution contradicts; return how many observations.

    `near_optimum`: whether its parts are solved already.

    Raises `SolverError`.
    """
    estimate = graph.rebuild(submap, near_optimum)
    submap.apply_estimate(*estimate.values)
    submap.remove_outliers(estimate.outlier_rows)
    return len(estimate.outlier_rows)
