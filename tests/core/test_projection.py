"""Projection Jacobians and the robust refinement of a pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import (
    PoseEstimate,
    project_points,
    projection_jacobians,
    refine_pose,
    settle_poses,
)
from dualslam.core.types import Failure, FailureReason
from dualslam.testing.two_maps import K, two_views

NUMERICAL_PX = 1e-4
CHI2_6DOF_MEAN = 6.0
MAX_ROTATION_RAD = 1e-3
MAX_TRANSLATION = 0.01
START = np.array([0.02, -0.02, 0.01, 0.1, 0.05, -0.15])


def noisy(seed: int, outliers: float, n: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (T_cam_w, xyz, uv, outlier mask) with one pixel of noise."""
    rng = np.random.default_rng(seed + 1000)
    views = two_views(seed, n)
    wrong = rng.random(n) < outliers
    uv = views.uv_a + rng.normal(size=(n, 2))
    uv[wrong] += rng.uniform(-80, 80, (int(wrong.sum()), 2))
    return se3.inverse(views.T_w_a), views.xyz, uv, wrong


def refine(T0: np.ndarray, xyz: np.ndarray, uv: np.ndarray, **options: object) -> PoseEstimate:
    """Refine with unit sigma and demand success."""
    estimate = refine_pose(K, T0, xyz, uv, np.ones(len(xyz)), **options)  # type: ignore[arg-type]
    assert isinstance(estimate, PoseEstimate), estimate
    return estimate


def test_jacobians_match_numerical_ones() -> None:
    """By the left perturbation of the pose, and by the point."""
    views = two_views(0, 20)
    T, h = se3.inverse(views.T_w_a), 1e-6
    J_pose, J_point = projection_jacobians(K, T, views.xyz)
    for i in range(6):
        d = np.eye(6)[i] * h
        numerical = project_points(K, se3.exp(d) @ T, views.xyz)[0] - project_points(K, se3.exp(-d) @ T, views.xyz)[0]
        np.testing.assert_allclose(J_pose[:, :, i], numerical / (2 * h), atol=NUMERICAL_PX)
    for i in range(3):
        d = np.eye(3)[i] * h
        numerical = project_points(K, T, views.xyz + d)[0] - project_points(K, T, views.xyz - d)[0]
        np.testing.assert_allclose(J_point[:, :, i], numerical / (2 * h), atol=NUMERICAL_PX)


def test_points_behind_project_to_nan() -> None:
    """Depth keeps its sign."""
    uv, depth = project_points(K, np.eye(4), np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(uv[0]).all()
    np.testing.assert_array_equal(uv[1], K[:2, 2])
    np.testing.assert_array_equal(depth, [-2.0, 2.0])


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_pose_survives_outliers(outliers: float, seed: int) -> None:
    """From a motion model's error to the accuracy of the pixels."""
    T, xyz, uv, wrong = noisy(seed, outliers)
    estimate = refine(se3.exp(START) @ T, xyz, uv)
    error = se3.log(estimate.T_cam_w @ se3.inverse(T))
    assert np.linalg.norm(error[:3]) < MAX_ROTATION_RAD
    assert np.linalg.norm(error[3:]) < MAX_TRANSLATION
    assert (estimate.inliers & ~wrong).sum() > 0.9 * (~wrong).sum()
    assert (estimate.inliers & wrong).sum() <= 0.05 * max(wrong.sum(), 1)
    assert estimate.n_inliers == estimate.inliers.sum()
    np.testing.assert_array_equal(estimate.inliers, estimate.chi2 < 5.991)


def test_pose_is_the_minimum_that_scipy_finds() -> None:
    """Without outliers and gates: SciPy's least squares on the same residuals."""
    T, xyz, uv, _ = noisy(5, 0.0, 100)
    estimate = refine(se3.exp(START) @ T, xyz, uv, chi2_gate=1e9, tolerance=1e-16)

    def residual(xi: np.ndarray) -> np.ndarray:
        return (project_points(K, se3.exp(xi) @ T, xyz)[0] - uv).ravel()

    theirs = se3.exp(least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x) @ T
    np.testing.assert_allclose(estimate.T_cam_w, theirs, atol=1e-8)
    J = projection_jacobians(K, theirs, xyz)[0].reshape(-1, 6)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(J.T @ J), rtol=1e-5, atol=1e-14)


def test_covariance_is_consistent() -> None:
    """Over many draws the normalised squared error is chi-square with 6 degrees of freedom."""
    errors = []
    for seed in range(150):
        T, xyz, uv, _ = noisy(seed, 0.0, 60)
        estimate = refine(T, xyz, uv, chi2_gate=1e9)
        xi = se3.log(T @ se3.inverse(estimate.T_cam_w))
        errors.append(xi @ np.linalg.solve(estimate.covariance, xi))
    three_sigma = 3 * np.sqrt(2 * CHI2_6DOF_MEAN / len(errors))
    assert abs(np.mean(errors) - CHI2_6DOF_MEAN) < three_sigma


def test_sigma_weighs_points() -> None:
    """Points declared bad do not pull: the pose follows those declared good."""
    T, xyz, uv, _ = noisy(3, 0.0)
    uv[::2] += 3.0
    sigma = np.where(np.arange(len(xyz)) % 2 == 0, 100.0, 1.0)
    estimate = refine_pose(K, T, xyz, uv, sigma)
    good = refine_pose(K, T, xyz[1::2], uv[1::2], sigma[1::2])
    assert isinstance(estimate, PoseEstimate)
    assert isinstance(good, PoseEstimate)
    error = se3.log(estimate.T_cam_w @ se3.inverse(good.T_cam_w))
    assert np.linalg.norm(error) < 1e-3
    assert np.linalg.norm(error) < 0.2 * np.sqrt(np.trace(good.covariance))


def test_prior_holds_the_pose() -> None:
    """A strong prior keeps the start, a weak one changes nothing; a prior makes three points enough."""
    T, xyz, uv, _ = noisy(2, 0.0)
    start = se3.exp(START * 0.1) @ T
    strong = refine(start, xyz, uv, prior_information=np.eye(6) * 1e14, chi2_gate=1e9)
    np.testing.assert_allclose(strong.T_cam_w, start, atol=1e-6)
    weak = refine(start, xyz, uv, prior_information=np.eye(6) * 1e-9)
    np.testing.assert_allclose(weak.T_cam_w, refine(start, xyz, uv).T_cam_w, atol=1e-7)
    few = refine(start, xyz[:2], uv[:2], prior_information=np.eye(6), min_inliers=2, chi2_gate=1e3)
    assert np.isfinite(few.covariance).all()


def test_outliers_come_back_between_rounds() -> None:
    """From a start where fewer than a tenth of the points pass the gate, nearly all pass in the end."""
    T, xyz, uv, _ = noisy(7, 0.0)
    T0 = se3.exp(START * 2) @ T
    at_start = ((project_points(K, T0, xyz)[0] - uv) ** 2).sum(1) < 5.991
    assert at_start.mean() < 0.1
    assert refine(T0, xyz, uv).n_inliers > 0.9 * len(xyz)


def test_points_behind_the_camera_are_outliers() -> None:
    """They get an infinite chi-square and do not disturb."""
    T, xyz, uv, _ = noisy(4, 0.0)
    behind = se3.act(se3.inverse(T), np.array([[0.0, 0.0, -5.0]] * 30))
    estimate = refine(T, np.vstack([xyz, behind]), np.vstack([uv, np.tile(K[:2, 2], (30, 1))]))
    assert np.isinf(estimate.chi2[-30:]).all()
    assert not estimate.inliers[-30:].any()
    np.testing.assert_allclose(estimate.T_cam_w, refine(T, xyz, uv).T_cam_w, atol=1e-9)


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("few", FailureReason.TOO_FEW_MATCHES),
        ("noise", FailureReason.TOO_FEW_INLIERS),
        ("one point", FailureReason.DEGENERATE),
        ("behind", FailureReason.DEGENERATE),
    ],
)
def test_failures_have_reasons(case: str, reason: FailureReason) -> None:
    """No exception, no pose."""
    T, xyz, uv, _ = noisy(6, 0.0, 50)
    if case == "few":
        xyz, uv = xyz[:3], uv[:3]
    elif case == "noise":
        uv = np.random.default_rng(0).uniform(0, 1200, uv.shape)
    elif case == "one point":
        xyz, uv = np.tile(xyz[0], (50, 1)), np.tile(uv[0], (50, 1))
    else:
        xyz = se3.act(se3.inverse(T), -np.abs(xyz) - 1.0)
    failure = refine_pose(K, T, xyz, uv, np.ones(len(xyz)), min_inliers=12)
    assert isinstance(failure, Failure)
    assert failure.reason == reason
    assert not failure


def test_points_without_a_say_are_judged_and_move_nothing() -> None:
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), np.full(60, 1.0) + rng.uniform(-0.05, 0.05, 60)])
    xyz[:12] *= 0.08  # right before the camera
    T_true = se3.exp(np.array([0.0, 0.0, 0.0, -0.01, 0.0, 0.0]))
    uv, _ = project_points(K, T_true, xyz)
    uv[:12], _ = project_points(K, np.eye(4), xyz[:12])  # these say that it did not move
    counted = np.arange(60) >= 12
    kept, held = (refine_pose(K, np.eye(4), xyz, uv, np.full(60, 0.5), counted=c) for c in (counted, None))
    assert kept
    assert held
    np.testing.assert_allclose(kept.T_cam_w, T_true, atol=1e-6)
    np.testing.assert_array_equal(kept.inliers, counted)
    assert np.linalg.norm(held.T_cam_w[:3, 3]) < 0.005, "with a say they hold the camera, and it turns"


def settle(
    T_cam_w: np.ndarray, xyz: np.ndarray, uv: np.ndarray, shape: float = 4.0, min_inliers: int = 6
) -> np.ndarray:
    """Settle one pose beside two others: one that has no points, and one that has them all, too."""
    n = len(xyz)
    start, frame = np.array([T_cam_w, np.eye(4), T_cam_w]), np.repeat([0, 2], n)
    what = np.tile(xyz, (2, 1)), np.tile(uv, (2, 1)), np.ones(2 * n)
    settled = settle_poses(K, start, frame, *what, shape=shape, min_inliers=min_inliers)
    np.testing.assert_array_equal(settled[0], settled[2])
    assert np.isnan(settled[1]).all()
    return settled[0]


def test_a_pose_that_is_nearly_right_is_settled_at_the_optimum_of_the_inliers() -> None:
    """A third of the points are off by up to 80 pixels: none of them pulls."""
    T, xyz, uv, wrong = noisy(3, 0.33)
    inliers = refine(T, xyz[~wrong], uv[~wrong]).T_cam_w
    settled = settle(se3.exp(0.1 * START) @ T, xyz, uv)
    assert np.isfinite(settled).all()
    off, noise = (np.abs(se3.log(se3.inverse(T_a) @ T_b)).max() for T_a, T_b in ((inliers, settled), (T, inliers)))
    assert off < 0.5 * noise
    np.testing.assert_allclose(settled[:3, :3] @ settled[:3, :3].T, np.eye(3), atol=1e-12)


def test_too_few_points_that_agree_settle_nothing() -> None:
    T, xyz, uv, wrong = noisy(4, 0.33)
    n = int(np.count_nonzero(~wrong))
    assert np.isnan(settle(T, xyz, uv, min_inliers=n + 1)).all()
    assert np.isnan(settle(T, xyz[:1], uv[:1])).all()


@pytest.mark.parametrize("seed", range(5))
def test_points_in_a_row_settle_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([np.linspace(-1, 1, 30), np.zeros(30), np.full(30, 5.0)]) + rng.normal(0, 1e-6, (30, 3))
    uv = project_points(K, np.eye(4), xyz)[0] + rng.normal(size=(30, 2))
    assert np.isnan(settle(np.eye(4), xyz, uv)).all()


@pytest.mark.parametrize("seed", range(40))
def test_a_few_near_points_hold_the_position_from_afar(seed: int) -> None:
    """Most points are far and outliers abound: a loss that is tight from the start forgets the near ones."""
    rng = np.random.default_rng(seed)
    z = np.where(np.arange(80) < 24, rng.uniform(0.6, 1.5, 80), rng.uniform(20, 40, 80))
    xyz = np.column_stack([rng.uniform(-0.4, 0.4, (80, 2)) * z[:, None], z])
    uv = project_points(K, np.eye(4), xyz)[0] + rng.normal(0, 0.35, (80, 2))
    wrong = rng.random(80) < 0.2
    uv[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
    aside = rng.normal(size=3)
    start = se3.from_parts(np.eye(3), 0.08 * aside / np.linalg.norm(aside))
    settled = settle(start, xyz, uv, shape=1.4, min_inliers=25)
    assert np.isfinite(settled).all()
    assert np.linalg.norm(settled[:3, 3]) < 0.01
