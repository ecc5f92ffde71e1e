"""Stretches in which images and map disagree: several samples in a row, in one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import Features, FloatArray, Track, View
from dualslam.map.submap import Submap
from dualslam.system.audit.photometric import MIN_SAMPLES, PhotometricAudit, Sample, Stretch, find_disagreement

EMPTY = np.zeros((0, 2))
FEATURES = Features(EMPTY, EMPTY, EMPTY[:, 0], EMPTY[:, 0], np.zeros(0, np.int64), EMPTY[:, 0], EMPTY)
NONE = np.zeros(0, np.int64)


class Script:
    """Agrees or not, as the script says of each frame."""

    def __init__(self, agreement: dict[int, float | None]) -> None:
        self.agreement = agreement

    def remember(self, submap: Submap, view: View) -> None:
        pass

    def measure(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> float | None:
        return self.agreement[view.index]


def track(index: int, rate_hz: float) -> Track:
    view = View(index, index / rate_hz, FEATURES)
    return Track(view, np.eye(4), np.eye(4), NONE, NONE, 0, 0, 1.0, False, np.eye(6))


def samples(agreements: list[float], submap_id: int = 0) -> list[Sample]:
    return [Sample(6 * n, 0.2 * n, submap_id, agreement) for n, agreement in enumerate(agreements)]


def test_a_single_low_sample_is_no_stretch_and_several_are() -> None:
    assert not find_disagreement(samples([0.8, 0.0, 0.8, 0.1, 0.0, 0.8, 0.2])).stretches
    low = [0.05] * (MIN_SAMPLES + 1)
    found = find_disagreement(samples([0.8, *low, 0.8, *low]))
    ends = [(1, MIN_SAMPLES + 1), (MIN_SAMPLES + 3, 2 * MIN_SAMPLES + 3)]
    assert found.stretches == tuple(Stretch(6 * first, 6 * last, 0.05) for first, last in ends)


def test_the_worst_stretch_counts_not_the_worst_sample() -> None:
    found = find_disagreement(samples([0.9, 0.0, 0.9, 0.5, 0.4, 0.3, 0.6, 0.9]))
    assert found.worst == pytest.approx(0.5), "of 0.5, 0.4, 0.3"
    assert not found.stretches


def test_a_stretch_is_of_one_map() -> None:
    low = [0.0] * (MIN_SAMPLES - 1)
    found = find_disagreement([*samples(low), *samples(low, submap_id=1)])
    assert (found.stretches, found.worst) == ((), 0.0)


def test_frames_are_sampled_by_their_times_and_doubt_is_there_while_they_disagree() -> None:
    agreement: dict[int, float | None] = {i: 0.0 if 60 <= i < 120 else None if i < 12 else 0.7 for i in range(180)}
    audit = PhotometricAudit(Script(agreement))
    submap, doubtful, broken = Submap(0, np.eye(3), np.zeros(32, np.uint8)), [], []
    for i in range(180):
        audit.take(submap, track(i, rate_hz=30.0))
        if audit.doubts(0):
            doubtful.append(i)
        if audit.broken_since(0) is not None:
            broken.append((i, audit.broken_since(0)))
        assert not audit.doubts(1)
        assert audit.broken_since(1) is None
    assert len(audit.samples) == 28, "every sixth frame, from the first that could be compared"
    assert doubtful == list(range(60, 120)), "from the first sample that disagrees to the next that agrees"
    assert broken[0] == (72, 55), "with the third, since the last that agreed"
    (stretch,) = find_disagreement(audit.samples).stretches
    assert (stretch.first, stretch.last) == (60, 114)


def test_an_image_that_repeats_the_one_before_is_noted() -> None:
    audit, submap = (
        PhotometricAudit(Script(dict.fromkeys(range(9), None))),
        Submap(0, np.eye(3), np.zeros(32, np.uint8)),
    )
    for i in range(9):
        image = GreyImage.of(np.full((4, 4), 3 if 3 <= i < 6 else i + 10, np.uint8))
        shown = track(i, rate_hz=30.0)
        audit.take(submap, replace(shown, view=replace(shown.view, image=image)))
    assert audit.repeated == {4, 5}
