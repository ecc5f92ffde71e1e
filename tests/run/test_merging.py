"""Two runs as one map: joined by places that both saw, or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dualslam.atlas.stored_map import bring_to_pixels
from dualslam.cli import main
from dualslam.core.config.settings import Config
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.trajectory import Trajectory
from dualslam.io.map_store import load_atlas
from dualslam.io.trajectory_files import read_tum
from dualslam.lab.simulated_measurements import Receiver, csv_text
from dualslam.run.runner import RunReport
from dualslam.run.session import save_system
from dualslam.testing.point_world import CAMERA, RATE_HZ, PointWorld
from tests.places.worlds import N_LAP, RADIUS_M, ring, run, wall

RANGES = {"a": range(60), "b": range(35, 95), "elsewhere": range(78, 105)}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of parts of one lap, each with a clock that begins at 0."""
    folder = tmp_path_factory.mktemp("runs")
    for name, part in RANGES.items():
        system = run(PointWorld(wall(), ring(N_LAP)[list(part)]))
        system.finish()
        zeros = (0.0,) * len(part)
        report = RunReport(len(part), zeros, zeros, 1.0, 1.0, 0.0)
        save_system(system, Config(), CAMERA, report, folder / name)
    return {name: folder / name for name in RANGES}


def test_two_parts_of_a_lap_become_one_map(runs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "merged"
    assert main(["merge", str(runs["a"]), str(runs["b"]), "--out", str(out), "--quiet"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    apart = [read_tum(out / f"trajectory_{name}.txt") for name in "ab"]
    assert summary["posed"] == sum(map(len, apart)) == len(read_tum(out / "trajectory.txt"))
    assert min(map(len, apart)) > 50
    # One similarity puts both runs on the truth: their unit and their frame are one.
    step_s = 1.0 / RATE_HZ
    truth = ring(N_LAP)[:, :3, 3]
    estimated = np.concatenate([t.T_world_cam[:, :3, 3] for t in apart])
    true = np.concatenate(
        [
            truth[RANGES[name].start + np.rint(t.timestamps_s / step_s).astype(int)]
            for name, t in zip("ab", apart, strict=True)
        ]
    )
    S = umeyama(estimated, true).S_dst_src
    error = np.linalg.norm(estimated @ S[:3, :3].T + S[:3, 3] - true, axis=1)
    assert np.sqrt((error**2).mean()) < 0.02 * RADIUS_M
    # The frames of the second run follow those of the first, and so does its clock.
    second = summary["merged"]["runs"][1]
    assert second["first_frame"] >= len(RANGES["a"])
    assert second["clock_shift_s"] > RANGES["a"].stop * step_s
    assert len(load_atlas(out).main) == 2
    # What was joined can be read and be joined again.
    assert main(["merge", str(out), str(runs["b"]), "--out", str(tmp_path / "again"), "--quiet"]) == 0


def test_measurements_of_both_runs_are_in_one_graph(runs: dict[str, Path], tmp_path: Path) -> None:
    truth, options, sigma_m = ring(N_LAP), [], 0.05
    for n, (name, option) in enumerate((("a", "--measurements"), ("b", "--measurements-b"))):
        T = truth[list(RANGES[name])]
        readings = Receiver(sigma_m=sigma_m, rate_hz=5.0, seed=n).positions(Trajectory(np.arange(len(T)) / RATE_HZ, T))
        (tmp_path / f"{name}.csv").write_text(csv_text(readings))
        options += [option, str(tmp_path / f"{name}.csv")]
    out = tmp_path / "merged"
    assert main(["merge", str(runs["a"]), str(runs["b"]), "--out", str(out), "--quiet", *options]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["measurements"]["frames"] == summary["posed"]
    metric = read_tum(out / "trajectory_metric.txt")
    true = np.concatenate([truth[list(RANGES[name])] for name in "ab"])[:, :3, 3]
    assert len(metric) == len(true)
    error = np.linalg.norm(metric.T_world_cam[:, :3, 3] - true, axis=1)
    assert np.sqrt((error**2).mean()) < 2 * sigma_m


def test_places_that_never_met_are_refused(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "merged"
    assert main(["merge", str(runs["a"]), str(runs["elsewhere"]), "--out", str(out)]) == 2
    assert "have no place in common" in capsys.readouterr().err
    assert not out.exists()


def test_a_map_in_other_pixels_has_the_same_rays(runs: dict[str, Path]) -> None:
    submap = load_atlas(runs["a"]).atlas.submaps[0]
    before = [(kf.features.uv_rect_px - submap.K[:2, 2]) / submap.K[0, 0] for kf in submap.keyframes.values()]
    sigma = next(iter(submap.keyframes.values())).features.sigma_px / submap.K[0, 0]
    K = np.array([[2 * submap.K[0, 0], 0, 10.0], [0, 2 * submap.K[1, 1], 20.0], [0, 0, 1]])
    bring_to_pixels(submap, K, 1.2)
    for kf, xy in zip(submap.keyframes.values(), before, strict=True):
        assert (kf.features.uv_rect_px - K[:2, 2]) / K[0, 0] == pytest.approx(xy)
    assert next(iter(submap.keyframes.values())).features.sigma_px / K[0, 0] == pytest.approx(sigma)
