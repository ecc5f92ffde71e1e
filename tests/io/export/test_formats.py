"""Maps in the formats of other programs, read back by those programs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from dualslam.atlas.stored_map import StoredMap
from dualslam.cli import main
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3
from dualslam.core.types import Frame
from dualslam.io.colours import GREY, keyframe_indices, landmark_colours, load_colours, save_colours
from dualslam.io.export.colmap import decimals, write_colmap
from dualslam.io.export.exported_map import ExportedMap, flatten, with_frames
from dualslam.io.export.formats import write_bal, write_g2o, write_nerfstudio, write_ply
from dualslam.io.export.images import mask_of, with_images
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, system_in


@pytest.fixture(scope="module")
def stored() -> StoredMap:
    """Two submaps: a full one and the one that it has rolled over into, with keyframes that both have."""
    world = PointWorld(cloud(), hand_held(60))
    system = system_in(
        world,
        graph={"max_keyframes": 20, "rollover_keyframes": 6},
        keyframes={"max_parallax_deg": 1.0},
        mapping={"redundant_ratio": 1.0},
    )
    for frame in world.frames():
        system.step(frame)
    system.finish()
    assert len(system.atlas.submaps) > 1
    return StoredMap(system.atlas, system.poses, CAMERA)


@pytest.fixture(scope="module")
def exported(stored: StoredMap) -> ExportedMap:
    found = flatten(stored)
    rng = np.random.default_rng(0)
    return replace(found, colour=rng.integers(0, 256, (len(found.xyz), 3), np.uint8))


def test_each_keyframe_is_there_once_and_what_it_sees_fits(stored: StoredMap, exported: ExportedMap) -> None:
    keyframes = {k for m in stored.atlas.submaps.values() for k in m.keyframes}
    assert exported.frame.tolist() == sorted(keyframes)
    assert np.median(exported.reprojection_errors_px()) < 1.0
    assert np.bincount(exported.point).min() >= 2
    assert len(np.unique(np.column_stack([exported.view, exported.point]), axis=0)) == len(exported.view)


def test_the_world_is_the_truth_up_to_a_similarity(exported: ExportedMap) -> None:
    from dualslam.lab.metrics.alignment import distances_when_aligned

    truth = hand_held(60)[exported.frame]
    p, q = exported.T_world_cam[:, :3, 3], truth[:, :3, 3]
    assert distances_when_aligned(p, q).max() < 0.03 * np.linalg.norm(np.diff(q, axis=0), axis=1).sum()


def test_what_is_condemned_is_left_out(stored: StoredMap) -> None:
    submap = stored.atlas.submaps[0].copy()
    doomed = list(submap.keyframes)[:3]
    submap.condemn(doomed)
    atlas = type(stored.atlas)()
    atlas.add(submap)
    found = flatten(StoredMap(atlas, {k: p for k, p in stored.poses.items() if p.submap_id == 0}, CAMERA))
    assert not set(doomed) & set(found.frame.tolist())
    healthy = submap.landmarks["alive"] & ~submap.landmarks["condemned"]
    assert len(found.xyz) <= healthy.sum()


def test_colmap_reads_the_same_reprojection_errors(exported: ExportedMap, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    write_colmap(exported, tmp_path)
    read = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert (read.num_images(), read.num_points3D()) == (len(exported.frame), len(exported.xyz))
    errors = exported.reprojection_errors_px()
    n_seen = 0
    for p, point in read.points3D.items():
        rows = np.flatnonzero(exported.point == p - 1)
        np.testing.assert_array_equal(point.color, exported.colour[p - 1])
        of_view = dict(zip(exported.view[rows].tolist(), errors[rows], strict=True))
        for element in point.track.elements:
            image = read.images[element.image_id]
            uv = image.points2D[element.point2D_idx].xy
            projected = image.project_point(point.xyz)
            assert np.linalg.norm(uv - projected) == pytest.approx(of_view[element.image_id - 1], abs=0.01)
            n_seen += 1
    assert n_seen == len(exported.view)


def test_ply_has_points_and_colours(exported: ExportedMap, tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    write_ply(exported, tmp_path / "map.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    np.testing.assert_allclose(np.column_stack([vertex[a] for a in "xyz"]), exported.xyz, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(np.column_stack([vertex[c] for c in ("red", "green", "blue")]), exported.colour)


def test_gtsam_finds_the_map_again_from_its_pose_graph(exported: ExportedMap, tmp_path: Path) -> None:
    write_g2o(exported, tmp_path / "map.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "map.g2o"), True)
    assert sorted(values.keys()) == exported.frame.tolist()
    graph.add(
        gtsam.PriorFactorPose3(
            int(exported.frame[0]), values.atPose3(int(exported.frame[0])), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        )
    )
    rng = np.random.default_rng(1)
    start = gtsam.Values()
    for k in exported.frame.tolist():
        start.insert(k, values.atPose3(k).retract(0.02 * rng.normal(size=6)))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    for k, T in zip(exported.frame.tolist(), exported.T_world_cam, strict=True):
        np.testing.assert_allclose(solved.atPose3(k).matrix(), T, atol=1e-4)


def test_gtsam_reads_the_bundle_with_the_same_errors(exported: ExportedMap, tmp_path: Path) -> None:
    write_bal(exported, tmp_path / "map.bal")
    data = gtsam.SfmData.FromBalFile(str(tmp_path / "map.bal"))
    assert (data.numberCameras(), data.numberTracks()) == (len(exported.frame), len(exported.xyz))
    errors = exported.reprojection_errors_px()
    first = np.searchsorted(exported.point, np.arange(len(exported.xyz) + 1))
    for p in range(0, len(exported.xyz), 7):
        track = data.track(p)
        for j in range(track.numberMeasurements()):
            v, uv = track.measurement(j)
            row = first[p] + j
            assert v == exported.view[row]
            error = np.linalg.norm(data.camera(v).project(track.point3()) - uv)
            assert error == pytest.approx(errors[row], abs=0.01)


def test_nerfstudio_cameras_look_along_minus_z(exported: ExportedMap, tmp_path: Path) -> None:
    write_nerfstudio(exported, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (tmp_path / content["ply_file_path"]).is_file()
    rows = np.flatnonzero(exported.view == 3)
    frame = content["frames"][3]
    T_world_gl = np.array(frame["transform_matrix"])
    in_gl = se3.act(se3.inverse(T_world_gl), exported.xyz[exported.point[rows]])
    assert (in_gl[:, 2] < 0).all()
    u = frame["fl_x"] * in_gl[:, 0] / -in_gl[:, 2] + frame["cx"] - 0.5
    v = frame["fl_y"] * in_gl[:, 1] / in_gl[:, 2] + frame["cy"] - 0.5
    assert np.median(np.linalg.norm(np.column_stack([u, v]) - exported.uv_px[rows], axis=1)) < 1.0


def test_views_without_an_image_are_left_out(exported: ExportedMap, tmp_path: Path) -> None:
    first = int(exported.frame[len(exported.frame) // 2])  # of the run: earlier ones are of the map that it continues
    numbers = {i: first + i for i in range(1000)}
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    frames = [Frame(i, 0.1 * i, image) for i in range(60)]
    kept = with_images(exported, CAMERA, frames, numbers, tmp_path)
    write_colmap(kept, tmp_path)
    write_nerfstudio(kept, tmp_path)
    written = sorted(f"images/{file.name}" for file in (tmp_path / "images").iterdir())
    assert written == [f"images/{k:06d}.png" for k in exported.frame.tolist() if k >= first]
    named = [each["file_path"] for each in json.loads((tmp_path / "transforms.json").read_text())["frames"]]
    assert named == written
    before = {(int(exported.frame[v]), *uv) for v, uv in zip(exported.view, exported.uv_px.tolist(), strict=True)}
    assert {(int(kept.frame[v]), *uv) for v, uv in zip(kept.view, kept.uv_px.tolist(), strict=True)} <= before
    assert np.bincount(kept.point, minlength=len(kept.xyz)).min() >= 2
    assert np.median(kept.reprojection_errors_px()) < 1.0
    with pytest.raises(InputError, match="the image of no keyframe"):
        with_images(exported, CAMERA, frames[:0], numbers, tmp_path)


GREY_LEVELS = 3.0
"""Between an exported colour and the source's."""


ORANGE = np.array([230, 120, 30])


def painted(index: int) -> Frame:
    """An orange picture, a little brighter to the right, a little bluer from frame to frame."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return Frame(index, index / 20, (ORANGE + np.stack([u / 320, v / 240, 0 * u + index / 30], -1)).astype(np.uint8))


def test_colours_are_those_of_the_source(stored: StoredMap, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    numbers = {i: i for i in range(60)}
    frames = [painted(i) for i in range(60)]
    assert set(keyframe_indices(stored.atlas, numbers)) >= set(flatten(stored).frame.tolist())
    colours = landmark_colours(stored.atlas, frames, numbers, {})
    save_colours(tmp_path, colours)
    exported = flatten(replace(stored, colours=load_colours(tmp_path)))
    write_colmap(with_images(exported, CAMERA, frames, numbers, tmp_path), tmp_path)
    read = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert read.num_images() == len(exported.frame)
    for image in read.images.values():
        bitmap = pycolmap.Bitmap.read(str(tmp_path / "images" / image.name), as_rgb=True).to_array()
        difference = bitmap.astype(float) - frames[int(Path(image.name).stem)].image
        assert np.abs(difference).max() <= GREY_LEVELS
    assert not (tmp_path / "masks").exists()  # all pixels are of the camera's image
    assert all(np.abs(point.color - ORANGE).max() <= GREY_LEVELS for point in read.points3D.values())


def test_landmarks_that_no_image_shows_keep_their_colour(stored: StoredMap) -> None:
    before = {0: np.full((5, 3), 7, np.uint8)}
    colours = landmark_colours(stored.atlas, [], {}, before)
    assert (colours[0][:5] == 7).all()
    assert (colours[0][5:] == GREY).all()
    assert {m: len(rgb) for m, rgb in colours.items()} == {m: len(s.landmarks) for m, s in stored.atlas.submaps.items()}


def test_posed_frames_that_are_no_keyframes_are_exported_on_request(stored: StoredMap, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    exported = flatten(stored)
    every = with_frames(exported, stored, [*range(0, 60, 2), 9999])
    posed = set(range(0, 60, 2)) & set(stored.poses)
    assert set(every.frame.tolist()) == set(exported.frame.tolist()) | posed
    assert len(every.frame) > len(exported.frame)
    np.testing.assert_allclose(every.reprojection_errors_px(), exported.reprojection_errors_px())
    truth = hand_held(60)[every.frame]
    from dualslam.lab.metrics.alignment import distances_when_aligned

    off = distances_when_aligned(every.T_world_cam[:, :3, 3], truth[:, :3, 3])
    assert off.max() < 0.03 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    write_colmap(every, tmp_path)  # views without a point are images without observations there
    assert pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).num_images() == len(every.frame)


def test_masks_are_of_what_the_camera_did_not_see(exported: ExportedMap, tmp_path: Path) -> None:
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:100] = 0
    assert mask_of(tmp_path) is None
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    np.testing.assert_array_equal(mask_of(tmp_path), mask)  # type: ignore[arg-type]
    frames = [Frame(i, 0.1 * i, np.zeros_like(mask)) for i in range(60)]
    write_nerfstudio(with_images(exported, CAMERA, frames, {i: i for i in range(60)}, tmp_path, mask), tmp_path)
    for each in json.loads((tmp_path / "transforms.json").read_text())["frames"]:
        written = cv2.imread(str(tmp_path / each["mask_path"]), cv2.IMREAD_GRAYSCALE)
        assert (written[:99] == 0).all()
        assert (written[101:] == 255).all()


def test_a_refused_export_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for to, out in (("colmap", "a/b"), ("ply", "c/map.ply"), ("tum", "d/e.txt")):
        assert main(["export", str(tmp_path / "none"), "--to", to, "--out", str(tmp_path / out)]) == 2
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine").mkdir()
    assert main(["export", str(tmp_path / "none"), "--to", "colmap", "--out", str(tmp_path / "mine")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_scaled_keeps_what_is_seen(exported: ExportedMap) -> None:
    metric = exported.scaled(2.5)
    np.testing.assert_allclose(metric.reprojection_errors_px(), exported.reprojection_errors_px(), atol=1e-9)
    np.testing.assert_allclose(metric.T_world_cam[:, :3, 3], 2.5 * exported.T_world_cam[:, :3, 3])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere", "--to", "ply", "--out", "map.ply"], "nowhere"),
        (["run", "--to", "colmap", "--out", "taken"], "taken is there already"),
        (["run", "--to", "ply", "--out", "taken"], "is a folder"),
        (["run", "--to", "tum", "--out", "a.txt"], "run has no trajectory to export: no frame was posed"),
        (["run", "--to", "tum", "--out", "a.txt", "--distance", "0", "1", "2"], "--distance"),
        (["run", "--to", "ply", "--out", "a.ply", "--every", "3"], "--every goes with --to colmap"),
        (["run", "--to", "ply", "--out", "a.ply", "--distance", "0", "x", "2"], "--distance"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "trajectory.txt").touch()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").write_text("keep")
    try:
        status = main(["export", *arguments])
    except SystemExit as stop:
        status = stop.code  # type: ignore[assignment]
    assert status == 2
    error = capsys.readouterr().err.strip()
    assert sentence in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "taken" / "mine").read_text() == "keep"


def test_numbers_have_no_exponents_and_read_back_the_same() -> None:
    numbers = [1.0, -0.1, 1 / 3, 1e9 / 3, 1e-7, 123456.789012345, 4.9e-19, -4.9e-19]
    text = decimals(numbers)
    assert "e" not in text
    assert [float(x) for x in text.split()] == pytest.approx([*numbers[:-2], 0.0, 0.0], rel=1e-15, abs=1e-15)
    assert text.split()[-2:] == ["0", "0"]
