"""What of the admitted becomes factors: enough in each keyframe, spread, long tracks first, and what is in stays."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.selection import Candidates, choose_factors, spread_evenly
from dualslam.core.arrays import rank_in_runs

N_KEYFRAMES, N_LANDMARKS, WIDTH = 30, 800, 640.0


def tracks(seed: int = 0) -> Candidates:
    """Landmarks seen from 3 to 20 keyframes in a row, anywhere in the image."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, N_KEYFRAMES - 2, N_LANDMARKS)
    length = np.minimum(rng.integers(3, 21, N_LANDMARKS), N_KEYFRAMES - first)
    landmark = np.repeat(np.arange(N_LANDMARKS), length)
    kf = first[landmark] + rank_in_runs(landmark)
    order = np.lexsort((landmark, kf))
    uv = rng.uniform(0, [WIDTH, 480.0], (N_LANDMARKS, 2))
    return Candidates(kf[order], landmark[order], uv[landmark[order]], WIDTH)


def choose(c, admitted=None, factors=None, per_keyframe=60, max_views=6, min_views=3):
    n = len(c.kf)
    return choose_factors(
        c,
        np.ones(n, bool) if admitted is None else admitted,
        np.zeros(n, bool) if factors is None else factors,
        np.arange(N_KEYFRAMES),
        N_LANDMARKS,
        per_keyframe,
        max_views,
        min_views,
    )


def test_each_keyframe_has_enough_and_each_landmark_views_enough() -> None:
    c = tracks()
    chosen = choose(c)
    assert (np.bincount(c.kf[chosen]) >= np.minimum(60, np.bincount(c.kf))).all()
    assert chosen.mean() < 0.5
    views = np.bincount(c.landmark[chosen], minlength=N_LANDMARKS)
    assert views[views > 0].min() >= 3


@pytest.mark.parametrize("most", [1_000, 1 << 30], ids=["as good as no limit", "none"])
def test_what_is_short_is_taken_whole(most: int) -> None:
    c = tracks()
    assert choose(c, per_keyframe=10_000, max_views=most).all()
    known = np.random.default_rng(2).random(len(c.kf)) < 0.5
    enough = np.bincount(c.landmark[known], minlength=N_LANDMARKS) >= 3
    np.testing.assert_array_equal(
        choose(c, admitted=known, per_keyframe=most, max_views=most), known & enough[c.landmark]
    )


def test_long_tracks_come_first_and_bring_views_over_their_length() -> None:
    c = tracks()
    chosen = choose(c)
    n = np.bincount(c.landmark)
    is_in = np.bincount(c.landmark[chosen], minlength=N_LANDMARKS) > 0
    assert n[is_in].mean() > n[~is_in].mean() + 2
    for j in np.flatnonzero(is_in & (n >= 12))[:20]:
        all_of, of = c.kf[c.landmark == j], c.kf[(c.landmark == j) & chosen]
        assert of.max() - of.min() > 0.7 * (all_of.max() - all_of.min())


def test_observations_are_spread_over_the_image() -> None:
    rng = np.random.default_rng(1)
    c = tracks()
    # Nine in ten crowd in one corner.
    crowded = (rng.random(N_LANDMARKS) < 0.9)[c.landmark]
    uv = np.where(crowded[:, None], c.uv_px * 0.1, c.uv_px)
    c = Candidates(c.kf, c.landmark, uv, WIDTH)
    chosen = choose(c, per_keyframe=30)
    assert crowded[chosen].mean() < 0.85 * crowded.mean()


def test_what_was_chosen_stays_while_the_map_grows() -> None:
    c = tracks()
    factors = np.zeros(len(c.kf), bool)
    for newest in range(3, N_KEYFRAMES):
        now = choose(c, admitted=c.kf <= newest, factors=factors)
        assert not (factors & ~now).any()
        n_able = np.bincount(c.landmark[c.kf <= newest], minlength=N_LANDMARKS)[c.landmark[c.kf == newest]]
        assert np.count_nonzero(now & (c.kf == newest)) >= min(60, np.count_nonzero(n_able >= 3))
        factors = now


def test_lost_views_are_given_back_and_a_landmark_left_with_one_goes() -> None:
    c = tracks()
    factors = choose(c)
    views = np.bincount(c.landmark[factors], minlength=N_LANDMARKS)
    many, few = np.flatnonzero((views >= 4) & (np.bincount(c.landmark) > 10))[:2]
    admitted = np.ones(len(c.kf), bool)
    admitted[np.flatnonzero(factors & (c.landmark == many))[1:]] = False
    admitted[np.flatnonzero(c.landmark == few)[1:]] = False
    now = choose(c, admitted, factors)
    assert not (now & ~admitted).any()
    assert np.count_nonzero(now & (c.landmark == many)) >= 3
    assert not now[c.landmark == few].any()


def test_few_that_bridge_a_gap_are_in_even_when_all_is_chosen_anew() -> None:
    """Keyframes 0-14 and 15-29 share eight landmarks; either side has more than enough of its own."""
    rng = np.random.default_rng(2)
    kf, landmark = [], []
    for j in range(N_LANDMARKS):
        ks = rng.permutation(np.arange(15) + 15 * (j % 2))[:5] if j >= 8 else np.array([3, 11, 17, 26])
        kf += ks.tolist()
        landmark += [j] * len(ks)
    order = np.lexsort((landmark, kf))
    c = Candidates(np.array(kf)[order], np.array(landmark)[order], rng.uniform(0, [WIDTH, 480.0], (len(kf), 2)), WIDTH)
    chosen = choose(c)
    assert np.bincount(c.landmark[chosen], minlength=N_LANDMARKS)[:8].min() == 4


@pytest.mark.parametrize(("n", "quota"), [(1, 1), (5, 2), (20, 6), (4, 9), (7, 7)])
def test_evenly_spread(n: int, quota: int) -> None:
    taken = np.flatnonzero(spread_evenly(np.arange(n), np.full(n, n), np.full(n, quota)))
    assert len(taken) == min(n, quota)
    assert taken[0] == 0
    assert taken[-1] == n - 1
    if len(taken) > 1:
        assert np.ptp(np.diff(taken)) <= 1
