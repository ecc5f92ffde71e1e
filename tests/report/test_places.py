"""Places seen again, in the report: pictures of both, what agreed, what moved, and what was not believed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dualslam.core.types import Frame, FrameStatus
from dualslam.report import RunData, report_page
from dualslam.report.places import places_section
from dualslam.report.samples import ALBUM_SIZE, MAX_PLACES, PlaceAlbum
from dualslam.report.samples import thumbnail as jpeg_of

LOOP = {
    "event": "loop_closed", "frame": 30, "timestamp_s": 3.0, "submap": 2, "other_submap": 0, "other_frame": 4,
    "keyframe": 29, "confirmations": 2, "matches": 183, "inliers": 120, "found": 0.26, "own_found": 0.56, "drift": 0.03,
    "drift_rot_deg": 1.2, "drift_log_scale": -0.0953, "moved": 0.27,
}  # fmt: skip
REFUSED = {
    "event": "loop_refused", "frame": 12, "timestamp_s": 1.2, "submap": 0, "other_submap": 0, "other_frame": 2,
    "reason": "ambiguous_model", "detail": "<two> poses",
}  # fmt: skip


def picture(shade: int) -> bytes:
    return jpeg_of(np.full((30, 40), shade, np.uint8))


def test_a_loop_has_a_card_with_both_pictures_and_what_moved(broken_run: RunData) -> None:
    run = replace(broken_run, events=[LOOP], samples={5: picture(0), 29: picture(255), 400: picture(9)})
    page = str(places_section(run))
    assert page.count("<img") == 2
    for words in ("29 now", "5, near 4 then", "120 of 183 landmark pairs agree", "26 %", "56 %", "3 % of the way"):
        assert words in page, words
    assert "1.2°" in page
    assert "10 % in scale" in page
    assert "up to 0.27 of their unit" in page
    assert "submap 2, and submap 0" in page
    assert "Places seen again" in report_page(run)


def test_what_was_refused_is_counted_by_its_reason_with_an_example(broken_run: RunData) -> None:
    other = REFUSED | {"reason": "reprojection", "detail": "30 % there"}
    page = str(places_section(replace(broken_run, events=[REFUSED, other, REFUSED])))
    assert "3 places that looked alike were not believed" in page
    assert "ambiguous model" in page
    assert "&lt;two&gt; poses" in page
    assert "<img" not in page


@pytest.mark.parametrize(("whence", "words"), [(None, "in submap 1 by"), (0, "left submap 0 for it")])
def test_a_map_found_again_says_where_and_of_which_run(broken_run: RunData, whence: int | None, words: str) -> None:
    event = {
        "event": "relocalised",
        "frame": 3,
        "submap": 1,
        "n_inliers": 80,
        "other_frame": -20,
        "from_submap": whence,
    }
    page = str(places_section(replace(broken_run, events=[event], samples={3: picture(1)})))
    assert words in page
    assert "-20 (of an earlier run)" in page
    assert page.count("<img") == 1


def test_without_a_place_there_is_no_section(broken_run: RunData) -> None:
    assert places_section(replace(broken_run, events=[])) is None
    assert "Places seen again" not in report_page(replace(broken_run, events=[]))


@pytest.mark.parametrize("step_s", [0.1, -0.1])
def test_the_album_remembers_twice_a_second_in_either_direction(step_s: float) -> None:
    album = PlaceAlbum(lambda *_: None)
    for i in range(50):
        album.take(Frame(i, 100 + step_s * i, np.zeros((30, 40), np.uint8)), FrameStatus.TRACKED)
    assert 9 <= len(album._pictures) <= 10


def test_the_album_shows_what_was_seen_nearest_to_a_frame_and_is_bounded() -> None:
    kept: dict[int, bytes] = {}
    album = PlaceAlbum(kept.__setitem__)
    for i in range(3 * ALBUM_SIZE):
        status = FrameStatus.LOST if i == 20 else FrameStatus.TRACKED
        album.take(Frame(i, 0.5 * i, np.full((30, 40), i % 200, np.uint8)), status)
    assert len(album._pictures) <= ALBUM_SIZE
    album.show([3 * ALBUM_SIZE - 4, 20, -7])
    assert len(kept) == 2
    assert 20 not in kept
    for i, jpeg in kept.items():
        shade = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).mean()
        assert abs(shade - i % 200) < 3
        assert min(abs(i - 20), abs(i - 3 * ALBUM_SIZE + 4)) <= 4
    for i in range(50):
        album.show([40 * i])
    assert len(kept) <= 2 * MAX_PLACES
