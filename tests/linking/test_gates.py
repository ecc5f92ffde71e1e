"""The parts that judge a similarity: runs along time, discontinuities, and each gate by itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FailureReason, FloatArray
from dualslam.linking import propose_correspondences, verify
from dualslam.linking.join_test import (
    PAIR_CHI2,
    PIXEL_CHI2,
    JoinGate,
    LinkEvidence,
    ambiguity_gate,
    drift_gate,
    motion_gate,
    parting_gate,
)
from dualslam.linking.motion import MIN_ASKED, Motion
from dualslam.linking.pairs import PairModel
from dualslam.linking.timeline import ask_keyframes, find_discontinuities, leading_run, measure_deformation
from dualslam.testing.adversaries import ONSET_ID, corrupted_tail
from dualslam.testing.link_worlds import Case, make_case

CONFIG = LinkingConfig()


def model_of(case: Case, deformation_sigma: float = CONFIG.deformation_sigma) -> PairModel:
    pairs = propose_correspondences(case.old, case.new)
    return PairModel(pairs, case.old, case.new, deformation_sigma)


def everything(model: PairModel, S) -> tuple[np.ndarray, np.ndarray]:
    """Inliers and keyframes, all that agree."""
    return model.mahalanobis2(S) < PAIR_CHI2, np.ones(len(model.pairs.keyframes), bool)


def test_gates_are_the_quantiles_that_they_say():
    assert pytest.approx(stats.chi2.ppf(0.99, 3), abs=1e-3) == PAIR_CHI2
    assert pytest.approx(stats.chi2.ppf(0.99, 2), abs=1e-3) == PIXEL_CHI2


@pytest.mark.parametrize(
    ("agrees", "length"),
    [("", 0), ("0111", 0), ("1111", 4), ("1100", 2), ("11011", 5), ("110", 2), ("110011", 2), ("1010100", 5)],
)
def test_leading_run(agrees, length):
    assert leading_run(np.array([c == "1" for c in agrees], bool), 1) == length


@pytest.mark.parametrize("layout", ["street", "room"])
@pytest.mark.parametrize("seed", range(4))
def test_healthy_maps_are_not_torn(layout, seed):
    case = make_case(layout, seed)
    for submap in (case.old, case.new):
        assert len(find_discontinuities(submap, min(submap.keyframes), max(submap.keyframes))) == 0


@pytest.mark.parametrize("ties", [0.0, 0.3])
@pytest.mark.parametrize("layout", ["street", "room"])
@pytest.mark.parametrize("seed", range(8))
def test_a_wrong_pose_tears_a_map_where_it_stands(layout, seed, ties):
    old = corrupted_tail(layout, seed, 6, ties).old
    discontinuities = find_discontinuities(old, min(old.keyframes), max(old.keyframes))
    assert len(discontinuities) >= 1
    # A change of scale about the first wrong camera leaves that camera right.
    assert discontinuities[0] in (ONSET_ID, ONSET_ID + 3)


def test_normal_equations_are_the_derivatives():
    case = make_case("room", 0)
    model = model_of(case)
    used = model.mahalanobis2(case.S_old_new) < PAIR_CHI2
    H, g = model.normal_equations(case.S_old_new, used)
    A = case.S_old_new[:3, :3]
    W = np.linalg.inv(model.covariance_old + A @ model.covariance_new @ A.T)[used]
    q = model.pairs.xyz_new[used] - model.centre_new

    def residual(x):
        change = sim3.exp(x)
        moved = q @ change[:3, :3].T + change[:3, 3] + model.centre_new
        return model.pairs.xyz_old[used] - sim3.act(case.S_old_new, moved)

    h = 1e-6
    J = np.stack([(residual(h * e) - residual(-h * e)) / (2 * h) for e in np.eye(7)], -1)
    r = residual(np.zeros(7))
    np.testing.assert_allclose(H, np.einsum("nia,nij,njb->ab", J, W, J), rtol=1e-5, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(g, -np.einsum("nia,nij,nj->a", J, W, r), rtol=1e-4, atol=1e-6 * np.abs(g).max())


def test_every_keyframe_of_a_true_link_agrees_and_none_of_a_wrong_one():
    case = make_case("street", 1)
    model = model_of(case)
    assert ask_keyframes(model, case.S_old_new, CONFIG).agrees.all()
    turned = case.S_old_new @ sim3.exp(np.r_[0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    larger = case.S_old_new @ sim3.exp(np.r_[np.zeros(6), 0.2])
    for wrong in (turned, larger):
        assert not ask_keyframes(model, wrong, CONFIG).agrees.any()


@pytest.mark.parametrize("bent", ["pairs", "path"])
def test_maps_whose_scales_part_along_time_are_less_known(bent):
    """The newer half of the pairs, or the cameras' path, is a tenth larger than the rest."""
    case = make_case("street", 1, drift=0.0)
    model = model_of(case)
    sound = measure_deformation(model, case.S_old_new, *everything(model, case.S_old_new), CONFIG)
    assert sound < CONFIG.deformation_sigma
    if bent == "pairs":
        c = model.pairs
        time = np.bincount(c.view_pair, c.view_keyframe) / np.bincount(c.view_pair)
        late = time > np.median(time)
        centre = np.median(c.xyz_new[late], axis=0)
        c.xyz_new[late] = centre + 1.1 * (c.xyz_new[late] - centre)
    else:
        centres = model.T_new_kf[:, :3, 3]
        centres[:] = centres.mean(0) + 1.1 * (centres - centres.mean(0))
    inliers, keyframes = np.ones(len(model.pairs), bool), np.ones(len(model.pairs.keyframes), bool)
    assert 0.03 < measure_deformation(model, case.S_old_new, inliers, keyframes, CONFIG) < 0.12


def test_sigma_gate_refuses_what_the_landmarks_do_not_fix():
    case = make_case("street", 0)
    model = model_of(case)
    small = np.diag(np.full(7, 1e-10))
    to_centre = sim3.adjoint(se3.from_parts(np.eye(3), model.centre_new))
    assert judged(model, case, small).is_sure
    for index, reason in ((6, FailureReason.SCALE), (0, FailureReason.DEGENERATE), (4, FailureReason.DEGENERATE)):
        C = small.copy()
        C[index, index] = 100.0 if index == 4 else 0.1**2
        refused = judged(model, case, to_centre @ C @ to_centre.T).refusal()
        assert refused is not None
        assert refused.reason is reason


@pytest.mark.parametrize(
    ("sigma", "accepted", "sure"), [(0.016, True, True), (0.04, True, False), (0.06, False, False)]
)
def test_a_scale_that_is_known_to_five_percent_joins_with_a_doubt(sigma: float, accepted: bool, sure: bool) -> None:
    case = make_case("street", 0)
    C = np.diag([1e-10] * 6 + [sigma**2])
    model = model_of(case)
    to_centre = sim3.adjoint(se3.from_parts(np.eye(3), model.centre_new))
    evidence = judged(model, case, to_centre @ C @ to_centre.T)
    assert (evidence.is_accepted, evidence.is_sure) == (accepted, sure)
    assert (evidence.refusal() is None, evidence.doubt() is None) == (accepted, sure)


NEARER = Motion(off_mu=1.0, usual_mu=1.0, n_asked=MIN_ASKED)


@pytest.mark.parametrize(
    ("gate", "refused_by"),
    [
        (parting_gate(-0.1, 0.1, 0.01, 5), set()),
        (parting_gate(-0.5, 0.1, 0.01, 5), {"log_scale"}),
        (parting_gate(0.1, 0.1, 0.09, 5), {"held_old"}),
        (parting_gate(0.1, np.inf, np.inf, 5), {"held_old"}),
        (drift_gate(0.05, 10.0, -0.2), set()),
        (drift_gate(0.4, 0.2, 0.003), {"drift"}),
        (drift_gate(0.1, 90.0, -np.log(4.0)), {"drift_rot_deg", "drift_log_scale"}),
        (ambiguity_gate(29, 60), set()),
        (ambiguity_gate(30, 60), {"second_support"}),
        (motion_gate(NEARER), set()),
        (motion_gate(replace(NEARER, off_mu=9.0)), {"leap_off"}),
        (motion_gate(replace(NEARER, off_mu=9.0, n_asked=MIN_ASKED - 1)), set()),
    ],
)
def test_a_join_is_refused_by_the_comparisons_that_decisions_show(gate: JoinGate, refused_by: set[str]) -> None:
    evidence = LinkEvidence((gate,))
    assert {each.name for each in evidence.comparisons if not each.passed} == refused_by
    assert (evidence.refusal() is not None) == bool(refused_by)


def judged(model: PairModel, case: Case, covariance: FloatArray) -> LinkEvidence:
    return verify.judge_overlap(verify.sigma_numbers(model, case.S_old_new, covariance), 4, CONFIG)
