"""The buffer's memory: what it keeps, what it gives up under its bound, and in which order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.grey_image import GreyImage
from dualslam.core.resources import MB
from dualslam.core.types import LateFrame, View
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.testing.point_world import random_features

RNG = np.random.default_rng(5)
SMOOTH = np.cumsum(RNG.integers(-2, 3, (60, 80)), axis=1).astype(np.uint8)
NOISE = RNG.integers(0, 256, (60, 80), np.uint8)
RATE_HZ = 8.0


def view(i: int, pixels: np.ndarray | None = NOISE) -> View:
    image = GreyImage.of(pixels) if pixels is not None else None
    return View(i, i / RATE_HZ, random_features(np.random.default_rng(i), 5), image)


def indices(buffer: FrameBuffer) -> list[int]:
    return [v.index for v in buffer]


def with_image(buffer: FrameBuffer) -> list[int]:
    return [v.index for v in buffer if v.image is not None]


class TestGreyImage:
    @pytest.mark.parametrize("pixels", [SMOOTH, NOISE, np.zeros((1, 1), np.uint8), SMOOTH[:, ::2]])
    def test_packing_loses_nothing(self, pixels: np.ndarray) -> None:
        image = GreyImage.of(pixels)
        for version in (image, image.pack(), image.pack().pack()):
            np.testing.assert_array_equal(version.pixels(), pixels)
            with pytest.raises(ValueError, match="read-only"):
                version.pixels()[0, 0] = 1

    def test_packing_saves_memory_and_never_costs_any(self) -> None:
        assert GreyImage.of(SMOOTH).pack().nbytes < 0.5 * SMOOTH.nbytes
        assert GreyImage.of(NOISE).pack().nbytes <= NOISE.nbytes


class TestFrameBuffer:
    def test_a_change_in_slices_is_whole_as_soon_as_somebody_looks(self) -> None:
        buffer, changed = FrameBuffer(100.0, 10.0), []

        def change(v: View) -> View:
            changed.append(v.index)
            return replace(v, turn_rad=np.ones(3))

        for i in range(10):
            buffer.append(view(i))
        buffer.map_later(change, "turn")
        assert changed == []
        buffer.settle(3)
        assert changed == [9, 8, 7]
        buffer.append(view(10))  # it is as it should be already
        assert [v.index for v in buffer if v.turn_rad is None] == [10]
        assert sorted(changed) == list(range(10))
        buffer.settle()
        assert len(changed) == 10
        assert buffer.nbytes == sum(v.nbytes for v in buffer)

    def test_the_newest_are_changed_first_where_somebody_looks_at_them_alone(self) -> None:
        buffer = FrameBuffer(100.0, 10.0)
        for i in range(10):
            buffer.append(view(i))
        buffer.map_later(lambda v: replace(v, turn_rad=np.ones(3)), "turn")
        buffer.append(view(10))
        newest = buffer.newest(4)
        assert [v.index for v in newest] == [7, 8, 9, 10]
        assert [v.index for v in newest if v.turn_rad is None] == [10]
        changed: list[int] = []
        buffer.map_later(lambda v: changed.append(v.index) or v, "turn")  # type: ignore[func-returns-value]
        assert buffer.newest(99)[0].turn_rad is None  # the second change has taken the place of the first
        assert sorted(changed) == list(range(11))

    def test_a_change_of_another_subject_comes_after_the_first(self) -> None:
        buffer = FrameBuffer(100.0, 10.0)
        for i in range(10):
            buffer.append(view(i))
        buffer.map_later(lambda v: replace(v, turn_rad=np.ones(3)), "turn")
        buffer.map_later(lambda v: replace(v, image=None), "image")
        assert all(v.turn_rad is not None and v.image is None for v in buffer)

    def test_what_is_let_go_of_meanwhile_is_not_changed(self) -> None:
        buffer, changed = FrameBuffer(1.0, 10.0), []
        for i in range(9):
            buffer.append(view(i))
        buffer.map_later(lambda v: changed.append(v.index) or v, "turn")  # type: ignore[func-returns-value]
        for i in range(9, 14):
            buffer.append(view(i))
        assert indices(buffer) == list(range(5, 14))
        assert sorted(changed) == [5, 6, 7, 8]

    def test_it_keeps_the_last_seconds(self) -> None:
        buffer = FrameBuffer(1.0, 10.0)
        for i in range(50):
            buffer.append(view(i))
        assert [v.index for v in buffer.backwards_from(49)] == list(range(48, 40, -1))
        assert [v.index for v in buffer.backwards_from(45)] == list(range(44, 40, -1))
        assert list(buffer.backwards_from(7)) == []

    def test_late_frames_stay_as_long_as_those_about_them_and_are_the_first_to_go(self) -> None:
        buffer = FrameBuffer(1.0, 10.0)
        for i in range(50):
            if i % 3:
                buffer.append(view(i))
            else:
                buffer.append_late(LateFrame(i, i / RATE_HZ, GreyImage.of(NOISE)))
        oldest = indices(buffer)[0]
        assert [frame.index for frame in buffer.late] == [i for i in range(oldest, 50) if i % 3 == 0]
        kept = sum(v.nbytes for v in buffer) + sum(frame.nbytes for frame in buffer.late)
        assert buffer.nbytes == kept
        small = FrameBuffer(100.0, 4.5 * NOISE.nbytes / MB)
        for i in range(3):
            small.append_late(LateFrame(2 * i, i / 4, GreyImage.of(NOISE)))
            small.append(view(2 * i + 1))
        assert len(small.late) < 3
        assert with_image(small) == [1, 3, 5]
        assert small.nbytes <= 4.5 * NOISE.nbytes

    def test_time_may_run_backwards(self) -> None:
        buffer = FrameBuffer(1.0, 10.0)
        for i in range(50, 0, -1):
            buffer.append(view(i))
        assert [v.index for v in buffer.backwards_from(1)] == list(range(2, 10))

    def test_frozen_it_grows_and_thawed_it_is_a_queue_again(self) -> None:
        buffer = FrameBuffer(1.0, 10.0)
        for i in range(60):
            buffer.append(view(i))
            if i == 20:
                buffer.freeze()
        assert indices(buffer) == list(range(12, 60))
        buffer.thaw()
        buffer.append(view(60))
        assert indices(buffer) == list(range(52, 61))

    def test_its_memory_is_the_sum_of_its_views(self) -> None:
        buffer = FrameBuffer(1.0, 10.0)
        for i in range(30):
            buffer.append(view(i, SMOOTH if i % 2 else None))
        assert buffer.nbytes == sum(v.nbytes for v in buffer)
        assert (buffer.numbers["frames"], buffer.numbers["images"]) == (9, 5)
        buffer.change_all(lambda views: [replace(v, image=None) for v in views])
        assert buffer.nbytes == sum(v.nbytes for v in buffer)
        assert buffer.peak_bytes > buffer.nbytes


LOST_AT, FIRST = 15, 7  # the loss, and the oldest frame that the buffer held then


def overflown(n: int, frames_of_bound: float, pixels: np.ndarray) -> FrameBuffer:
    """A buffer of one second that was frozen at `LOST_AT`, with a bound of so many frames as they come."""
    buffer = FrameBuffer(1.0, frames_of_bound * view(0, pixels).nbytes / MB)
    for i in range(n):
        buffer.append(view(i, pixels))
        assert buffer.nbytes <= frames_of_bound * view(0, pixels).nbytes
        assert buffer.nbytes == sum(v.nbytes for v in buffer)
        if i == LOST_AT:
            buffer.freeze()
    return buffer


class TestBound:
    before, newest = list(range(FIRST, LOST_AT)), 1 + int(RATE_HZ)

    def test_first_images_are_packed_and_nothing_is_lost(self) -> None:
        buffer = overflown(45, 25, SMOOTH)
        assert indices(buffer) == list(range(FIRST, 45))
        assert with_image(buffer) == indices(buffer)
        packed = [v.image is not None and v.image.packed for v in buffer]
        assert packed[0]
        assert not packed[-1]
        for v in buffer:
            assert v.image is not None
            np.testing.assert_array_equal(v.image.pixels(), SMOOTH)

    def test_then_the_images_of_the_stretch_thin_out_evenly(self) -> None:
        n = 75
        buffer = overflown(n, 45, NOISE)
        assert indices(buffer) == list(range(FIRST, n))
        kept = with_image(buffer)
        assert kept[: len(self.before)] == self.before
        assert kept[-self.newest :] == list(range(n - self.newest, n))
        stretch = kept[len(self.before) - 1 : -self.newest + 1]
        assert 1 < len(stretch) < n - self.newest - LOST_AT
        assert max(np.diff(stretch)) <= 2 * (n - self.newest - LOST_AT) / len(stretch) + 1

    @pytest.mark.slow
    def test_then_whole_frames_and_what_surrounds_the_stretch_stays(self) -> None:
        n = 600
        buffer = overflown(n, 30, NOISE)
        kept = indices(buffer)
        assert kept[: len(self.before)] == self.before
        assert kept[-self.newest :] == list(range(n - self.newest, n))
        assert with_image(buffer) == [*self.before, *range(n - self.newest, n)]
        assert LOST_AT < kept[len(self.before)] < n / 2, "some of the stretch is left"

    def test_a_bound_too_small_for_the_rest_costs_the_oldest(self) -> None:
        buffer = overflown(60, 6, NOISE)
        assert with_image(buffer) == list(range(60 - len(with_image(buffer)), 60))
        assert 59 in with_image(buffer)
        kept = indices(buffer)
        assert kept == sorted(kept)
        assert kept[-1] == 59

    def test_it_holds_without_a_loss_too(self) -> None:
        buffer = FrameBuffer(1.0, 5 * view(0).nbytes / MB)
        for i in range(30):
            buffer.append(view(i))
        assert buffer.nbytes <= 5 * view(0).nbytes
        assert with_image(buffer)[-1] == 29
