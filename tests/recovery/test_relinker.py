"""When reverse tracking tries to link, and when it has tried enough."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from dualslam.core.noise_model import GROUP
from dualslam.core.types import Failure, FailureReason
from dualslam.linking import LinkRefusal
from dualslam.map.submap import Submap
from dualslam.recovery.relinker import Relinker

ONSET = 190


def holding(submap_id: int, keyframes: range) -> Submap:
    return cast(Submap, SimpleNamespace(id=submap_id, keyframes=dict.fromkeys(keyframes)))


def tries_of_a_walk(n: int) -> tuple[list[int], int | None]:
    """Track back from keyframe 199 over n more; return the numbers shared at each try, and at which it was enough."""
    old, new = holding(0, range(200)), holding(1, range(200, 210))
    asked: list[int] = []

    def refuse(old: Submap, new: Submap, onset: int | None) -> Failure:
        asked.append(len(new.keyframes) - 10)
        return Failure(FailureReason.AGREEMENT, "no")

    relinker = Relinker(new, {0: old}, {0: ONSET}, refuse, 4)
    for shared in range(1, n + 1):
        k = 200 - shared
        new.keyframes[k] = None  # type: ignore[assignment]
        assert [t.n_shared for t in relinker.attempts(k)] == asked[-1:] * (asked[-1:] == [shared])
        if relinker.has_seen_enough:
            return asked, shared
    return asked, None


def test_it_tries_at_each_of_the_first_shared_keyframes() -> None:
    asked, _ = tries_of_a_walk(12)
    assert asked == list(range(4, 13))


def test_later_on_it_tries_at_each_tenth_part_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dualslam.recovery.relinker.ENOUGH", 50)
    asked, _ = tries_of_a_walk(100)
    late = [n for n in asked if n > 12]
    assert all(b >= 1.1 * a for a, b in zip([12, *late], late, strict=False))
    assert all(b <= 1.1 * a + 1 for a, b in zip([12, *late], late, strict=False))


def test_it_has_seen_enough_once_it_has_tried_with_so_many_healthy_keyframes() -> None:
    asked, ended = tries_of_a_walk(150)
    suspected = 200 - ONSET
    assert ended is not None
    assert ended == asked[-1]
    assert 40 <= ended - suspected <= 1.1 * (40 + suspected) + 1 - suspected


def test_a_keyframe_that_the_lost_map_does_not_hold_is_no_reason_to_try() -> None:
    old, new = holding(0, range(0, 50, 2)), holding(1, range(50))

    def never(old: Submap, new: Submap, onset: int | None) -> Failure:
        raise AssertionError

    assert not list(Relinker(new, {0: old}, {0: ONSET}, never, 4).attempts(11))


def test_over_keyframes_that_an_earlier_walk_has_left_it_tries_once() -> None:
    old, new = holding(0, range(100)), holding(1, range(88, 110))
    asked: list[int] = []

    def refuse(old: Submap, new: Submap, onset: int | None) -> Failure:
        asked.append(len(old.keyframes.keys() & new.keyframes.keys()))
        return Failure(FailureReason.AGREEMENT, "no")

    relinker = Relinker(new, {0: old}, {0: ONSET}, refuse, 4)
    for k in range(99, 84, -1):
        new.keyframes[k] = None  # type: ignore[assignment]
        list(relinker.attempts(k))
    assert asked == [12, 14]  # then at new ones, as ever


def test_a_map_that_is_torn_stays_so_once_all_is_there_that_is_asked_about_the_place() -> None:
    old, new = holding(0, range(200)), holding(1, range(200, 210))

    def refuse(old: Submap, new: Submap, onset: int | None) -> Failure:
        return LinkRefusal(FailureReason.DEFORMED, "torn", torn_at=198)

    relinker = Relinker(new, {0: old}, {0: ONSET}, refuse, 4)
    enough = []
    for k in range(199, 191, -1):
        new.keyframes[k] = None  # type: ignore[assignment]
        list(relinker.attempts(k))
        enough.append(relinker.has_seen_enough)
    n_beyond = np.arange(1, 9) - 2  # of 198 and later are two
    assert enough == (n_beyond >= GROUP).tolist()


def test_lost_maps_of_too_few_keyframes_are_hopeless_once_all_are_held() -> None:
    def never(old: Submap, new: Submap, onset: int | None) -> Failure:
        raise AssertionError

    for n in (3, 4):
        new = holding(1, range(n, 20))
        relinker = Relinker(new, {0: holding(0, range(n))}, {0: ONSET}, never, 4)
        assert not relinker.is_hopeless
        new.keyframes |= dict.fromkeys(range(n))  # type: ignore[arg-type]
        assert relinker.is_hopeless == (n < 4)
