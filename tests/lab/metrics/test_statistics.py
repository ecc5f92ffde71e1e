"""Intervals against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from dualslam.lab.metrics.statistics import failure_reduction, wilson_interval


@pytest.mark.parametrize(("k", "n"), [(0, 10), (1, 10), (5, 10), (10, 10), (28, 110), (18, 610), (1, 1)])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_wilson_is_scipys(k: int, n: int, level: float) -> None:
    ours = wilson_interval(k, n, level)
    theirs = stats.binomtest(k, n).proportion_ci(level, method="wilson")
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_without_trials_nothing_is_known() -> None:
    interval = wilson_interval(0, 0)
    assert (interval.low, interval.high) == (0.0, 1.0)
    with pytest.raises(ValueError, match="no rate"):
        wilson_interval(3, 2)


def test_the_papers_reduction() -> None:
    # KITTI and TUM-Mono: 154 failures of the base, 18 of Dual+.
    assert failure_reduction([28, 126], [6, 12]).value == pytest.approx(0.883, abs=5e-4)


def test_the_interval_is_scipys_bootstrap() -> None:
    rng = np.random.default_rng(1)
    base = rng.integers(0, 11, 40)
    new = rng.binomial(base, 0.2)
    ours = failure_reduction(base, new, seed=3)
    assert ours.interval is not None
    assert ours.undefined == 0
    theirs = stats.bootstrap(
        (base, new),
        lambda b, n, axis: 1 - n.sum(axis=axis) / b.sum(axis=axis),
        paired=True,
        vectorized=True,
        method="percentile",
        n_resamples=10_000,
        rng=np.random.default_rng(5),
    ).confidence_interval
    # Two bootstraps of 10,000 differ by their own noise.
    assert (ours.interval.low, ours.interval.high) == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_clusters_that_fail_together_widen_the_interval() -> None:
    """Eight failures in two clusters say less than one in each of eight."""
    spread = failure_reduction([4] * 20, [1] * 8 + [0] * 12).interval
    lumped = failure_reduction([4] * 20, [4] * 2 + [0] * 18).interval
    assert spread is not None
    assert lumped is not None
    assert lumped.high - lumped.low > spread.high - spread.low
    # ... and resamples in which nothing failed are told.
    assert failure_reduction([5] * 5 + [0] * 15, [0] * 20).undefined == pytest.approx(0.75**20, abs=0.003)


def test_few_clusters_have_no_interval() -> None:
    four = failure_reduction([5] * 4 + [0] * 16, [1] * 4 + [0] * 16)
    assert (four.value, four.interval) == (0.8, None)
    assert failure_reduction([5] * 5 + [0] * 15, [1] * 5 + [0] * 15).interval is not None


def test_no_failures_no_reduction() -> None:
    assert failure_reduction([0, 0], [0, 1]).value is None
    assert failure_reduction([2, 0], [3, 1]).value == -1.0


def test_the_interval_covers_the_truth() -> None:
    """Of 200 benches with a known reduction of 70 %, about 95 in 100 intervals hold it."""
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(200):
        hardness = rng.beta(1.5, 1.5, 40)
        base = rng.binomial(10, hardness)
        new = rng.binomial(10, 0.3 * hardness)
        interval = failure_reduction(base, new, resamples=2000).interval
        assert interval is not None
        hits += interval.low <= 0.7 <= interval.high
    assert 0.88 < hits / 200 <= 1.0
