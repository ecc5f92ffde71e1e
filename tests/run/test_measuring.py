"""Measurements of a run: maps that no link joins are placed beside each other, and a false join is undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import LinkKind
from dualslam.atlas.metric import MetricMap
from dualslam.build.parts import atlas_solver, measurement_sources, metric_parts
from dualslam.core.config.files import load_config
from dualslam.core.errors import InputError
from dualslam.core.geometry import sim3
from dualslam.core.metric_problem import MeasurementRow, RowSource
from dualslam.core.trajectory import Trajectory
from dualslam.lab.simulated_measurements import Receiver, csv_text
from dualslam.run.measuring import measure, read_rows, write_measured, write_relative
from dualslam.testing.atlas_world import DriftingMap

FIRST, SECOND = range(60), range(64, 120)
SIGMA_M = 0.03


@pytest.fixture
def world() -> DriftingMap:
    """Two halves of a lap, in maps that share nothing."""
    world = DriftingMap(120)
    for k in FIRST:
        world.add(k)
    world.begin_anew()
    for k in SECOND:
        world.add(k)
    return world


def truth_of(world: DriftingMap) -> Trajectory:
    return Trajectory(0.1 * np.arange(world.n), world.T_true)


def positions(world: DriftingMap) -> RowSource:
    return Receiver(sigma_m=SIGMA_M, rate_hz=5.0, seed=3).positions(truth_of(world))


def errors_m(world: DriftingMap, frames: Trajectory) -> np.ndarray:
    return np.linalg.norm(frames.T_world_cam[:, :3, 3] - world.T_true[frames.index][:, :3, 3], axis=1)


def measured_of(world: DriftingMap, *sources: RowSource):
    main = max(world.atlas.components(), key=len)
    return measure(world.atlas, world.record.poses, main, measurement_sources(sources), metric_parts(load_config()))


def test_maps_without_a_link_are_placed_by_positions(world: DriftingMap, tmp_path):
    measured = measured_of(world, positions(world))
    assert measured.placed_alone == [1]
    assert len(measured.frames) == len(FIRST) + len(SECOND)
    assert np.sqrt((errors_m(world, measured.frames) ** 2).mean()) < 2 * SIGMA_M
    assert measured.is_consistent
    summary = measured.summary()
    assert summary["submaps_placed_by_measurements_alone"] == [1]
    assert summary["rejected"].get("position", 0) <= 2
    (tmp_path / "map").mkdir()
    write_measured(tmp_path, measured, {k: k for k in range(world.n)})
    assert len((tmp_path / "trajectory_metric.txt").read_text().splitlines()) >= len(measured.frames)
    assert np.load(tmp_path / "covariances.npz")["covariance"].shape == (len(measured.frames), 6, 6)


@pytest.mark.parametrize("is_true", [True, False], ids=["a true join", "a false join"])
def test_only_a_false_join_is_undone(world: DriftingMap, is_true: bool):
    off = None if is_true else np.array([0.0, 0.4, 0.0, 1.5, 0.0, 0.0, 0.2])
    world.atlas.link(world.loop((0, 50), (1, 70), off, kind=LinkKind.RECOVERY))
    assert len(world.atlas.components()) == 1
    measured = measured_of(world, positions(world))
    assert len(measured.undone) == (0 if is_true else 1)
    assert len(world.atlas.components()) == (1 if is_true else 2)
    # Either way all frames are placed right: where no join holds them, the positions do.
    assert len(measured.frames) == len(FIRST) + len(SECOND)
    assert np.sqrt((errors_m(world, measured.frames) ** 2).mean()) < 2 * SIGMA_M


def test_heights_alone_fix_no_scale_of_a_level_drive(world: DriftingMap):
    rows = [MeasurementRow("height", (0.1 * k, 0.0, 0.1), "") for k in FIRST[::6]]
    with pytest.raises(InputError, match="do not fix the scale"):
        measured_of(world, RowSource("barometer", rows, has_clock=False))


def test_files_are_read_with_one_origin_and_named_in_errors(world: DriftingMap, tmp_path):
    path = tmp_path / "gps.csv"
    path.write_text(csv_text(positions(world)))
    (source,) = read_rows([path], None, 0.0, None)
    assert len(measurement_sources([source])[0].readings) == len(source.rows)
    (late,) = read_rows([path], None, 1000.0, None)
    with pytest.raises(InputError, match=r"gps\.csv: its times.*do not overlap"):
        measured_of(world, late)
    in_ms = RowSource("ms", [replace(r, values=(1e3 * r.values[0], *r.values[1:])) for r in positions(world).rows])
    with pytest.raises(InputError, match="seem to be in milliseconds"):
        measured_of(world, replace(in_ms, rows=[r for r in in_ms.rows if r.values[0] > 20.0]))


def test_covariances_without_measurements_grow_from_the_first_frame(world: DriftingMap, tmp_path):
    solver = atlas_solver(load_config())
    metric = MetricMap.of(world.atlas, list(world.record.poses.values()), [0], solver.edge_covariances)
    assert metric is not None
    C = metric.relative_covariances(solver)
    assert not C[0].any()
    rows, knots = metric.skeleton.knots(0)
    trace = np.trace(C[:, 3:, 3:], axis1=1, axis2=2)
    assert (np.diff(trace[knots]) > 0).all()
    # At a node they are its own, in the unit of the world; half way to the next, half of both.
    own = solver.relative_covariances(metric.skeleton.problem, 0)[rows[1]]
    scale = sim3.scale(metric.problem.S_world_node[rows[1]])
    np.testing.assert_allclose(C[knots[1], 3:, 3:], scale**2 * own[3:6, 3:6], rtol=1e-6)
    assert (np.linalg.eigvalsh(C[1:]) > 0).all()
    middle = (knots[1] + knots[2]) // 2
    assert trace[knots[1]] < trace[middle] < trace[knots[2]]
    write_relative(tmp_path, world.atlas, world.record.poses, [0], solver, {k: 100 + k for k in FIRST})
    written = np.load(tmp_path / "covariances.npz")
    assert written["index"].tolist() == [100 + k for k in FIRST]
    np.testing.assert_allclose(written["covariance"], C)
