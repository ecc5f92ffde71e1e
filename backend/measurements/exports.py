"""The joint graph as other programs read it: rigid poses in metres, as g2o and as GTSAM's own factors."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.backend.measurements.path import Term
from dualslam.backend.noise import gaussian
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.metric_problem import MetricProblem
from dualslam.core.types import FloatArray

G2O, GTSAM_GRAPH, GTSAM_VALUES = "metric_graph.g2o", "metric_graph_gtsam.txt", "metric_values_gtsam.txt"
SWAPPED = np.array([3, 4, 5, 0, 1, 2])
"""g2o puts translation before rotation."""


def export_graph(problem: MetricProblem, S_metric_node: FloatArray, terms: Sequence[Term]) -> dict[str, str]:
    """Return the texts of three files by their names.

    Scales are taken as solved: an edge's translation and covariance are in metres. Positions are `GPSFactorArm` in
    GTSAM's file; g2o has no edge for them, nor have other kinds one here.
    """
    T_metric_node = se3.from_parts(sim3.rotation(S_metric_node), sim3.translation(S_metric_node))
    scale = sim3.scale(S_metric_node)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lines = []
    for i, T in enumerate(T_metric_node):
        values.insert(i, convert.to_pose3(T))
        lines.append(f"VERTEX_SE3:QUAT {i} {_words(T)}")
    for e in problem.edges:
        unit = np.repeat([1.0, float(scale[e.second])], 3)
        C = unit[:, None] * e.covariance[:6, :6] * unit
        T = se3.from_parts(sim3.rotation(e.S_first_second), scale[e.first] * sim3.translation(e.S_first_second))
        graph.push_back(gtsam.BetweenFactorPose3(e.first, e.second, convert.to_pose3(T), gaussian(C)))
        information = np.linalg.inv(C)[np.ix_(SWAPPED, SWAPPED)]
        upper = " ".join(f"{x:.9g}" for x in information[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {e.first} {e.second} {_words(T)} {upper}")
    for term in terms:
        if term.reading.kind == "position":
            at = term.T_node_cam[0]
            arm = scale[term.nodes[0]] * se3.translation(at) + se3.rotation(at) @ np.asarray(term.reading.lever_arm_m)
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(term.reading.sigmas, float))
            graph.push_back(gtsam.GPSFactorArm(term.nodes[0], np.asarray(term.reading.xyz_m, float), arm, noise))
    return {G2O: "\n".join(lines) + "\n", GTSAM_GRAPH: graph.serialize(), GTSAM_VALUES: values.serialize()}


def _words(T: FloatArray) -> str:
    return " ".join(f"{x:.9g}" for x in (*se3.translation(T), *so3.quat_xyzw_from_matrix(se3.rotation(T))))
