"""Corruptions of images and of the stream of frames."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from dualslam.core.camera.models import PinholeCamera, RadTanCamera
from dualslam.core.config.corruption import CAMERA_KINDS
from dualslam.core.config.files import load_config
from dualslam.core.errors import ConfigError
from dualslam.core.types import Frame
from dualslam.lab.disturbances import Corruption, CorruptionKind, corrupted
from dualslam.lab.disturbances.images import corrupt_image

WIDTH, HEIGHT, N = 320, 240, 20


def photograph(i: int) -> np.ndarray:
    """Detail at all scales, and another image for each number."""
    rng = np.random.default_rng([7, i])
    total = np.zeros((HEIGHT, WIDTH), np.float32)
    for cell in (40, 16, 6, 2):
        coarse = rng.uniform(0, 255, (HEIGHT // cell + 1, WIDTH // cell + 1)).astype(np.float32)
        total += cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) / 4
    return np.clip(total, 0, 255).astype(np.uint8)


class Recorded:
    name = "recorded"
    camera = PinholeCamera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0)
    rate_hz = 10.0
    ground_truth = "the truth"
    source_indices = np.arange(N)
    frame_timestamps = 0.1 * np.arange(N)

    def __init__(self) -> None:
        self.closed = False

    def __len__(self) -> int:
        return N

    def __iter__(self) -> Iterator[Frame]:
        try:
            for i in range(N):
                yield Frame(i, 0.1 * i, photograph(i))
        finally:
            self.closed = True


def only(kind: str, **fields: object) -> Corruption:
    return Corruption.model_validate({"kind": kind, "start": 5, "length": 4} | fields)


def sharpness(image: np.ndarray) -> float:
    return float(cv2.Laplacian(image, cv2.CV_64F).var())


SPOILS = ["wipe", "occlusion", "blur", "motion_blur", "blackout", "exposure", "noise"]


@pytest.mark.parametrize("kind", SPOILS)
def test_only_the_frames_of_a_corruption_are_spoilt_and_always_alike(kind: str) -> None:
    frames = list(corrupted(Recorded(), [only(kind)]))
    assert [f.index for f in frames] == list(range(N))
    changed = [f.index for f in frames if not np.array_equal(f.image, photograph(f.index))]
    assert changed == [5, 6, 7, 8]
    assert all(f.image is not None and f.image.shape == (HEIGHT, WIDTH) and f.image.dtype == np.uint8 for f in frames)
    # In another order, and alone: the same pixels.
    assert np.array_equal(corrupt_image(photograph(7), only(kind), 7), frames[7].image)


@pytest.mark.parametrize("kind", ["occlusion", "motion_blur", "noise"])
def test_another_seed_is_another_corruption(kind: str) -> None:
    one, other = (corrupt_image(photograph(6), only(kind, seed=seed), 6) for seed in (0, 1))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("kind", SPOILS)
def test_colour_images_are_spoilt_as_well(kind: str) -> None:
    colour = np.dstack([photograph(1), photograph(2), photograph(3)])
    before = colour.copy()
    spoilt = corrupt_image(colour, only(kind), 5)
    assert spoilt.shape == colour.shape
    assert not np.array_equal(spoilt, colour)
    assert np.array_equal(colour, before)


def test_a_black_out_leaves_no_light() -> None:
    assert corrupt_image(photograph(5), only("blackout"), 5).max() == 0
    half = corrupt_image(photograph(5), only("blackout", strength=0.5), 5)
    # Half the light is 0.5 ** (1 / 2.2) of the display value.
    assert np.median(half / np.maximum(photograph(5), 1)) == pytest.approx(0.73, abs=0.01)


def test_exposure_is_in_stops() -> None:
    ratio = corrupt_image(photograph(5), only("exposure", strength=-2.2), 5) / np.maximum(photograph(5), 1)
    assert np.median(ratio) == pytest.approx(0.5, abs=0.01)
    bright = corrupt_image(photograph(5), only("exposure", strength=8), 5)
    assert np.mean(bright == 255) > 0.99


def test_noise_has_its_standard_deviation() -> None:
    grey = np.full((HEIGHT, WIDTH), 128, np.uint8)
    noisy = corrupt_image(grey, only("noise", strength=12), 5).astype(float)
    assert noisy.std() == pytest.approx(12, rel=0.02)
    assert noisy.mean() == pytest.approx(128, abs=0.2)


def test_blurs_and_wipes_take_detail_away() -> None:
    image = photograph(5)
    for kind in ("blur", "motion_blur", "wipe"):
        assert sharpness(corrupt_image(image, only(kind), 5)) < 0.15 * sharpness(image)
    mild = corrupt_image(image, only("blur", strength=1.2), 5)
    assert 0.2 * sharpness(image) < sharpness(mild) < sharpness(image)
    # A smear keeps what runs along it: it is no isotropic blur.
    row = np.zeros((HEIGHT, WIDTH), np.uint8)
    row[120, :] = row[:, 160] = 255
    smeared = corrupt_image(row, only("motion_blur"), 5)
    levels = sorted([int(smeared[118:123, 20].max()), int(smeared[20, 158:163].max())])
    assert levels[1] > 1.2 * levels[0]


@pytest.mark.parametrize("share", [0.1, 0.4, 1.0])
def test_a_patch_hides_its_share_and_moves(share: float) -> None:
    masks = []
    for i in range(5, 9):
        grey = np.full((HEIGHT, WIDTH), 1, np.uint8)
        masks.append(corrupt_image(grey, only("occlusion", strength=share), i) != 1)
    hidden = [mask.mean() for mask in masks]
    # A square of a 4:3 image's whole area is higher than the image is.
    assert hidden == pytest.approx([min(share, 0.87)] * 4, abs=0.02)
    columns = [np.flatnonzero(mask.any(axis=0)).mean() for mask in masks]
    moved = np.diff(columns)
    assert share == 1.0 or (abs(moved).min() > 5 and len(set(np.sign(moved))) == 1)


def test_dropped_frames_do_not_arrive() -> None:
    sequence = corrupted(Recorded(), [only("drop"), only("stride", start=10, length=None, strength=3)])
    indices = [0, 1, 2, 3, 4, 9, 10, 13, 16, 19]
    assert [f.index for f in sequence] == indices
    assert len(sequence) == len(indices)
    assert sequence.source_indices.tolist() == indices  # type: ignore[attr-defined]
    assert sequence.frame_timestamps.tolist() == [0.1 * i for i in indices]  # type: ignore[attr-defined]


def test_a_frozen_camera_repeats_its_last_image() -> None:
    frames = list(corrupted(Recorded(), [only("freeze")]))
    assert [f.index for f in frames] == list(range(N))
    for i in (5, 6, 7, 8):
        assert np.array_equal(frames[i].image, photograph(4))
        assert frames[i].timestamp_s == pytest.approx(0.1 * i)
    assert np.array_equal(frames[9].image, photograph(9))


def test_the_rest_is_the_sequence_itself() -> None:
    recorded = Recorded()
    sequence = corrupted(recorded, [only("blur")])
    assert sequence.ground_truth == "the truth"  # type: ignore[attr-defined]
    assert (sequence.name, sequence.rate_hz, len(sequence)) == ("recorded", 10.0, N)
    frames = iter(sequence)
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert recorded.closed
    assert corrupted(recorded, [only("wrong_pose")]) is recorded


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[{kind: blurr}]", "kind must be 'wipe'"),
        ("[{kind: blur, strength: 900}]", "corruptions[0]: strength of blur is 900; it must lie between 0 and 100"),
        ("[{kind: blur, from: 3}]", "unknown field corruptions[0].from"),
        ("[{kind: blur, length: 0}]", "corruptions[0].length must be greater than or equal to 1"),
        ("blur", "corruptions must be a list"),
    ],
)
def test_a_wrong_corruption_is_named(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(None, [f"corruptions={text}"])
    assert said in str(error.value)


def test_all_kinds_have_a_default() -> None:
    for kind in CorruptionKind:
        assert isinstance(Corruption(kind=kind, length=None if kind in CAMERA_KINDS else 3).level, float)


def of_run(kind: str, strength: float | None = None, **fields: object) -> Corruption:
    return only(kind, start=0, length=None, strength=strength, **fields)


def test_a_wrong_calibration_reaches_the_run_and_changes_no_image() -> None:
    true = Recorded.camera
    wrong = corrupted(Recorded(), [of_run("focal", 1.3)])
    assert (wrong.camera.fx, wrong.camera.fy) == pytest.approx((1.3 * true.fx, 1.3 * true.fy))
    assert (wrong.camera.cx, wrong.camera.size_px) == (true.cx, true.size_px)
    assert np.array_equal(next(iter(wrong)).image, photograph(0))
    half = corrupted(Recorded(), [of_run("resolution", 0.5)]).camera
    assert (half.fx, half.cx, half.cy) == pytest.approx((150.0, 79.75, 59.75))
    assert half.size_px == true.size_px
    with pytest.raises(ConfigError):
        load_config(None, ["corruptions=[{kind: focal, start: 3}]"])


def test_a_calibration_without_its_distortion_is_a_pinhole() -> None:
    recorded = Recorded()
    recorded.camera = RadTanCamera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, -0.2, 0.05)  # type: ignore[assignment]
    assert corrupted(recorded, [of_run("no_distortion")]).camera == Recorded.camera


def test_a_wrong_clock_says_the_same_to_the_frames_and_in_the_list() -> None:
    def times(*corruptions: Corruption) -> np.ndarray:
        sequence = corrupted(Recorded(), corruptions)
        in_list = sequence.frame_timestamps  # type: ignore[attr-defined]
        assert np.array_equal([frame.timestamp_s for frame in sequence], in_list)
        return np.asarray(in_list)

    true = Recorded.frame_timestamps
    assert times(of_run("clock_unit", 1000.0)) == pytest.approx(1000 * true)
    jitter = times(of_run("clock_jitter", 0.9, seed=3)) - true
    assert 0.02 < np.abs(jitter).max() <= 0.045
    assert (np.diff(true + jitter) > 0).all()
    assert times(only("clock_repeat", length=5))[4:11] == pytest.approx([0.4, 0.5, 0.5, 0.7, 0.7, 0.9, 1.0])


def test_a_corruption_that_never_strikes_is_told(caplog: pytest.LogCaptureFixture) -> None:
    corrupted(Recorded(), [only("blur"), only("wrong_pose", start=19), only("stride", start=0, length=None)])
    assert not caplog.records
    corrupted(Recorded(), [only("blackout", start=5000, length=3), only("wrong_pose", start=20, length=None)])
    assert [record.getMessage() for record in caplog.records] == [
        "blackout at frames 5000 to 5002 never strikes: the run's frames are 0 to 19",
        "wrong_pose at frames 20 on never strikes: the run's frames are 0 to 19",
    ]
