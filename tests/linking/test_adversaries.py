"""Wrong links offered on purpose: none may be made. Where a part of the maps is right, a right link may."""

import itertools

import numpy as np
import pytest

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.noise_model import MAJORITY
from dualslam.core.types import Failure, FailureReason
from dualslam.linking import DescriptorMatcher, LinkEstimate, LinkRefusal, estimate, estimate_link
from dualslam.testing import adversaries
from dualslam.testing.link_worlds import Case, hamming, is_wrong, link_error

CONFIG = LinkingConfig()
MATCHER = DescriptorMatcher(hamming, 64.0)
LAYOUTS = ("street", "room")
S = range(8)

CASES = [
    *((adversaries.different_places, (layout, s), None) for layout, s in itertools.product(LAYOUTS, S)),
    *(
        (adversaries.mirrored, (layout, s, f), None)
        for layout, s, f in itertools.product(LAYOUTS, range(6), (False, True))
    ),
    *(
        (adversaries.stretched, (layout, s, a, p), None)
        for layout, (s, p), a in itertools.product(LAYOUTS, enumerate((5.0, 7.0, 10.0, 15.0, 20.0, 30.0)), range(3))
    ),
    *(
        (adversaries.two_scales, (layout, s, split, f), None)
        for layout, split, (s, f) in itertools.product(
            LAYOUTS, ("time", "depth", "random"), enumerate((1.1, 1.2, 1.35, 1.5, 0.9, 0.7))
        )
    ),
    *(
        (adversaries.repeated_texture, (layout, s, share, coherent), None)
        for layout, (s, share), coherent in itertools.product(
            LAYOUTS, enumerate((0.3, 0.45, 0.55, 0.7, 0.85, 1.0)), (False, True)
        )
    ),
    *(
        (adversaries.creeping_tail, (layout, s, oldest, rate), onset)
        for layout, (s, rate), oldest, onset in itertools.product(
            LAYOUTS, enumerate((0.02, 0.05, 0.1)), (10, 7, 5), (None, 36)
        )
    ),
    # The new map reaches to one frame past the onset, to it, or past it by less than is needed, or by enough.
    *(
        (adversaries.corrupted_tail, (layout, s, oldest, ties), onset)
        for layout, (s, oldest), (ties, onset) in itertools.product(
            LAYOUTS,
            enumerate((11, 10, 9, 8, 7, 6, 5, 4)),
            ((0.0, None), (0.0, 39), (0.3, None), (0.3, 30), (0.3, 39)),
        )
    ),
]


def label(case):
    make, arguments, onset = case
    return "-".join([make.__name__, *map(str, arguments), *([] if onset is None else [f"onset{onset}"])])


def one_of_each(cases):
    """Mark as slow all but one of each family and layout: the others are refused by the same gates as a rule."""
    seen = set()
    for case in cases:
        make, (layout, *_), onset = case
        again = (make, layout, onset is None) in seen
        seen.add((make, layout, onset is None))
        yield pytest.param(case, id=label(case), marks=[pytest.mark.slow] if again else [])


def offer(make, arguments, onset) -> tuple[Case, LinkEstimate | Failure]:
    case = make(*arguments)
    return case, estimate_link(case.old, case.new, CONFIG, np.random.default_rng(0), onset, MATCHER)


def test_there_are_enough():
    assert len(CASES) >= 200


@pytest.mark.parametrize("case", list(one_of_each(CASES)))
def test_no_wrong_link_is_made(case):
    offered, result = offer(*case)
    if isinstance(result, LinkEstimate):
        assert not is_wrong(offered, result.S_old_new), (link_error(offered, result.S_old_new), result.numbers)
    unsure = result.unsure if isinstance(result, LinkRefusal) else None
    assert unsure is None or abs(link_error(offered, unsure.S_old_new)[0]) < 3.0 * unsure.sigma_scale


@pytest.mark.parametrize("case", list(one_of_each(CASES[::7])))
def test_nor_if_the_tear_is_not_seen(case, monkeypatch):
    """Without the search for discontinuities in either map (but with the onset known) the other gates hold alone."""
    monkeypatch.setattr(estimate, "find_discontinuities", lambda *_: np.zeros(0, np.int64))
    make, arguments, onset = case
    if make is adversaries.corrupted_tail:
        onset = adversaries.ONSET_ID
    offered, result = offer(make, arguments, onset)
    if isinstance(result, LinkEstimate):
        assert not is_wrong(offered, result.S_old_new), (link_error(offered, result.S_old_new), result.numbers)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("make", ["different_places", "mirrored", "stretched", "all_repeated"])
def test_what_has_nothing_right_is_refused(make, layout):
    cases = {
        "different_places": lambda: adversaries.different_places(layout, 1),
        "mirrored": lambda: adversaries.mirrored(layout, 1, False),
        "stretched": lambda: adversaries.stretched(layout, 1, 2, 10.0),
        "all_repeated": lambda: adversaries.repeated_texture(layout, 1, 1.0, False),
    }
    case = cases[make]()
    assert isinstance(estimate_link(case.old, case.new, CONFIG, np.random.default_rng(0), None, MATCHER), Failure)


@pytest.mark.parametrize("ties", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2, 3))])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_reverse_tracking_over_a_corrupted_tail(layout, seed, ties):
    """A walk's link stands on the healthy part, and names the place where the tail begins."""
    for oldest in range(13, 3, -1):
        case, result = offer(adversaries.corrupted_tail, (layout, seed, oldest, ties), None)
        if isinstance(result, LinkEstimate):
            break
        assert result.reason in (FailureReason.NEEDS_OLDER_KEYFRAMES, FailureReason.SCALE), (oldest, result)
    link = result if isinstance(result, LinkEstimate) else result.unsure
    assert link is not None
    if isinstance(result, LinkEstimate):
        assert oldest >= 5  # soon after there are enough keyframes (from 6 on)
    else:  # keyframes on both sides of the tear agree
        assert link.numbers["handed_on"] < MAJORITY
    assert not is_wrong(case, link.S_old_new)
    first_wrong = adversaries.ONSET_ID + (3 if seed % 4 == 2 else 0)  # a change of scale leaves its own camera right
    assert link.agreeing_keyframes.max() < first_wrong
    assert link.change_point in (adversaries.ONSET_ID, adversaries.ONSET_ID + 3)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_change_point_is_found_without_a_tear(layout, monkeypatch):
    """Where two similarities fit the shared keyframes, the older one holds."""
    monkeypatch.setattr(estimate, "find_discontinuities", lambda *_: np.zeros(0, np.int64))
    for seed in range(4):
        case, result = offer(adversaries.corrupted_tail, (layout, seed, 4, 0.0), None)
        assert isinstance(result, LinkEstimate)
        assert not is_wrong(case, result.S_old_new)
        assert result.change_point in (adversaries.ONSET_ID, adversaries.ONSET_ID + 3)
