"""Video files and webcams."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.camera.models import camera_from_fov
from dualslam.core.errors import InputError
from dualslam.io import open_sequence
from dualslam.io.sequence import Selection
from dualslam.io.video import open_webcam

N, FPS = 70, 20.0
WIDTH, HEIGHT = 64, 48


def level_of(i: int) -> int:
    return 30 + 3 * i


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("this OpenCV has no MJPG encoder")
    for i in range(N):
        writer.write(np.full((HEIGHT, WIDTH, 3), level_of(i), np.uint8))
    writer.release()
    return path


def index_of(image: np.ndarray) -> int:
    return round((float(np.mean(image)) - 30) / 3)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, list(range(N))),
        ({"start": 40, "stride": 7}, list(range(40, N, 7))),
        ({"reverse": True}, list(range(N))[::-1]),
        ({"start": 3, "stride": 5, "max_frames": 10, "reverse": True}, list(range(3, 53, 5))[::-1]),
    ],
)
def test_frames_of_a_video(video: Path, options, expected) -> None:
    sequence = open_sequence(video, fov_degrees=70, **options)
    frames = list(sequence)
    assert len(sequence) == len(expected)
    assert [f.index for f in frames] == expected
    assert [index_of(f.image) for f in frames] == expected
    np.testing.assert_allclose([f.timestamp_s for f in frames], np.array(expected) / FPS, atol=1e-6)
    assert sequence.camera.width == WIDTH
    assert sequence.name == "walk"


def test_video_in_colour(video: Path) -> None:
    frame = next(iter(open_sequence(video, fov_degrees=70, grey=False)))
    assert frame.image.shape == (HEIGHT, WIDTH, 3)


def test_a_video_that_ends_early_says_so(video: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = video.read_bytes()
    torn = tmp_path / "torn.avi"
    torn.write_bytes(data[: len(data) // 2])
    n = len(open_sequence(torn, fov_degrees=70))
    assert 0 < n < N
    assert f"{torn} ends early: {n} of the {N} frames that it announces are there" in caplog.text
    caplog.clear()
    assert len(open_sequence(video, fov_degrees=70)) == N
    assert not caplog.records


def test_bad_videos(video: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no calibration"):
        open_sequence(video)
    broken = tmp_path / "broken.avi"
    broken.write_bytes(video.read_bytes()[:300])
    with pytest.raises(InputError, match=r"broken.avi (is no video|holds no frame)"):
        open_sequence(broken, fov_degrees=70)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match=r"text\.mp4 is no video that OpenCV can open"):
        open_sequence(tmp_path / "text.mp4", fov_degrees=70)


# --- webcam


class FakeCapture:
    """A webcam of which some frames fail to decode."""

    def __init__(self, opened: bool = True, frames: int = 1000, bad: tuple[int, ...] = ()) -> None:
        self.opened, self.frames, self.bad = opened, frames, bad
        self.at = -1
        self.released = False

    def isOpened(self) -> bool:
        return self.opened

    def grab(self) -> bool:
        self.at += 1
        return self.at < self.frames

    def retrieve(self):
        if self.at in self.bad:
            return False, None
        return True, np.full((HEIGHT, WIDTH, 3), level_of(self.at), np.uint8)

    def get(self, prop: int) -> float:
        return 25.0

    def set(self, prop: int, value: float) -> bool:
        return False

    def release(self) -> None:
        self.released = True


def webcam(connect: Callable[[int], FakeCapture], selection: Selection, **given):
    camera, fov, rate_hz = given.get("camera"), given.get("fov", 70.0), given.get("rate_hz")
    return open_webcam(0, camera, fov, selection, rate_hz, True, connect)


def test_webcam() -> None:
    captures: list[FakeCapture] = []

    def connect(number: int) -> FakeCapture:
        captures.append(FakeCapture(bad=(4,)))
        return captures[-1]

    sequence = webcam(connect, Selection(start=2, stride=2, max_frames=3))
    frames = list(sequence)
    assert len(sequence) == 3
    assert [f.index for f in frames] == [2, 4, 6]
    assert [f.image is None for f in frames] == [False, True, False]
    assert "frame 4 of webcam_0" in frames[1].error
    assert index_of(frames[2].image) == 6
    assert all(a.timestamp_s < b.timestamp_s for a, b in pairwise(frames))
    assert sequence.rate_hz == 12.5
    assert len(captures) == 2
    assert all(c.released for c in captures)


def test_a_live_webcam_has_no_length_and_stops_with_its_reader() -> None:
    captures: list[FakeCapture] = []

    def connect(number: int) -> FakeCapture:
        captures.append(FakeCapture(frames=10**9))
        return captures[-1]

    sequence = webcam(connect, Selection())
    with pytest.raises(TypeError, match="no length"):
        len(sequence)
    stream = iter(sequence)
    assert next(stream).image is not None
    stream.close()
    assert captures[-1].released


def test_bad_webcams() -> None:
    with pytest.raises(InputError, match="cannot be opened"):
        webcam(lambda n: FakeCapture(opened=False), Selection())
    with pytest.raises(InputError, match="gives no frames"):
        webcam(lambda n: FakeCapture(frames=0), Selection())
    with pytest.raises(InputError, match="stopped giving frames"):
        list(webcam(lambda n: FakeCapture(frames=3), Selection()))
    with pytest.raises(InputError, match="cannot be read in reverse"):
        webcam(lambda n: FakeCapture(), Selection(reverse=True))
    with pytest.raises(InputError, match="times of its own"):
        webcam(lambda n: FakeCapture(), Selection(), rate_hz=20.0)
    with pytest.raises(InputError, match="no calibration"):
        webcam(lambda n: FakeCapture(), Selection(), fov=None)
    with pytest.raises(InputError, match="10 x 10 pixels"):
        webcam(lambda n: FakeCapture(), Selection(), camera=camera_from_fov(10, 10, 60.0))
