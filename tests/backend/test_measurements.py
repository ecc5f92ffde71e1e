"""Measurements from outside: the plug-ins' promises, and the joint graph on a map whose scale drifts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import gtsam
import numpy as np
import pytest

from dualslam.backend.measurements.base import Gauge, Mount, noise
from dualslam.backend.measurements.conformance import CHECKS
from dualslam.backend.measurements.exports import GTSAM_GRAPH, GTSAM_VALUES
from dualslam.backend.measurements.kinds import RotationRate
from dualslam.backend.measurements.registry import BUILT_IN, measurement_class, readings_of
from dualslam.backend.measurements.solve import solve_metric
from dualslam.core.atlas_problem import AtlasEdges
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.metric_problem import MeasurementRow, MetricProblem, RowSource
from dualslam.core.trajectory import Trajectory
from dualslam.lab.simulated_measurements import Gyroscope, Receiver, poses_at

STEP_SIGMAS = np.array([2e-3] * 3 + [2e-2] * 3 + [4e-3])
RATE_HZ, PER_NODE = 10.0, 10


@dataclass(frozen=True)
class BeaconRange:
    """A third party's measurement: the distance to a radio beacon."""

    kind: ClassVar[str] = "beacon_range"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "x_m", "y_m", "z_m", "range_m", "sigma_m")
    units: ClassVar[tuple[str, ...]] = ("m",)
    fixes: ClassVar[frozenset[Gauge]] = frozenset(Gauge)
    shared_sigmas: ClassVar[tuple[float, ...]] = ()

    t_s: float
    beacon_m: tuple[float, float, float]
    range_m: float
    sigma_m: float

    @property
    def times_s(self):
        return (self.t_s,)

    @property
    def sigmas(self):
        return np.array([self.sigma_m])

    def residual(self, T, shared):
        away = T[0, :3, 3] - np.asarray(self.beacon_m)
        length = np.linalg.norm(away)
        J = np.zeros((1, 6))
        J[0, 3:] = away / length @ T[0, :3, :3]
        return np.array([length - self.range_m]), J

    @classmethod
    def of_row(cls, row, mount):
        return cls(row[0], tuple(row[1:4]), row[4], row[5])

    @classmethod
    def simulate(cls, times_s, T, sigma, rng=None):
        beacon = (10.0, -5.0, 3.0)
        return cls(times_s[0], beacon, float(np.linalg.norm(T[0, :3, 3] - beacon) + noise(rng, sigma, 1)[0]), sigma)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("cls", [*(measurement_class(kind) for kind in BUILT_IN), BeaconRange], ids=lambda c: c.kind)
def test_measurements_conform(cls, check):
    check(cls)


def drive(n: int = 600, hills: float = 3.0) -> Trajectory:
    """A car's way through a town, z up: camera axes x right, y down, z forward."""
    t = np.arange(n) / RATE_HZ
    heading = 0.9 * np.sin(0.11 * t) + 0.5 * np.sin(0.31 * t + 1)
    velocity = 8.0 * np.stack((np.cos(heading), np.sin(heading), 0.0 * t), 1)
    p = np.cumsum(velocity, axis=0) / RATE_HZ
    p[:, 2] = hills * np.sin(0.2 * t)
    forward = np.stack((np.cos(heading), np.sin(heading), 0 * t), 1)
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    R = np.stack((np.cross(down, forward), down, forward), axis=2)
    return Trajectory(t, se3.from_parts(R, p))


def drifted(truth: Trajectory, seed: int = 0, drift: float = 1.0) -> MetricProblem:
    """What a monocular map makes of it: its own unit and frame, a scale that walks off from node to node."""
    rng = np.random.default_rng(seed)
    nodes = np.arange(0, len(truth), PER_NODE)
    S = sim3.from_parts(0.1, so3.exp([0.3, -0.8, 0.2]), [5.0, 1.0, -2.0])  # metres to the map
    T = truth.T_world_cam[nodes]
    S_world_node = [S @ T[0] @ sim3.from_parts(10.0, np.eye(3), np.zeros(3))]
    measured = []
    for a, b in pairwise(T):
        step = se3.inverse(a) @ b
        step[:3, 3] *= 0.1
        measured.append(step @ sim3.exp(drift * STEP_SIGMAS * np.append(np.ones(6), 1) * rng.normal(size=7)))
        S_world_node.append(S_world_node[-1] @ measured[-1])
    S_nodes = np.array(S_world_node)
    node = np.minimum(np.arange(len(truth)) // PER_NODE, len(nodes) - 1)
    local = se3.inverse(truth.T_world_cam[nodes[node]]) @ truth.T_world_cam
    local[:, :3, 3] *= 0.1
    n = len(measured)
    edges = AtlasEdges(
        np.arange(n), np.arange(1, n + 1), np.array(measured), np.broadcast_to(np.diag(STEP_SIGMAS**2), (n, 7, 7)),
        ("within",) * n, np.zeros(n, bool), np.zeros(n, bool),
    )  # fmt: skip
    return MetricProblem(S_nodes, edges, truth.timestamps_s, sim3.act_on_pose(S_nodes[node], local), node)


def errors_m(problem: MetricProblem, solution, truth: Trajectory) -> np.ndarray:
    S = solution.S_metric_node @ sim3.inverse(problem.S_world_node)
    T = sim3.act_on_pose(S[problem.node], problem.T_world_cam)
    return np.linalg.norm(T[:, :3, 3] - truth.T_world_cam[:, :3, 3], axis=1)


def rmse(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).mean()))


def solve(problem, *sources: RowSource):
    return solve_metric(problem, [readings_of(source) for source in sources])


def test_positions_bend_a_map_of_drifting_scale():
    truth = drive()
    problem = drifted(truth)
    rigid = umeyama(problem.T_world_cam[:, :3, 3], truth.T_world_cam[:, :3, 3]).rmse
    solution = solve(problem, Receiver(seed=1).positions(truth))
    assert rmse(errors_m(problem, solution, truth)) < 0.8 < rigid
    assert solution.drift == 1.0
    assert 0.8 < solution.normalised_rms["position"] < 1.2
    # The errors of the nodes are as large as the graph says.
    C = solution.covariance[:, 3:6, 3:6] * sim3.scale(solution.S_metric_node)[:, None, None] ** 2
    R = sim3.rotation(solution.S_metric_node)
    e = solution.S_metric_node[:, :3, 3] - truth.T_world_cam[::PER_NODE, :3, 3]
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(R @ C @ R.swapaxes(1, 2)), e)
    assert 1.0 < nees.mean() < 6.0  # 3 degrees of freedom, neighbours not independent


def test_a_tenth_of_outliers_and_a_clock_that_is_off_are_found():
    truth = drive()
    problem = drifted(truth)
    receiver = Receiver(seed=2, outlier_share=0.1, clock_offset_s=1.3)
    solution = solve(problem, receiver.positions(truth))
    assert rmse(errors_m(problem, solution, truth)) < 1.0
    assert 6 <= solution.rejected["position"] <= 8
    assert abs(solution.clock_offset_s["simulated GPS"] - 1.3) < 4 * solution.clock_sigma_s["simulated GPS"] < 0.4


def test_a_clock_that_is_right_is_left_alone():
    truth = drive()
    solution = solve(drifted(truth), Receiver(seed=3).positions(truth))
    assert solution.clock_offset_s.get("simulated GPS", 0.0) == 0.0


def test_a_map_that_drifts_less_than_it_claims_is_kept_stiff_between_positions_at_its_ends():
    truth = drive()
    problem = drifted(truth, drift=0.1)
    source = Receiver(seed=1).positions(truth)
    ends = [row for row in source.rows if not 10.0 < row.values[0] < truth.timestamps_s[-1] - 10.0]
    solution = solve(problem, replace(source, rows=ends))
    assert solution.drift < 1.0
    aligned = umeyama(
        np.array([problem.T_world_cam[round(RATE_HZ * row.values[0]), :3, 3] for row in ends]),
        np.array([row.values[1:4] for row in ends]),
    ).S_dst_src
    stiff = np.linalg.norm(
        sim3.act(aligned, problem.T_world_cam[:, :3, 3]) - truth.T_world_cam[:, :3, 3], axis=1
    )  # as good as these positions allow
    assert rmse(errors_m(problem, solution, truth)) < 1.5 * rmse(stiff)


def test_a_map_that_drifts_more_than_it_claims_is_bent_further():
    truth = drive()
    problem = drifted(truth, drift=5.0)
    solution = solve(problem, Receiver(seed=4).positions(truth))
    rigid = umeyama(problem.T_world_cam[:, :3, 3], truth.T_world_cam[:, :3, 3]).rmse
    assert solution.drift > 1.0
    assert rmse(errors_m(problem, solution, truth)) < min(2.0, 0.3 * rigid)


def altered(source: RowSource, change) -> RowSource:
    return replace(
        source, rows=[replace(row, values=tuple(change(i, *row.values))) for i, row in enumerate(source.rows)]
    )


def test_a_frozen_receiver_and_a_multipath_jump_are_outvoted():
    truth = drive()
    problem = drifted(truth)
    source = Receiver(seed=5).positions(truth)
    held = source.rows[20].values[1:4]
    frozen = altered(source, lambda i, t, x, y, z, *s: (t, *(held if 20 <= i < 28 else (x, y, z)), *s))
    solution = solve(problem, frozen)
    assert solution.repeated == 7
    assert rmse(errors_m(problem, solution, truth)) < 1.0
    jump = altered(source, lambda i, t, x, y, z, *s: (t, x + 30.0 * (30 <= i < 36), y, z, *s))
    solution = solve(problem, jump)
    assert solution.rejected["position"] >= 6
    assert rmse(errors_m(problem, solution, truth)) < 1.0


HARMLESS = {
    "axes turned": lambda v, rng: np.hstack((v[:, :1], v[:, 1:4] @ so3.exp([0.7, -1.2, 2.0]).T, v[:, 4:])),
    "clock 2 s late": lambda v, rng: v - np.eye(7)[0] * 2.0,
    "clock 2 s early": lambda v, rng: v + np.eye(7)[0] * 2.0,
    "rows out of order": lambda v, rng: v[np.argsort(np.arange(len(v)) + 5 * (rng.random(len(v)) < 0.1))],
    "rows twice": lambda v, rng: np.repeat(v, 2, axis=0),
    "stamps of the row before": lambda v, rng: np.where(np.arange(7) == 0, shifted(v, [7, 17, 27]), v),
    "places of other rows": lambda v, rng: np.where(np.isin(np.arange(len(v)), [5, 15, 25])[:, None], v[::-1], v),
    "frozen for 10 s": lambda v, rng: np.where(between(v, 12, 22) & place, v[12], v),
    "multipath for 8 s": lambda v, rng: v + between(v, 10, 18) * np.array([0, 18.0, 24.0, 0, 0, 0, 0]),
}
REFUSED = {
    "axes are mirrored": lambda v, rng: v * [1, 1, 1, -1, 1, 1, 1],
    "heights seem to be in feet": lambda v, rng: v / [1, 1, 1, 0.3048, 1, 1, 1],
    "x and y seem to be in feet": lambda v, rng: v / [1, 0.3048, 0.3048, 1, 0.3048, 0.3048, 1],
    "do not overlap": lambda v, rng: v + np.eye(7)[0] * 86400,
    "did not move": lambda v, rng: np.where(place, v[0], v),
    "contradict": lambda v, rng: np.where(place, rng.permutation(v), v),
    "clock seems to jump at about 1[3-7] s": lambda v, rng: v + np.eye(7)[0] * 1.5 * between(v, 15, 99),
    "they jump": lambda v, rng: v + between(v, 15, 99) * np.array([0, 18.0, 24.0, 0, 0, 0, 0]),
}
place = (np.arange(7) > 0) & (np.arange(7) < 4)


def between(v: np.ndarray, first: int, last: int) -> np.ndarray:
    row = np.arange(len(v))[:, None]
    return (row >= first) & (row < last)


def shifted(v: np.ndarray, rows: list[int]) -> np.ndarray:
    w = v.copy()
    w[rows] = v[np.array(rows) - 1]
    return w


def misread(truth: Trajectory, change, seed: int = 6) -> RowSource:
    """A receiver's rows, changed all at once: (N, 7) numbers."""
    source = Receiver(seed=seed).positions(truth)
    v = change(np.array([row.values for row in source.rows]), np.random.default_rng(seed))
    return replace(source, rows=[MeasurementRow("position", tuple(row), "gps.csv") for row in v.tolist()])


SLOW = {"multipath for 8 s", "x and y seem to be in feet", "they jump", "axes are mirrored"}


def cases(table) -> list:
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in table]


@pytest.mark.parametrize("name", cases(HARMLESS))
def test_what_is_wrong_with_some_readings_does_not_bend_the_map(name):
    truth = drive(400)
    problem = drifted(truth)
    solution = solve(problem, misread(truth, HARMLESS[name]))
    S = solution.S_metric_node @ sim3.inverse(problem.S_world_node)
    T = sim3.act_on_pose(S[problem.node], problem.T_world_cam)
    # Without a turn of the axes: 0.4 m; the best similarity leaves the bends.
    assert umeyama(T[:, :3, 3], truth.T_world_cam[:, :3, 3]).rmse < 0.8
    if name != "axes turned":
        assert rmse(errors_m(problem, solution, truth)) < 1.2
    assert solution.drift <= 1.0


@pytest.mark.parametrize("words", cases(REFUSED))
def test_what_cannot_belong_to_the_map_is_refused_in_a_sentence(words):
    truth = drive(300, hills=20.0)
    with pytest.raises(InputError, match=words):
        solve(drifted(truth), misread(truth, REFUSED[words]))


def test_swapped_latitude_and_longitude_are_refused_on_flat_ground():
    truth = drive(200, hills=0.0)
    origin = (8.0, 49.0, 100.0)  # as read: latitude 8, longitude 49
    inverse = np.linalg.inv(np.array([[0.0, np.cos(np.radians(49.0))], [1 / np.cos(np.radians(8.0)), 0.0]]))
    source = altered(
        Receiver(seed=7).positions(truth), lambda i, t, x, y, z, *s: (t, *(inverse @ [x, y]).tolist(), z, *s)
    )
    with pytest.raises(InputError, match="swapped"):
        solve(drifted(truth), replace(source, origin=origin))


def test_a_gyroscope_is_turned_into_place_and_its_bias_found():
    truth = drive(hills=20.0)
    problem = drifted(truth)
    gyroscope = Gyroscope(bias_rad_s=(0.01, -0.02, 0.005), turn_rad=(0.5, -1.0, 0.3), seed=8)
    rocking = se3.from_parts(so3.exp(0.2 * np.sin(np.outer(truth.timestamps_s, [1.0, 1.3, 0.7]))), np.zeros(3))
    moving = Trajectory(truth.timestamps_s, truth.T_world_cam @ rocking)
    problem = drifted(moving)
    solution = solve(problem, Receiver(seed=8).positions(moving), gyroscope.rates(moving))
    assert solution.used["rotation_rate"] > 40
    assert not solution.rejected.get("rotation_rate")
    assert solution.normalised_rms["rotation_rate"] < 1.0  # the map is looser: it follows
    assert rmse(errors_m(problem, solution, moving)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("words", ["degrees a second", "rotation_rate contradict|mount contradicts"])
def test_a_gyroscope_that_was_misread_is_refused_in_a_sentence(words):
    truth = drive(300, hills=20.0)
    gyroscope = Gyroscope(turn_rad=(0.5, -1.0, 0.3), seed=8).rates(truth)
    rows = gyroscope.rows
    if "mount" in words:
        rows = [MeasurementRow("mount", (0, 0, 0, 0, 0, 0, 1), ""), *rows]
    else:
        rows = [replace(r, values=(r.values[0], *np.degrees(r.values[1:4]).tolist(), r.values[4])) for r in rows]
    with pytest.raises(InputError, match=words):
        solve(drifted(truth), Receiver(seed=1).positions(truth), replace(gyroscope, rows=rows))


def test_a_gyroscope_alone_gives_no_scale_of_a_sure_map():
    """The map is a million times surer within than the gauge's prior: normal equations have no digits left for both."""
    truth = drive(300)
    problem = drifted(truth, drift=1e-3)
    surer = replace(problem.edges, covariance=1e-6 * problem.edges.covariance)
    solution = solve(replace(problem, edges=surer), Gyroscope(seed=2).rates(truth))
    assert solution.scale_sigma > 0.9


def test_integration_knows_the_bias():
    truth = drive()
    readings = readings_of(Gyroscope(0.001, (0.02, 0.01, -0.03)).rates(truth)).readings
    turns = RotationRate.integrate(readings, np.array([10.0, 12.0, 15.0]))
    assert [turn.times_s for turn in turns] == [(10.0, 12.0), (12.0, 15.0)]
    for turn in turns:
        T = poses_at(truth, np.array(turn.times_s))
        r = turn.residual(T, np.array([0.02, 0.01, -0.03]))[0]
        assert np.abs(r).max() < 4 * turn.sigma_rad
        assert np.abs(turn.residual(T, np.zeros(3))[0]).max() > 10 * turn.sigma_rad


def test_distances_and_heights_give_a_scale_without_positions():
    truth = drive(hills=20.0)
    problem = drifted(truth, drift=0.2)
    T = truth.T_world_cam
    rows = [
        MeasurementRow("distance", (a / RATE_HZ, b / RATE_HZ, np.linalg.norm(T[a, :3, 3] - T[b, :3, 3]), 0.1), "")
        for a, b in ((50, 150), (200, 320), (400, 550))
    ]
    solution = solve(problem, RowSource("tape", rows, has_clock=False))
    assert abs(solution.metres_per_unit / 10.0 - 1.0) < 0.05
    assert solution.scale_sigma < 0.05


def test_a_false_join_is_contradicted_by_heights():
    """Two floors that look alike are joined: the barometer knows that they are 4 m apart."""
    truth = drive(400)
    p = truth.T_world_cam[:, 2, 3]
    p[:200], p[200:] = 0.0, 4.0
    problem = drifted(truth, drift=0.1)
    e = problem.edges
    cut = 19
    kind, doubtful = list(e.kind), e.doubtful.copy()
    kind[cut], doubtful[cut] = "recovery", True
    S, C = e.S_first_second.copy(), e.covariance.copy()
    a, b = truth.T_world_cam[190].copy(), truth.T_world_cam[200].copy()
    b[2, 3] = a[2, 3]
    S[cut] = se3.inverse(a) @ b
    S[cut, :3, 3] *= 0.1
    C[cut] = np.diag(np.array([1e-3] * 3 + [5e-3] * 3 + [5e-3]) ** 2)
    joined = replace(problem, edges=AtlasEdges(e.first, e.second, S, C, tuple(kind), doubtful, e.known))
    heights = [MeasurementRow("height", (t, z, 0.3), "") for t, z in zip(truth.timestamps_s, p, strict=True)]
    gps = Receiver(seed=9).positions(truth)
    with_heights = solve(joined, gps, RowSource("barometer", heights, has_clock=False))
    assert not with_heights.believed[cut]
    assert with_heights.believed.sum() == len(e) - 1
    right = solve(problem, gps, RowSource("barometer", heights, has_clock=False))
    assert right.believed.all()


@pytest.mark.parametrize("off_rad", [0.0, 0.1])
def test_a_gyroscope_contradicts_a_join_whose_turn_is_wrong(off_rad: float):
    truth = drive(250)
    rocking = se3.from_parts(so3.exp(0.1 * np.sin(np.outer(truth.timestamps_s, [1.0, 1.3, 0.7]))), np.zeros(3))
    moving = Trajectory(truth.timestamps_s, truth.T_world_cam @ rocking)
    problem = drifted(moving, drift=0.5)
    e, cut = problem.edges, 12
    kind, doubtful, S = list(e.kind), e.doubtful.copy(), e.S_first_second.copy()
    kind[cut], doubtful[cut] = "recovery", True
    S[cut] = S[cut] @ sim3.exp(np.array([0.0, off_rad, 0.0, 0.0, 0.0, 0.0, 0.0]))
    joined = replace(problem, edges=AtlasEdges(e.first, e.second, S, e.covariance, tuple(kind), doubtful, e.known))
    p = moving.T_world_cam[:, :3, 3]
    rows = [
        MeasurementRow("distance", (a / RATE_HZ, b / RATE_HZ, np.linalg.norm(p[a] - p[b]), 0.2), "")
        for a, b in ((20, 90), (150, 220))
    ]
    gyroscope = Gyroscope(bias_rad_s=(0.01, -0.02, 0.005), seed=4).rates(moving)
    solution = solve(joined, RowSource("tape", rows, has_clock=False), gyroscope)
    assert solution.believed[cut] == (off_rad == 0.0)


def test_the_joint_graph_is_read_back_by_gtsam(tmp_path):
    truth = drive(200)
    problem = drifted(truth)
    solution = solve(problem, Receiver(seed=10).positions(truth))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.deserialize(solution.exports[GTSAM_GRAPH])
    values.deserialize(solution.exports[GTSAM_VALUES])
    assert graph.size() == len(problem.edges) + solution.used["position"]
    assert values.size() == len(problem.S_world_node)
    # It is near its optimum: rigid poses cannot take the last of the scales' say.
    better = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    moved = [np.linalg.norm(better.atPose3(i).translation() - values.atPose3(i).translation()) for i in range(20)]
    assert max(moved) < 1.0
    path = tmp_path / "graph.g2o"
    path.write_text(solution.exports["metric_graph.g2o"])
    read, at = gtsam.readG2o(str(path), True)
    assert read.size() == len(problem.edges)
    assert np.allclose(at.atPose3(3).matrix(), values.atPose3(3).matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "values", "words"),
    [
        ("positon", (0.0,), "did you mean 'position'"),
        ("position", (0.0, 1.0), "takes 7 numbers"),
        ("position", (0.0, 1, np.nan, 3, 1, 1, 1), "y_m of a position is nan"),
        ("position", (0.0, 1, 2, 3, 1, 1, 0), "above 0"),
        ("mount", (0.0, 0, 0, 1, 1, 1, 1), "length 1"),
    ],
)
def test_a_wrong_line_is_named(kind, values, words):
    with pytest.raises(InputError, match=f"gps.csv, line 3.*{words}"):
        readings_of(RowSource("gps.csv", [MeasurementRow(kind, tuple(map(float, values)), "gps.csv, line 3")]))


def test_a_mount_moves_the_antenna():
    row = MeasurementRow("mount", (0.5, -1.0, 0.2, 0.0, 0.0, 0.0, 1.0), "")
    reading = readings_of(RowSource("a", [row, MeasurementRow("position", (0.0, 1, 2, 3, 1, 1, 1), "")])).readings[0]
    T = se3.from_parts(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    assert np.allclose(reading.residual(T[None], np.zeros(0))[0], T[:3, :3] @ [0.5, -1.0, 0.2])
    assert Mount().is_given is False
