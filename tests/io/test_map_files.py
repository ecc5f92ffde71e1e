"""Maps and submaps to the disk and back, without pickles."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.errors import InputError, OutputError
from dualslam.core.geometry import se3
from dualslam.core.types import Features, Keyframe
from dualslam.io import load_map, load_submap, map_files, save_map, save_submap
from dualslam.io.map_files import Arrays, load_arrays, save_arrays, submap_to_arrays
from dualslam.io.map_store import load_atlas, save_atlas, submap_path
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import Submap


def features(rng: np.random.Generator, n: int) -> Features:
    return Features(
        uv_px=rng.uniform(0, 100, (n, 2)),
        uv_rect_px=rng.uniform(0, 100, (n, 2)),
        sigma_px=rng.uniform(1, 3, n),
        scale=rng.uniform(1, 3, n),
        octave=rng.integers(0, 8, n),
        angle_rad=rng.uniform(-3, 3, n),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
    )


@pytest.fixture
def submap() -> Submap:
    rng = np.random.default_rng(3)
    submap = Submap(4, np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]), np.zeros(32, np.uint8))
    for k, n in [(10, 30), (14, 0), (12, 25), (20, 5)]:
        T = se3.exp(rng.normal(0, 1, 6))
        submap.add_keyframe(Keyframe(k, 0.1 * k, features(rng, n)), T)
    ids = submap.add_landmarks(
        rng.normal(0, 5, (20, 3)), submap.keyframes[10].features.descriptors[:20], np.ones(20), 10
    )
    submap.add_observations(10, np.arange(20), ids)
    submap.add_observations(12, np.arange(20), ids[::-1].copy())
    submap.remove_landmarks(ids[:2])
    submap.merge_landmarks(ids[5:6], ids[6:7])
    submap.remove_keyframe(20, 12)
    submap.gauge = (10, 12)
    submap.relative_poses[12] = RelativePose(10, se3.exp(rng.normal(0, 1, 6)), np.diag(rng.uniform(1, 2, 6)))
    return submap


def assert_same(a: Submap, b: Submap) -> None:
    assert (a.id, a.gauge) == (b.id, b.gauge)
    np.testing.assert_array_equal(a.K, b.K)
    assert list(a.keyframes) == list(b.keyframes), "in the order of insertion"
    for k in a.keyframes:
        assert a.keyframes[k].timestamp_s == b.keyframes[k].timestamp_s
        for field in fields(Features):
            x, y = getattr(a.keyframes[k].features, field.name), getattr(b.keyframes[k].features, field.name)
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        assert a.T_submap_kf[k].tobytes() == b.T_submap_kf[k].tobytes()
        np.testing.assert_array_equal(a.landmark_of[k], b.landmark_of[k])
    assert list(a.anchors) == list(b.anchors)
    for k in a.anchors:
        assert a.anchors[k].keyframe_id == b.anchors[k].keyframe_id
        np.testing.assert_array_equal(a.anchors[k].T_kf_cam, b.anchors[k].T_kf_cam)
    assert list(a.relative_poses) == list(b.relative_poses)
    for k, known in a.relative_poses.items():
        assert known.keyframe_id == b.relative_poses[k].keyframe_id
        np.testing.assert_array_equal(known.T_ref_kf, b.relative_poses[k].T_ref_kf)
        np.testing.assert_array_equal(known.covariance, b.relative_poses[k].covariance)
    for one, other in ((a.landmarks, b.landmarks), (a.observations, b.observations)):
        x, y = one.columns(), other.columns()
        assert list(x) == list(y)
        for name in x:
            assert x[name].dtype == y[name].dtype
            np.testing.assert_array_equal(x[name], y[name])


def test_submap_round_trip(tmp_path: Path, submap: Submap) -> None:
    save_submap(tmp_path / "s.npz", submap)
    back = load_submap(tmp_path / "s.npz")
    assert_same(submap, back)
    # It is alive: it can go on growing.
    ids = back.add_landmarks(np.ones((3, 3)), np.zeros((3, 32), np.uint8), np.ones(3), 10)
    back.add_observations(10, np.array([27, 28, 29]), ids)
    back.remove_keyframe(12, 10)
    assert len(back.landmarks) == len(submap.landmarks) + 3


def test_empty_submap_round_trip(tmp_path: Path) -> None:
    empty = Submap(0, np.eye(3), np.zeros(16, np.float32))
    save_submap(tmp_path / "s.npz", empty)
    back = load_submap(tmp_path / "s.npz")
    assert_same(empty, back)
    assert back.landmarks["descriptor"].dtype == np.float32
    assert back.landmarks["descriptor"].shape == (0, 16)


def test_map_round_trip(tmp_path: Path) -> None:
    arrays = {"links": {"S": np.eye(4)[None], "from": np.array([1])}, "submap_00": {"x": np.zeros((0, 3), np.float32)}}
    metadata = {"main": [0, 1], "scale": np.float32(0.5), "camera": {"model": "pinhole"}, "bad": float("nan")}
    save_map(tmp_path / "map", arrays, metadata)
    back, said = load_map(tmp_path / "map")
    assert back.keys() == arrays.keys()
    for group, content in arrays.items():
        for name, array in content.items():
            assert back[group][name].dtype == array.dtype
            np.testing.assert_array_equal(back[group][name], array)
    assert said == {"main": [0, 1], "scale": 0.5, "camera": {"model": "pinhole"}, "bad": None}
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == ["links.npz", "map.json", "submap_00.npz"]


def test_an_interrupted_save_leaves_the_old_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At whichever file it ends, in whichever way; the next save takes the place of both."""

    def value(folder: Path) -> list[int]:
        groups, said = load_map(folder)
        return [int(said["number"]), *(int(groups[name]["x"]) for name in sorted(groups))]

    def save(number: int, n_groups: int) -> None:
        groups = {f"submap_{m:02d}": {"x": np.array(number)} for m in range(n_groups)}
        save_map(tmp_path, groups, {"number": number})

    save(1, 3)
    for n_whole in range(3):
        with monkeypatch.context() as broken:
            whole = iter(range(n_whole))

            def save_some(path: Path, arrays: Arrays, whole: Iterator[int] = whole) -> None:
                if next(whole, None) is None:
                    raise KeyboardInterrupt
                save_arrays(path, arrays)

            broken.setattr(map_files, "save_arrays", save_some)
            with pytest.raises(KeyboardInterrupt):
                save(2, 3)
        assert value(tmp_path) == [1, 1, 1, 1]
    for number, n_groups in ((3, 3), (4, 2), (5, 3)):
        save(number, n_groups)
        assert value(tmp_path) == [number] * (n_groups + 1)
        assert len(list(tmp_path.iterdir())) == n_groups + 1, "nothing of the maps before is left"


def test_a_submap_that_the_metadata_lacks_is_one_sentence(tmp_path: Path) -> None:
    save_map(tmp_path, {}, {})
    with pytest.raises(InputError, match=r"submap_07\.npz"):
        load_arrays(submap_path(tmp_path, 7))


def test_no_pickles(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="without pickles"):
        save_map(tmp_path, {"a": {"x": np.array([object()])}}, {})
    np.savez(tmp_path / "evil.npz", x=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="no map file"):
        load_submap(tmp_path / "evil.npz")


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("kf_timestamp_s", lambda a: a[:2], "kf_timestamp_s is of shape"),
        ("kf_T_submap_kf", lambda a: a * np.nan, "kf_T_submap_kf holds a number that is not finite"),
        ("kf_landmark_of", lambda a: a + 1000, "kf_landmark_of points at what is not there"),
        ("kf_n_features", lambda a: -a, "kf_n_features is negative"),
        ("features_uv_px", lambda a: a[:-1], "features_uv_px has"),
        ("features_scale", lambda a: a * np.inf, "features_scale holds a number that is not finite"),
        ("landmarks_xyz_mu", lambda a: a[:, :2], "landmarks_xyz_mu is of shape"),
        ("landmarks_descriptor", lambda a: a[:-1], "landmarks_descriptor has"),
        ("landmarks_alive", lambda a: a.astype(float), "landmarks_alive is of type float64"),
        ("observations_landmark", lambda a: a + 1000, "observations_landmark points at what is not there"),
        ("observations_kf", lambda a: a + 1000, "an observation is of no feature of a keyframe"),
        ("observations_feature", lambda a: a - 1, "an observation is of no feature of a keyframe"),
        ("observations_feature", lambda a: a + 10, "an observation is of no feature of a keyframe"),  # keyframe 12's
        ("landmarks_normal", None, "landmarks_normal"),
    ],
)
def test_arrays_that_do_not_fit_together(
    tmp_path: Path, submap: Submap, name: str, change: Callable[[NDArray[Any]], NDArray[Any]] | None, words: str
) -> None:
    arrays = submap_to_arrays(submap)
    array = arrays.pop(name)
    if change is not None:
        arrays[name] = change(array)
    np.savez(tmp_path / "s.npz", **arrays)
    with pytest.raises(InputError, match=f"s.npz is no submap of this version, or is damaged: .*{words}"):
        load_submap(tmp_path / "s.npz")


def change_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def change_array(path: Path, name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> None:
    arrays = load_arrays(path)
    save_arrays(path, {**arrays, name: change(arrays[name])})


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda at: change_json(at / "map.json", lambda d: d.update(format=float("inf"))), "not the metadata of a map"),
        (lambda at: change_json(at / "map.json", lambda d: d.update(format=99)), "newer than this version"),
        (lambda at: (at / "map.json").write_text("[" * 100_000), "not the metadata of a map"),
        (lambda at: change_json(at / "map.json", lambda d: d["metadata"].update(camera=-1)), r"map\.json: "),
        (
            lambda at: change_json(at / "map.json", lambda d: d["metadata"].update(camera={"model": "eye"})),
            r"map\.json: camera: field 'model' is 'eye'",
        ),
        (lambda at: change_json(at / "map.json", lambda d: d["metadata"].update(link_keyframes=[[[]]])), "damaged"),
        (lambda at: change_json(at / "map.json", lambda d: d["metadata"].pop("link_kinds")), "'link_kinds' is missing"),
        (lambda at: change_array(at / "links.npz", "ab", lambda a: a + 5), "submaps 9 and 10, of which one"),
        (lambda at: change_array(at / "links.npz", "S_a_b", np.zeros_like), "a matrix that is no transform"),
        (lambda at: change_array(at / "links.npz", "S_a_b", lambda a: a[None]), "S_a_b is of shape"),
        (lambda at: change_array(at / "frames.npz", "index", lambda a: a.astype(str)), "index is of type"),
        (lambda at: change_array(at / "frames.npz", "T_kf_cam", lambda a: a * np.nan), "number that is not finite"),
        (
            lambda at: change_array(at / "submap_04.npz", "kf_landmark_of", lambda a: a * 1.0),
            "kf_landmark_of is of type",
        ),
        (
            lambda at: change_array(at / "submap_04.npz", "kf_n_features", lambda a: a * np.nan),
            "kf_n_features is of type",
        ),
        (lambda at: (at / "submap_05.npz").write_bytes(b"x" * 400), "submap_05.npz is no map file"),
    ],
)
def test_a_saved_map_that_was_edited_is_refused_in_one_sentence(
    tmp_path: Path, submap: Submap, damage: Callable[[Path], object], words: str
) -> None:
    atlas = Atlas()
    atlas.add(submap)
    other = Submap(5, np.eye(3), np.zeros(32, np.uint8))
    other.add_keyframe(Keyframe(30, 3.0, features(np.random.default_rng(0), 4)), np.eye(4))
    atlas.add(other)
    atlas.link(Link(4, 5, np.eye(4), np.eye(7), LinkKind.RECOVERY, (12,), is_sure=False))
    pose = FramePose(11, 1.1, 4, 10, np.eye(4))
    save_atlas(tmp_path / "map", atlas, {11: pose}, PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0))
    stored = load_atlas(tmp_path)
    assert stored.poses.keys() == {11}
    assert [link.is_sure for link in stored.atlas.links] == [False]
    damage(tmp_path / "map")
    with pytest.raises(InputError, match=words) as refused:
        load_atlas(tmp_path)
    assert str(tmp_path) in str(refused.value)
    assert "pickle" not in str(refused.value)


def test_damaged_files(tmp_path: Path, submap: Submap) -> None:
    path = tmp_path / "s.npz"
    with pytest.raises(InputError, match="does not exist"):
        load_submap(path)
    save_submap(path, submap)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        load_submap(path)
    np.savez(path, format=np.array(1), id=np.array(0))
    with pytest.raises(InputError, match="no submap of this version"):
        load_submap(path)
    np.savez(path, format=np.array(99))
    with pytest.raises(InputError, match="format 99"):
        load_submap(path)
    with pytest.raises(InputError, match=r"map.json does not exist"):
        load_map(tmp_path)
    (tmp_path / "map.json").write_text("{}")
    with pytest.raises(InputError, match=r"map.json is not the metadata"):
        load_map(tmp_path)
