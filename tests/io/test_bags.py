"""Bags of ROS 1 and 2 and MCAP, as `rosbags` writes them: whole, cut off, and of several topics."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from dualslam.core.camera.models import KannalaBrandtCamera, PinholeCamera, RadTanCamera
from dualslam.core.errors import InputError
from dualslam.io import open_sequence
from dualslam.run.sources import open_images_of_run

N = 12
WIDTH, HEIGHT = 64, 48
BEGIN_NS = 1_700_000_000_123_456_789
PACKED = ["db3_message", "db3_file", "mcap_message", "mcap_file"]
"""Each message, or the whole file, as `ros2 bag record --compression-mode` does."""
KINDS = ["bag", "bag_lz4", "bag_bz2", "db3", "mcap", "mcap_zstd", *PACKED]
PATTERN = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def rgb_of(i: int) -> np.ndarray:
    return np.roll(PATTERN, 3 * i, axis=1)


def grey_of(i: int) -> np.ndarray:
    return cv2.cvtColor(rgb_of(i), cv2.COLOR_RGB2GRAY)


class Writer:
    """One interface to both of rosbags' writers."""

    def __init__(self, path: Path, kind: str) -> None:
        self.is_ros1 = kind.startswith("bag")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        self.path = path.with_suffix(".bag") if self.is_ros1 else path
        if self.is_ros1:
            self.bag = Writer1(self.path)
            self.bag.chunk_threshold = 20_000  # two images: a packed chunk that was cut may be lost
            if "_" in kind:
                self.bag.set_compression(getattr(Writer1.CompressionFormat, kind[4:].upper()))
        else:
            plugin = StoragePlugin.SQLITE3 if kind.startswith("db3") else StoragePlugin.MCAP
            self.bag = Writer2(path, version=9, storage_plugin=plugin)
            if "_" in kind:
                mode = "STORAGE" if kind == "mcap_zstd" else kind.partition("_")[2].upper()
                self.bag.set_compression(getattr(CompressionMode, mode), CompressionFormat.ZSTD)
        self.connections: dict[str, Any] = {}

    def write(self, topic: str, kind: str, time_ns: int, **fields: Any) -> None:
        store, name = self.store, f"sensor_msgs/msg/{kind}"
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(topic, name, typestore=store)
        stamp = store.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        seq = {"seq": 0} if self.is_ros1 else {}
        header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="cam", **seq)
        message = store.types[name](header=header, **fields)
        data = (store.serialize_ros1 if self.is_ros1 else store.serialize_cdr)(message, name)
        self.bag.write(self.connections[topic], time_ns + 5_000_000, data)  # recorded 5 ms later

    def image(self, topic: str, i: int, pixels: np.ndarray, encoding: str) -> None:
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        fields = {"height": HEIGHT, "width": WIDTH, "encoding": encoding, "is_bigendian": 0, "step": data.shape[1]}
        self.write(topic, "Image", time_of(i), data=data.ravel(), **fields)

    def compressed(self, topic: str, i: int, ending: str = ".png") -> None:
        data = cv2.imencode(ending, cv2.cvtColor(rgb_of(i), cv2.COLOR_RGB2BGR))[1].ravel()
        self.write(topic, "CompressedImage", time_of(i), format=ending[1:], data=data)

    def info(self, topic: str, model: str = "plumb_bob", D: tuple[float, ...] = (-0.1, 0.02, 1e-3, -1e-3, 0.0)) -> None:
        roi = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        K = np.array([60.0, 0, 31.0, 0, 61.0, 24.0, 0, 0, 1])
        P = np.array([50.0, 0, 32.0, 0, 0, 50.0, 23.0, 0, 0, 0, 1, 0])
        arrays = {"K": K, "D": np.array(D), "R": np.eye(3).ravel(), "P": P}
        if not self.is_ros1:
            arrays = {name.lower(): value for name, value in arrays.items()}
        rest = {"height": HEIGHT, "width": WIDTH, "distortion_model": model, "binning_x": 0, "binning_y": 0, "roi": roi}
        self.write(topic, "CameraInfo", time_of(0), **arrays, **rest)


def time_of(i: int) -> int:
    return BEGIN_NS + 50_000_000 * i


def write_bag(path: Path, kind: str, fill: Any) -> Path:
    writer = Writer(path, kind)
    with writer.bag:
        fill(writer)
    if writer.is_ros1 or kind.startswith("db3"):
        return writer.path
    return next(writer.path.glob("*.mcap*"))


def raw(writer: Writer) -> None:
    writer.info("/camera/camera_info")
    for i in range(N):
        writer.image("/camera/image_raw", i, rgb_of(i), "rgb8")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_images_times_and_camera(tmp_path: Path, kind: str) -> None:
    sequence = open_sequence(write_bag(tmp_path / "drive", kind, raw))
    assert sequence.camera == RadTanCamera(WIDTH, HEIGHT, 60.0, 61.0, 31.0, 24.0, k1=-0.1, k2=0.02, p1=1e-3, p2=-1e-3)
    frames = list(sequence)
    assert len(frames) == N
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, grey_of(i))
        assert frame.timestamp_s == pytest.approx(time_of(i) * 1e-9, abs=1e-6), "the header's time, not the recorder's"
    np.testing.assert_array_equal(next(iter(open_sequence(sequence_path(tmp_path, kind), grey=False))).image, rgb_of(0))


def sequence_path(folder: Path, kind: str) -> Path:
    return folder / "drive.bag" if kind.startswith("bag") else folder / "drive"


WHOLE_ONLY = ("mcap_zstd", "db3_file", "mcap_file")
"""Packed in one piece each, as small as they are: a piece that was cut is lost."""


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in WHOLE_ONLY])
def test_what_is_before_a_cut_is_read(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    path = write_bag(tmp_path / "drive", kind, raw)
    path = next(path.glob("*.db3*")) if path.is_dir() else path
    data = path.read_bytes()
    cut = tmp_path / f"cut{''.join(path.suffixes)}"
    cut.write_bytes(data[: int(0.7 * len(data))])
    with caplog.at_level(logging.WARNING):
        frames = list(open_sequence(cut))
    assert 3 <= len(frames) < N
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, grey_of(i))
    assert f"{cut} is cut off: {len(frames)} images of /camera/image_raw are before the cut" in caplog.text


def mosaic_of(rgb: np.ndarray, pattern: str) -> np.ndarray:
    mosaic = np.empty(rgb.shape[:2], np.uint8)
    for n, colour in enumerate(pattern):
        mosaic[n // 2 :: 2, n % 2 :: 2] = rgb[n // 2 :: 2, n % 2 :: 2, "rgb".index(colour)]
    return mosaic


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_mosaics_have_their_colours(tmp_path: Path, pattern: str, bits: int) -> None:
    colour = np.full((HEIGHT, WIDTH, 3), (200, 100, 40), np.uint8)
    mosaic = mosaic_of(colour, pattern)
    stored = mosaic if bits == 8 else mosaic.astype("<u2") << 8

    def fill(writer: Writer) -> None:
        for i in range(3):
            writer.image("/image_raw", i, stored, f"bayer_{pattern}{bits}")

    path = write_bag(tmp_path / "drive", "mcap", fill)
    for frame in open_sequence(path, fov_degrees=60, grey=False):
        np.testing.assert_array_equal(frame.image, colour)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("mono8", grey_of(0)),
        ("mono16", grey_of(0).astype("<u2") << 8),
        ("bgr8", rgb_of(0)[:, :, ::-1]),
        ("bgra8", cv2.cvtColor(rgb_of(0), cv2.COLOR_RGB2BGRA)),
        ("8UC3", rgb_of(0)),
    ],
)
def test_encodings(tmp_path: Path, encoding: str, pixels: np.ndarray) -> None:
    path = write_bag(tmp_path / "drive", "bag", lambda w: [w.image("/im", i, pixels, encoding) for i in range(3)])
    np.testing.assert_array_equal(next(iter(open_sequence(path, fov_degrees=60))).image, grey_of(0))


def test_compressed_images_and_a_fisheye(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        writer.info("/cam0/camera_info", "equidistant", (0.01, -0.002, 3e-4, -1e-4))
        for i in range(N):
            writer.compressed("/cam0/image_raw/compressed", i, ".png")

    for kind in ("bag", "mcap"):
        sequence = open_sequence(write_bag(tmp_path / kind, kind, fill))
        assert isinstance(sequence.camera, KannalaBrandtCamera)
        for i, frame in enumerate(sequence):
            assert np.abs(frame.image.astype(int) - grey_of(i)).max() <= 1


def test_rectified_images_have_the_projection_of_their_info(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        writer.info("/left/camera_info")
        for i in range(3):
            writer.image("/left/image_rect_color", i, rgb_of(i), "rgb8")

    assert open_sequence(write_bag(tmp_path / "d", "mcap", fill)).camera == PinholeCamera(
        64, 48, 50.0, 50.0, 32.0, 23.0
    )


def test_several_topics_are_listed(tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        for i in range(3):
            writer.image("/left/image_raw", i, rgb_of(i), "rgb8")
            writer.image("/right/image_raw", i, rgb_of(i + 1), "rgb8")

    path = write_bag(tmp_path / "drive", "mcap", fill)
    named = r"/left/image_raw \(3\), /right/image_raw \(3\)"
    with pytest.raises(InputError, match=rf"images of several topics: {named}; choose one \(--topic NAME\)\."):
        open_sequence(path, fov_degrees=60)
    with pytest.raises(InputError, match=rf"no images of topic '/rear'; it has {named}\."):
        open_sequence(path, fov_degrees=60, topic="/rear")
    sequence = open_sequence(path, fov_degrees=60, topic="right/image_raw")
    np.testing.assert_array_equal(next(iter(sequence)).image, grey_of(1))
    assert sequence.topic == "/right/image_raw"  # a run remembers it, and an export reads the same images
    again = open_images_of_run(path, (WIDTH, HEIGHT), sequence.topic)
    np.testing.assert_array_equal(next(iter(again)).image, grey_of(1))


def test_headers_may_count_from_zero(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.BEGIN_NS", 0)  # as of a simulator
    path = write_bag(tmp_path / "drive", "mcap", raw)
    times_s = open_sequence(path).source_timestamps
    np.testing.assert_allclose(times_s, [1e-9 * time_of(i) for i in range(len(times_s))], atol=1e-9)


def test_what_is_no_bag_of_images_says_so(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", "mcap", lambda w: w.info("/camera/camera_info"))
    with pytest.raises(InputError, match=r"holds no images .*: it has sensor_msgs/msg/CameraInfo"):
        open_sequence(path, fov_degrees=60)
    (tmp_path / "text.mcap").write_text("hello, I am no bag at all")
    with pytest.raises(InputError, match="is no ROS bag and no MCAP file"):
        open_sequence(tmp_path / "text.mcap", fov_degrees=60)
    path = write_bag(
        tmp_path / "depth", "bag", lambda w: [w.image("/d", i, np.ones((48, 64), "<f4"), "32FC1") for i in range(3)]
    )
    with pytest.raises(InputError, match="encoding '32fc1', which is not read"):
        open_sequence(path, fov_degrees=60)
    with pytest.raises(InputError, match="is no bag, and has no topics"):
        open_sequence(tmp_path / "text.txt", topic="/x")


def test_without_the_extra_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "drive", "mcap_zstd", raw)  # packed by what the extra brings
    for name in ("rosbags", "compression.zstd", "backports.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"^Bags are read by rosbags, which .*\[bags\]\"\.$"):
        open_sequence(path)


@pytest.mark.parametrize("share", [0.5, 0.7, 0.9])
def test_a_database_cut_anywhere_gives_what_is_before_the_cut(tmp_path: Path, share: float) -> None:
    data = write_bag(tmp_path / "drive", "db3", raw)
    whole = next(data.glob("*.db3")).read_bytes()
    cut = tmp_path / "lost" / "cut.db3"
    cut.parent.mkdir()
    cut.write_bytes(whole[: int(share * len(whole))])
    frames = list(open_sequence(cut.parent, fov_degrees=60))  # its metadata.yaml is lost, too
    assert 0 < len(frames) <= N
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, grey_of(i))


def test_raw_images_of_twelve_bits_are_read_by_these(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def fill(writer: Writer) -> None:
        for i in range(N):
            writer.image("/camera/image_raw", i, grey_of(i).astype(np.uint16) << 4, "mono16")

    frames = list(open_sequence(write_bag(tmp_path / "drive", "mcap", fill), fov_degrees=60))
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, grey_of(i))
    assert "use 12 of them" in caplog.text


def test_images_beside_a_bag_are_a_folder_of_images(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "000.png"), PATTERN)
    write_bag(tmp_path / "drive", "mcap", raw).rename(tmp_path / "drive.mcap")
    assert open_sequence(tmp_path, fov_degrees=60).image_names == ("000",)
