"""The front door for programs: what it returns, what it leaves behind, and what a notebook shows of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dualslam
from dualslam.core.errors import InputError, OutputError
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.map.frame_records import FrameResult
from dualslam.report import read_run

N_FRAMES = 24
WORLD = f"synthetic:street,frames={N_FRAMES},seed=1,width=320,height=240"


@pytest.fixture(scope="module")
def tracked() -> tuple[dualslam.Slam, list[FrameResult]]:
    sequence = dualslam.open_source(WORLD)
    slam = dualslam.Slam(sequence.camera, config=dualslam.load_config(overrides=["frontend.n_features=500"]))
    return slam, [slam.track(frame.image, frame.timestamp_s) for frame in sequence]


@pytest.fixture(scope="module")
def folder(tracked: tuple[dualslam.Slam, list[FrameResult]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "room"
    tracked[0].save(out)
    return out


def test_each_image_gives_a_pose_or_the_reason_why_not(tracked: tuple[dualslam.Slam, list[FrameResult]]) -> None:
    results = tracked[1]
    posed = [r for r in results if not r.lost]
    assert len(posed) > N_FRAMES / 2
    for r in results:
        assert (r.pose is None) == (r.position is None) == bool(r.lost)
    np.testing.assert_array_equal(posed[-1].position, posed[-1].pose[:3, 3])
    assert results[0].lost
    assert posed[-1].status == "tracked"
    truth = dualslam.open_source(WORLD).ground_truth.T_world_cam[:, :3, 3]
    way = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    index = [r.index for r in posed]
    assert distances_when_aligned(np.array([r.position for r in posed]), truth[index]).max() < 0.05 * way


def test_the_map_is_arrays(tracked: tuple[dualslam.Slam, list[FrameResult]]) -> None:
    slam = tracked[0]
    assert slam.map is not None
    assert slam.map.xyz.shape[0] > 50
    assert np.median(slam.map.reprojection_errors_px()) < 1.0
    assert len(slam.trajectory) >= len(slam.map.frame)
    assert len(repr(slam)) < 200


def test_the_verdict_is_that_of_the_run_folder(folder: Path, tracked: tuple[dualslam.Slam, list[FrameResult]]) -> None:
    verdict = tracked[0].verdict
    assert verdict.as_dict() == read_run(folder).summary["verdict"]
    assert verdict.level == "good"


def test_what_is_saved_is_a_run_folder(folder: Path, tracked: tuple[dualslam.Slam, list[FrameResult]]) -> None:
    slam = tracked[0]
    run = read_run(folder)
    assert len(run.rows) == N_FRAMES
    assert len(run.main) == len(slam.trajectory)
    assert {"report.html", "map.html", "trajectory.txt", "config.yaml"} <= {path.name for path in folder.iterdir()}
    with pytest.raises(InputError, match="after finish"):
        slam.track(np.zeros((240, 320), np.uint8), 99.0)
    with pytest.raises(OutputError, match="already"):
        slam.save(folder)


def test_a_map_is_localised_in_and_does_not_grow(
    folder: Path, tracked: tuple[dualslam.Slam, list[FrameResult]]
) -> None:
    n_keyframes = len(tracked[0].map.frame)  # type: ignore[union-attr]
    for finder in (tracked[0].localise(), dualslam.Slam(tracked[0]._camera, saved_map=folder, localise=True)):
        found = [finder.track(f.image, f.timestamp_s) for f in dualslam.open_source(WORLD, start=18)]
        assert not found[-1].lost
        assert finder.map is not None
        assert len(finder.map.frame) == n_keyframes


def test_a_notebook_shows_a_picture_and_not_all_numbers(folder: Path, tmp_path: Path) -> None:
    run = read_run(folder)
    assert len(repr(run)) < 300
    assert "posed in the main map" in run._repr_html_()
    pytest.importorskip("matplotlib", reason="matplotlib, an extra, is not installed")
    figure = run.plot(tmp_path / "way.pdf")
    assert (tmp_path / "way.pdf").read_bytes().startswith(b"%PDF")
    (axes,) = figure.axes
    drawn = max(np.isfinite(line.get_xdata()).sum() for line in axes.lines if line.get_label() == "tracked")
    assert drawn == len(run.main)
    with pytest.raises(OutputError, match="cannot be written"):
        run.plot(tmp_path / "way.nothing")


def test_a_camera_is_read_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text("model: pinhole\nwidth: 64\nheight: 48\nfx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\n")
    assert dualslam.Camera.read(tmp_path / "camera.yaml").size_px == (64, 48)
    slam = dualslam.Slam(tmp_path / "camera.yaml")
    assert slam.map is None
    with pytest.raises(InputError, match="no map"):
        slam.localise()
    with pytest.raises(InputError, match="saved_map"):
        dualslam.Slam(tmp_path / "camera.yaml", localise=True)
    with pytest.raises(InputError, match="does not exist"):
        dualslam.Camera.read(tmp_path / "none.yaml")


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, dualslam; sys.exit('numpy' in sys.modules or 'cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_slip_is_one_sentence() -> None:
    """No camera, no mask file, a mask of another size, times that go back or are no seconds."""
    camera = dualslam.open_source(WORLD).camera
    small = np.zeros((2, 2), bool)
    slips = [({"camera": None}, "NoneType"), ({"mask": "no.png"}, "does not exist"), ({"mask": small}, "mask is")]
    for wrong, words in slips:
        with pytest.raises(dualslam.InputError, match=words):
            dualslam.Slam(**({"camera": camera} | wrong))
    slam = dualslam.Slam(camera)
    slam.track(None, 1.0)
    times = [(1.0, "not later than 1.0"), (0.5, "not later"), (np.int64(1_700_000_000 * 10**9), "is in nanoseconds")]
    for time_s, words in times:
        with pytest.raises(dualslam.InputError, match=words):
            slam.track(None, time_s)
    assert slam.track(None, 1.1).index == 1
