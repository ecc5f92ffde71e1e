"""Links between healthy maps: how often they are made, and how good they are."""

import numpy as np
import pytest

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FailureReason
from dualslam.linking import DescriptorMatcher, LinkEstimate, estimate_link
from dualslam.testing.link_worlds import FRAME_STEP, Case, hamming, link_error, make_bent_case, make_case

CONFIG = LinkingConfig()
MATCHER = DescriptorMatcher(hamming, 64.0)
N_SEEDS = 10
SCALE_MEDIAN, SCALE_WORST = 0.01, 0.03
ROTATION_MEDIAN_DEG, ROTATION_WORST_DEG = 0.2, 0.6
POSITION_WORST = 0.02  # of the overlap's extent


def link(case: Case, onset: int | None = None, config: LinkingConfig = CONFIG) -> LinkEstimate | Failure:
    return estimate_link(case.old, case.new, config, np.random.default_rng(0), onset, MATCHER)


def nees(case: Case, estimate: LinkEstimate) -> float:
    xi = sim3.log(sim3.inverse(estimate.S_old_new) @ case.S_old_new)
    return float(xi @ np.linalg.solve(estimate.covariance, xi))


@pytest.mark.parametrize("drift", [0.0, 0.002], ids=["pixel-noise", "drift"])
def test_healthy_maps_are_linked_accurately(drift):
    cases = [make_case(layout, seed, drift=drift) for layout in ("street", "room") for seed in range(N_SEEDS)]
    estimates = [link(case) for case in cases]
    made = [(case, e) for case, e in zip(cases, estimates, strict=True) if isinstance(e, LinkEstimate)]
    assert len(made) > 0.95 * len(cases), [e for e in estimates if not e]
    scale, angle, position = np.array([link_error(case, e.S_old_new) for case, e in made]).T
    assert np.median(scale) < SCALE_MEDIAN
    assert scale.max() < SCALE_WORST
    assert np.median(angle) < ROTATION_MEDIAN_DEG
    assert angle.max() < ROTATION_WORST_DEG
    assert position.max() < POSITION_WORST
    # Consistent: 7 is expected of a NEES with 7 degrees of freedom, less of a covariance that is on the safe side.
    assert np.mean([nees(case, e) for case, e in made]) < 7.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("layout", ["street", "room"])
def test_smallest_overlap(layout, seed):
    """As many shared keyframes as are needed make a link, one less asks for more."""
    n = CONFIG.min_keyframes
    case = make_case(layout, seed, old_frames=range(12), new_frames=range(12 - n, 24))
    estimate = link(case)
    assert isinstance(estimate, LinkEstimate)
    assert list(estimate.agreeing_keyframes) == [FRAME_STEP * f for f in range(12 - n, 12)]
    assert np.all(np.array(link_error(case, estimate.S_old_new)) < [SCALE_WORST, ROTATION_WORST_DEG, POSITION_WORST])
    shorter = make_case(layout, seed, old_frames=range(11), new_frames=range(12 - n, 24))
    refused = link(shorter)
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.NEEDS_OLDER_KEYFRAMES


def test_what_a_link_carries():
    case = make_case("street", 0)
    estimate = link(case)
    assert isinstance(estimate, LinkEstimate)
    assert estimate.change_point is None
    assert estimate.suspected_onset is None
    assert 0 < estimate.n_inliers <= estimate.n_matches
    assert len(np.unique(estimate.landmark_pairs[:, 0])) == len(np.unique(estimate.landmark_pairs[:, 1]))
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0
    moved = sim3.act(estimate.S_old_new, case.new.landmarks["xyz_mu"][estimate.landmark_pairs[:, 1]])
    off = np.linalg.norm(moved - case.old.landmarks["xyz_mu"][estimate.landmark_pairs[:, 0]], axis=1)
    assert np.median(off) < 0.05 * estimate.numbers["depth_mu"]
    assert all(isinstance(v, float) for v in estimate.numbers.values())
    assert {"scale", "sigma_scale", "sigma_rot_deg", "sigma_trans_mu", "chi2"} <= estimate.numbers.keys()


def test_same_seed_same_link_bit_for_bit():
    a, b = link(make_case("room", 1)), link(make_case("room", 1))
    assert isinstance(a, LinkEstimate)
    assert isinstance(b, LinkEstimate)
    assert np.array_equal(a.S_old_new, b.S_old_new)
    assert np.array_equal(a.covariance, b.covariance)


def test_link_does_not_depend_on_the_gauges():
    """The same maps in other frames and units: the same link, expressed in those."""
    from dualslam.testing.link_worlds import random_gauge, regauge

    case = make_case("street", 2)
    before = link(case)
    G_old, G_new = random_gauge(np.random.default_rng(1), 50.0), random_gauge(np.random.default_rng(2), 50.0)
    regauge(case.old, G_old)
    regauge(case.new, G_new)
    after = link(case)
    assert isinstance(before, LinkEstimate)
    assert isinstance(after, LinkEstimate)
    expected = G_old @ before.S_old_new @ sim3.inverse(G_new)
    E = sim3.log(sim3.inverse(expected) @ after.S_old_new)
    assert abs(E[6]) < 1e-3
    assert np.linalg.norm(E[:3]) < 1e-3


def test_maps_without_common_keyframes():
    case = make_case("street", 0, old_frames=range(8), new_frames=range(10, 20))
    refused = link(case)
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.TOO_FEW_MATCHES


def test_outliers_and_noise_do_not_keep_maps_apart():
    cases = [make_case(layout, seed, outliers=0.15, tracked=0.6) for layout in ("street", "room") for seed in range(5)]
    estimates = [link(case) for case in cases]
    assert all(isinstance(e, LinkEstimate) for e in estimates), estimates
    errors = [link_error(c, e.S_old_new) for c, e in zip(cases, estimates, strict=True) if isinstance(e, LinkEstimate)]
    assert np.median(errors, axis=0)[0] < SCALE_MEDIAN
    assert np.max(errors, axis=0)[1] < ROTATION_WORST_DEG


@pytest.mark.parametrize("seed", range(3))
def test_maps_that_bend_apart_fix_no_scale(seed):
    """The oldest of 22 shared keyframes drift in the new map."""
    refused = link(make_bent_case("street", seed, n_bent=8, stretch=1.02))
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.SCALE
