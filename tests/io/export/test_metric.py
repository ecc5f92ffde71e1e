"""The metric scale: each way of giving it, against worlds whose metres are known."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.stored_map import StoredMap
from dualslam.cli import main
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, Frame
from dualslam.io.export.exported_map import ExportedMap
from dualslam.io.export.metric import DICTIONARIES, SCALE, by_distance, by_height, by_marker, read_scale, write_scale
from dualslam.io.run_folder import FRAME_COLUMNS
from dualslam.io.run_reading import read_numbers
from dualslam.testing.point_world import CAMERA
from tests.cli.conftest import _own_environment  # noqa: F401 (used by every test)
from tests.cli.test_usage import one_sentence

METRES_PER_UNIT = 3.7
HEIGHT_M = 1.6
TOLERANCE = 0.02
NUMBERS = {i: i for i in range(100)}
"""Of a run that begins with its source."""


def seen_map(T_world_cam: FloatArray, xyz_m: FloatArray, noise_px: float = 0.5) -> ExportedMap:
    """A map, in a unit of its own, of cameras and points in metres; points carry a pixel's error of depth and place."""
    rng = np.random.default_rng(0)
    views, points, uvs = [], [], []
    for v, T in enumerate(T_world_cam):
        uv = CAMERA.project(se3.act(se3.inverse(T), xyz_m))
        inside = np.flatnonzero(((uv > 0) & (uv < (CAMERA.width, CAMERA.height))).all(axis=1))
        views.append(np.full(len(inside), v))
        points.append(inside)
        uvs.append(uv[inside] + rng.normal(0, noise_px, (len(inside), 2)))
    T = T_world_cam.copy()
    T[:, :3, 3] /= METRES_PER_UNIT
    off = 1 + rng.normal(0, 0.01, (len(xyz_m), 1))  # a hundredth of the distance
    xyz = T_world_cam[0, :3, 3] + (xyz_m - T_world_cam[0, :3, 3]) * off
    n = sum(map(len, views))
    return ExportedMap(
        frame=np.arange(len(T)),
        timestamp_s=0.1 * np.arange(len(T)),
        camera=np.zeros(len(T), np.int64),
        K=CAMERA.K[None],
        size_px=(CAMERA.width, CAMERA.height),
        T_world_cam=T,
        xyz=xyz / METRES_PER_UNIT,
        colour=np.zeros((len(xyz_m), 3), np.uint8),
        view=np.concatenate(views),
        point=np.concatenate(points),
        uv_px=np.concatenate(uvs),
        sigma_px=np.ones(n),
        feature=np.zeros(n, np.int64),
    )


def drive(n: int = 30, tilt_deg: float = 0.0) -> FloatArray:
    """A camera that looks ahead, y down, at a height over the ground, which is y = 0."""
    R = np.tile(cv2.Rodrigues(np.radians([tilt_deg, 0.0, 0.5 * tilt_deg]))[0], (n, 1, 1))
    return se3.from_parts(R, np.column_stack([np.zeros(n), np.full(n, -HEIGHT_M), 0.5 * np.arange(n)]))


def road(seed: int, n_ground: int = 400, clutter: int = 800) -> FloatArray:
    """Points of the ground, and twice as many of all that stands on it."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-4, 4, n_ground), np.zeros(n_ground), rng.uniform(2, 40, n_ground)])
    side = rng.choice([-1.0, 1.0], clutter) * rng.uniform(3, 8, clutter)
    return np.concatenate([ground, np.column_stack([side, rng.uniform(-5, 0, clutter), rng.uniform(2, 40, clutter)])])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("tilt_deg", [0.0, -6.0])
def test_the_height_over_the_ground(seed: int, tilt_deg: float) -> None:
    scale = by_height(seen_map(drive(tilt_deg=tilt_deg), road(seed)), HEIGHT_M)
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=TOLERANCE)
    assert scale.sigma_rel is not None
    assert abs(scale.metres_per_unit / METRES_PER_UNIT - 1) < max(4 * scale.sigma_rel, 0.005)


def test_a_table_beside_the_road_is_no_ground() -> None:
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(0.5, 3, 500), np.full(500, -0.8), rng.uniform(2, 20, 500)])
    scale = by_height(seen_map(drive(), np.concatenate([road(0), table])), HEIGHT_M)
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=TOLERANCE)


def test_without_ground_no_height() -> None:
    walls = road(0)[400:]
    with pytest.raises(InputError, match=r"--height: .* level ground.*--distance"):
        by_height(seen_map(drive(), walls[walls[:, 1] < -2.0]), HEIGHT_M)


def test_a_distance_between_two_keyframes() -> None:
    scale = by_distance(seen_map(drive(), road(0)), NUMBERS, 3, 23, 10.0)
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT)
    with pytest.raises(InputError, match="frame 90 has no pose in the main map; the nearest that has one is 29"):
        by_distance(seen_map(drive(), road(0)), NUMBERS, 3, 90, 10.0)


@pytest.mark.parametrize("index", [18, 29, 60])
def test_a_frame_that_the_run_has_not_is_refused(index: int) -> None:
    exported = replace(seen_map(drive(), road(0)), frame=np.arange(30, 60))
    numbers = {i: i for i in range(30, 60)}  # --start 30: frame 42 would be the mirror image of frame 18
    assert by_distance(exported, numbers, 33, 53, 10.0).metres_per_unit == pytest.approx(METRES_PER_UNIT)
    with pytest.raises(InputError, match=rf"frame {index} is none of the run's, which are 30 to 59\.$"):
        by_distance(exported, numbers, 33, index, 10.0)


def test_on_a_saved_map_the_frames_are_those_of_the_run() -> None:
    exported = seen_map(drive(), road(0))  # the first 20 keyframes are the saved map's
    numbers = {i: 20 + i for i in range(3, 20)}
    assert by_distance(exported, numbers, 3, 9, 3.0).metres_per_unit == pytest.approx(METRES_PER_UNIT)
    with pytest.raises(InputError, match="frame 2 is none of the run's, which are 3 to 19; those of the saved map"):
        by_distance(exported, numbers, 2, 9, 3.0)
    with pytest.raises(InputError, match="frame 12 has no pose in the main map; the nearest that has one is 9"):
        by_distance(exported, numbers, 3, 12, 3.0)
    with pytest.raises(InputError, match="no frame of this run has a pose in the main map"):
        by_distance(exported, {3: 900}, 3, 3, 3.0)


@pytest.mark.parametrize(
    ("first_id", "indices", "numbers"), [(0, [30, 32, 34], [30, 32, 34]), (100, [9, 8, 5], [109, 110, 113])]
)
def test_a_run_folder_tells_the_numbers_of_its_frames(
    first_id: int, indices: list[int], numbers: list[int], tmp_path: Path
) -> None:
    (tmp_path / "summary.json").write_text(json.dumps({"first_id": first_id, "first_index": indices[0]}))
    rows = [f"{i},{0.1 * i},tracked,0,1,90,80,5.0,," for i in indices]
    (tmp_path / "frames.csv").write_text("\n".join([",".join(FRAME_COLUMNS), *rows, ""]))
    assert read_numbers(tmp_path) == dict(zip(indices, numbers, strict=True))


MARKER_M = 0.3


@cache
def marker_image(dictionary: str) -> FloatArray:
    cv_dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    return np.pad(cv2.aruco.generateImageMarker(cv_dictionary, 7, 400), 100, constant_values=255)


def photographed(T_world_cam: FloatArray, dictionary: str) -> list[Frame]:
    """What the cameras see of a marker 2 m ahead of the origin, on grey."""
    frames, image = [], marker_image(dictionary)
    half = MARKER_M / 2 * 600 / 400
    square = np.array([[-half, -half, 2], [half, -half, 2], [half, half, 2], [-half, half, 2]])
    corners = np.array([[-0.5, -0.5], [599.5, -0.5], [599.5, 599.5], [-0.5, 599.5]], np.float32)
    for i, T in enumerate(T_world_cam):
        uv = CAMERA.project(se3.act(se3.inverse(T), square)).astype(np.float32)
        H = cv2.getPerspectiveTransform(corners, uv)
        size = (CAMERA.width, CAMERA.height)
        seen = cv2.warpPerspective(image, H, size, flags=cv2.INTER_AREA, borderValue=128)
        frames.append(Frame(i, 0.1 * i, cv2.GaussianBlur(seen, (3, 3), 0)))
    return frames


def around(n: int = 12) -> FloatArray:
    """Cameras that go past a marker."""
    x = np.linspace(-0.6, 0.6, n)
    R = np.array([cv2.Rodrigues(np.array([0.0, -0.3 * a, 0.0]))[0] for a in x])
    return se3.from_parts(R, np.column_stack([x, 0.1 * x, 0 * x]))


@pytest.mark.parametrize("dictionary", ["apriltag_36h11", "aruco_4x4"])
def test_a_marker_of_known_size(dictionary: str) -> None:
    T = around()
    exported = seen_map(T, road(0))
    scale = by_marker(exported, CAMERA, photographed(T, dictionary), NUMBERS, MARKER_M, dictionary)
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=TOLERANCE)
    assert "1 markers" in scale.words


def test_a_marker_of_another_kind_is_not_found() -> None:
    T = around()
    with pytest.raises(InputError, match=r"no marker of aruco_5x5 .*--dictionary"):
        by_marker(seen_map(T, road(0)), CAMERA, photographed(T, "apriltag_36h11"), NUMBERS, MARKER_M, "aruco_5x5")


# --- the command


def test_a_scale_stays_with_the_map_and_exports_use_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = seen_map(drive(), road(0))
    (tmp_path / "map").mkdir()
    (tmp_path / "summary.json").write_text(json.dumps({"first_id": 0, "first_index": 0}))
    rows = [f"{i},{0.1 * i},tracked,0,1,90,80,5.0,," for i in range(30)]
    (tmp_path / "frames.csv").write_text("\n".join([",".join(FRAME_COLUMNS), *rows, ""]))
    for place in ("scale", "export"):
        monkeypatch.setattr(f"dualslam.cli.{place}_command.read_stored", lambda run: StoredMap(Atlas(), {}, CAMERA))
        monkeypatch.setattr(f"dualslam.cli.{place}_command.flatten", lambda stored: given)
    assert main(["scale", str(tmp_path), "--distance", "3", "23", "10"]) == 0
    assert "a unit of the map is 3.7 m" in capsys.readouterr().out
    assert read_scale(tmp_path) == pytest.approx(METRES_PER_UNIT)
    assert main(["scale", str(tmp_path), "--distance", "3", "30", "10"]) == 2
    assert "frame 30 is none of the run's" in capsys.readouterr().err
    assert main(["scale", str(tmp_path), "--distance", "3", "23", "10.2"]) == 0
    assert "times what it was" not in capsys.readouterr().out
    assert main(["scale", str(tmp_path), "--distance", "3", "23", "20.4"]) == 0
    assert "that is 2 times what it was (3.774 m)" in capsys.readouterr().out
    (tmp_path / "map" / SCALE).write_text("{")  # mended by a scale
    assert main(["scale", str(tmp_path), "--distance", "3", "23", "10"]) == 0
    assert "times" not in capsys.readouterr().out
    out = tmp_path / "map.ply"
    assert main(["export", str(tmp_path), "--to", "ply", "--out", str(out)]) == 0
    assert "in metres" in capsys.readouterr().out
    from plyfile import PlyData

    xyz = np.stack([PlyData.read(out)["vertex"][axis] for axis in "xyz"], axis=1)
    assert np.allclose(xyz, METRES_PER_UNIT * given.xyz, atol=1e-3)


def test_trajectories_come_in_metres_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "trajectory.txt").write_text("0.5 1 2 3 0 0 0 1\n")
    (tmp_path / "trajectory_kitti.txt").write_text("1 0 0 1 0 1 0 2 0 0 1 3\n")
    assert main(["export", str(tmp_path), "--to", "tum", "--out", str(tmp_path / "unit")]) == 0
    assert "in the map's unit" in capsys.readouterr().out
    write_scale(tmp_path, 2.0, None, "a ruler")
    assert main(["export", str(tmp_path), "--to", "tum", "--out", str(tmp_path / "metres")]) == 0
    assert "in metres" in capsys.readouterr().out
    for name in ("tum", "kitti"):
        assert main(["export", str(tmp_path), "--to", name, "--out", str(tmp_path / name), "--quiet"]) == 0
    assert [float(x) for x in (tmp_path / "tum").read_text().split()[1:4]] == [2, 4, 6]
    assert [float(x) for x in (tmp_path / "kitti").read_text().split()[3::4]] == [2, 4, 6]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--height", "-1"], "above 0"),
        (["--height", "1e300"], "1e-06 to 1e+09"),
        (["--distance", "1", "2", "inf"], "a distance in metres"),
        (["--height", "1.6", "--marker", "0.2"], "not allowed with"),
        ([], "required"),
    ],
)
def test_usage(arguments: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scale", str(tmp_path), *arguments]) == 2
    assert expected in one_sentence(capsys)


@pytest.mark.parametrize("text", ["{", "{}", '{"metres_per_unit": -1}', '{"metres_per_unit": null}'])
def test_a_damaged_scale_is_one_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / SCALE).write_text(text)
    with pytest.raises(InputError, match=r"scale\.json.* run dualslam scale again"):
        read_scale(tmp_path)
