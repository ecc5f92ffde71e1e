"""Scores of the reasons of a verdict, against the thresholds that the verdict has."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.run.audit_scores import worst_disagreement
from dualslam.system.audit.photometric import MIN_AGREEMENT, Sample, disagreeing_stretches


def samples(agreement: list[float], submap: int = 0) -> list[Sample]:
    return [Sample(i, 0.2 * i, submap, a) for i, a in enumerate(agreement)]


def test_the_worst_stretch_counts_not_the_worst_sample() -> None:
    made = samples([0.9, 0.0, 0.9, 0.5, 0.4, 0.3, 0.6, 0.9])
    assert worst_disagreement(made) == pytest.approx(0.5), "of 0.5, 0.4, 0.3"
    assert worst_disagreement(samples([0.1, 0.1]) + samples([0.1, 0.1], submap=1)) == 0.0


def test_a_score_above_the_threshold_is_a_stretch_that_the_verdict_finds() -> None:
    rng = np.random.default_rng(4)
    found = 0
    for _ in range(200):
        made = samples(rng.uniform(0, 0.45, 8).tolist())
        is_found = bool(disagreeing_stretches(made))
        assert is_found == (worst_disagreement(made) > 1 - MIN_AGREEMENT)
        found += is_found
    assert 20 < found < 180
