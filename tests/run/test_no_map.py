"""A run without a map says why."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.core.config.settings import Config
from dualslam.core.types import Failure, FailureReason, Frame, FrameStatus
from dualslam.lab.synthetic import make_sequence
from dualslam.map.frame_records import FrameResult
from dualslam.run.no_map import LITTLE_PARALLAX, NOTHING_MOVES, WORDS, StartRefusals


def sentence(*failures: Failure | None) -> str | None:
    refusals = StartRefusals()
    for i, failure in enumerate(failures):
        refusals.note(FrameResult(i, FrameStatus.INITIALISING, None, None, 0, 0, 0.0, failure))
    return refusals.sentence()


def low_parallax(shift_px: float) -> Failure:
    return Failure(FailureReason.LOW_PARALLAX, numbers={"shift_px": shift_px})


def test_the_reason_of_most_frames_is_told_and_how_many_they_are() -> None:
    black, few = Failure(FailureReason.NO_TEXTURE), Failure(FailureReason.TOO_FEW_MATCHES)
    assert sentence(*[black] * 20) == WORDS[FailureReason.NO_TEXTURE]
    assert sentence(*[black] * 8, *[few] * 12) == f"{WORDS[FailureReason.TOO_FEW_MATCHES]} (12 of 20 frames)"
    assert sentence(*[Failure(FailureReason.UNREADABLE)] * 5) == WORDS[FailureReason.UNREADABLE]
    assert sentence(None, None) is None


def test_a_camera_that_stands_still_is_told_from_one_that_turns() -> None:
    assert sentence(*[low_parallax(0.2)] * 19, low_parallax(40.0)) == NOTHING_MOVES
    assert sentence(*[low_parallax(0.2)] * 10, *[low_parallax(40.0)] * 10) == LITTLE_PARALLAX


def test_few_images_are_too_short_and_a_search_under_way_is_no_reason() -> None:
    assert sentence(*[low_parallax(0.2)] * 4) == "too short: 4 images"
    busy = Failure(FailureReason.BUSY)
    assert sentence(*[busy] * 30, *[low_parallax(9.0)] * 2) == LITTLE_PARALLAX


@pytest.mark.parametrize("what", ["still", "turning", "black"])
def test_what_a_system_saw_is_what_is_told(what: str) -> None:
    sequence = make_sequence("street", 2, 1, width=320, height=240)
    image = next(iter(sequence)).image
    assert image is not None
    system, refusals = build_system(Config(), sequence.camera), StartRefusals()
    rng = np.random.default_rng(0)
    for i in range(14):
        shown = image.astype(float) + rng.normal(0, 2, image.shape)
        if what == "turning":
            shown = _turned(shown, sequence.camera.K, 0.01 * i)
        if what == "black":
            shown = np.zeros(image.shape)
        refusals.note(system.step(Frame(i, i / 10, np.clip(shown, 0, 255).astype(np.uint8))))
    assert not system.atlas.submaps
    expected = {"still": NOTHING_MOVES, "turning": LITTLE_PARALLAX, "black": WORDS[FailureReason.NO_TEXTURE]}
    assert (refusals.sentence() or "").startswith(expected[what])


def _turned(image: np.ndarray, K: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return what a camera sees that has turned about its vertical axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    H = K @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ np.linalg.inv(K)
    return np.asarray(cv2.warpPerspective(image, H, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT))
