"""Umeyama and the robust Sim(3): exactness, optimality, degeneracies, consistency of the covariance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from dualslam.core.geometry import se3, sim3
from dualslam.core.geometry.alignment import (
    COVARIANCE_INFLATION,
    Alignment,
    Sim3Estimate,
    estimate_sim3_robust,
    umeyama,
    umeyama_batch,
)
from dualslam.core.geometry.umeyama import MIN_SPREAD_RATIO
from dualslam.core.types import Failure, FailureReason
from dualslam.testing.two_maps import TwoMaps, two_maps

EXACT = 1e-10
MAX_LOG_SCALE = 0.015  # three sigmas of this scene
MAX_ROTATION_RAD = 0.006
DOF = 7


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the right tangent error (7,)."""
    return sim3.log(sim3.inverse(estimate) @ truth)


def align(src: np.ndarray, dst: np.ndarray, **options: object) -> Alignment:
    """Align and demand success."""
    result = umeyama(src, dst, **options)  # type: ignore[arg-type]
    assert isinstance(result, Alignment), result
    return result


def link(maps: TwoMaps, seed: int = 0, **options: object) -> Sim3Estimate | Failure:
    """Run the robust estimate on two maps."""
    rng = np.random.default_rng(seed)
    return estimate_sim3_robust(maps.src, maps.dst, maps.cov_src, maps.cov_dst, rng, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("n", [3, 4, 50])
def test_umeyama_is_exact(n: int) -> None:
    """With scale, and rigid where the scale is held."""
    rng = np.random.default_rng(n)
    S = sim3.exp([0.4, -2.0, 0.3, 1.0, 2.0, 3.0, 0.7])
    src = rng.normal(size=(n, 3))
    result = align(src, sim3.act(S, src))
    np.testing.assert_allclose(result.S_dst_src, S, atol=EXACT)
    assert result.rmse < EXACT
    T = se3.exp([0.4, -2.0, 0.3, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(align(src, se3.act(T, src), with_scale=False).S_dst_src, T, atol=EXACT)


@pytest.mark.parametrize("with_scale", [True, False])
def test_umeyama_is_the_weighted_minimum(with_scale: bool) -> None:
    """SciPy finds the same on noisy weighted points."""
    rng = np.random.default_rng(0)
    src, w = rng.normal(size=(20, 3)), rng.uniform(0.1, 2.0, 20)
    dst = sim3.act(sim3.exp([0.4, -1.0, 0.3, 1.0, 2.0, 3.0, 0.2]), src) + 0.2 * rng.normal(size=(20, 3))
    result = align(src, dst, weights=w, with_scale=with_scale)

    def residual(xi: np.ndarray) -> np.ndarray:
        xi = xi * np.array([1, 1, 1, 1, 1, 1, float(with_scale)])
        return (np.sqrt(w)[:, None] * (dst - sim3.act(result.S_dst_src @ sim3.exp(xi), src))).ravel()

    np.testing.assert_allclose(least_squares(residual, 0.01 * np.ones(7)).x[:6], 0.0, atol=1e-5)
    assert abs(result.rmse - np.sqrt((residual(np.zeros(7)) ** 2).sum() / w.sum())) < EXACT


def test_umeyama_never_reflects() -> None:
    """Mirrored points give a rotation all the same."""
    src = np.random.default_rng(1).normal(size=(10, 3))
    R = sim3.rotation(align(src, src * [1, 1, -1]).S_dst_src)
    assert np.linalg.det(R) > 0.999


@pytest.mark.parametrize(
    "src",
    [
        np.zeros((0, 3)),
        np.eye(3)[:2],
        np.full((5, 3), 7.3),
        np.outer(np.arange(6.0), [1.0, 2.0, 3.0]) + 5.0,
        np.outer(np.arange(6.0), [1.0, 2.0, 3.0]) + 1e-6 * np.eye(6)[:, :3],
    ],
    ids=["none", "two", "coincident", "collinear", "nearly collinear"],
)
def test_umeyama_refuses_degenerate_points(src: np.ndarray) -> None:
    """On either side."""
    other = np.random.default_rng(2).normal(size=src.shape)
    for a, b in ((src, other), (other, src), (src, src)):
        result = umeyama(a, b)
        assert isinstance(result, Failure)
        assert result.reason == FailureReason.DEGENERATE


def test_umeyama_accepts_a_nearly_straight_drive() -> None:
    """A kilometre with a metre of sideways motion is enough."""
    x = np.linspace(0, 1000, 200)
    src = np.stack([np.sin(x / 100), np.zeros_like(x), x], 1)
    S = sim3.exp([0.4, -2.0, 0.3, 1.0, 2.0, 3.0, 0.7])
    np.testing.assert_allclose(align(src, sim3.act(S, src)).S_dst_src, S, atol=1e-8)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize(("ratio", "spans"), [(0.5 * MIN_SPREAD_RATIO, False), (2.0 * MIN_SPREAD_RATIO, True)])
def test_what_is_too_straight_depends_on_no_unit(unit: float, ratio: float, spans: bool) -> None:
    src = unit * np.array([[-1.0, ratio, 0.0], [0.0, -2.0 * ratio, 0.0], [1.0, ratio, 0.0]]) / np.sqrt([1.0, 3.0, 1.0])
    assert bool(umeyama(src, src)) == spans
    assert umeyama_batch(src[None], src[None])[1].tolist() == [spans]


def test_umeyama_zero_weights_leave_points_out() -> None:
    """Also when too few remain."""
    src = np.random.default_rng(3).normal(size=(5, 3))
    dst = src.copy()
    dst[4] += 10.0
    np.testing.assert_allclose(align(src, dst, weights=np.array([1.0, 1, 1, 1, 0])).S_dst_src, np.eye(4), atol=EXACT)
    assert not umeyama(src, dst, np.array([1.0, 1, 0, 0, 0]))


def test_umeyama_batch_is_umeyama() -> None:
    """Triplet by triplet, and degenerate ones are marked."""
    rng = np.random.default_rng(4)
    src, dst = rng.normal(size=(2, 30, 3, 3))
    src[3, 2] = 2 * src[3, 1] - src[3, 0]
    dst[5] = dst[5, :1]
    S, valid = umeyama_batch(src, dst)
    assert np.flatnonzero(~valid).tolist() == [3, 5]
    for i in np.flatnonzero(valid):
        np.testing.assert_allclose(S[i], align(src[i], dst[i]).S_dst_src, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_robust_finds_the_link(seed: int, wrong: float) -> None:
    """Scale and rotation to a fraction of a percent; wrong matches out."""
    maps = two_maps(seed, wrong_ratio=wrong)
    result = link(maps, seed)
    assert isinstance(result, Sim3Estimate), result
    xi = error(result.S_dst_src, maps.S_dst_src)
    assert abs(xi[6]) < MAX_LOG_SCALE
    assert np.linalg.norm(xi[:3]) < MAX_ROTATION_RAD
    assert (result.inliers & maps.wrong).sum() <= 2
    assert (result.inliers & ~maps.wrong).sum() > 0.9 * (~maps.wrong).sum()


def test_robust_is_better_than_plain_alignment_of_the_true_matches() -> None:
    """The covariances are worth something: median error below half of that of unweighted alignment."""
    robust, plain = [], []
    for seed in range(20):
        maps = two_maps(seed)
        result = link(maps)
        assert isinstance(result, Sim3Estimate)
        robust.append(np.abs(error(result.S_dst_src, maps.S_dst_src))[[2, 6]])
        unweighted = align(maps.src[~maps.wrong], maps.dst[~maps.wrong]).S_dst_src
        plain.append(np.abs(error(unweighted, maps.S_dst_src))[[2, 6]])
    assert (np.median(robust, 0) < 0.5 * np.median(plain, 0)).all()


def test_robust_covariance_is_consistent() -> None:
    """Normalised squared errors average between bare and inflated degrees of freedom; chi2_per_dof is near 1."""
    squared, chi2 = [], []
    for seed in range(60):
        maps = two_maps(seed)
        result = link(maps)
        assert isinstance(result, Sim3Estimate)
        xi = error(result.S_dst_src, maps.S_dst_src)
        squared.append(xi @ np.linalg.solve(result.covariance, xi))
        chi2.append(result.chi2_per_dof)
    three_sigma = 3 * np.sqrt(2 * DOF / len(squared))
    assert DOF / COVARIANCE_INFLATION - three_sigma < np.mean(squared) < DOF + three_sigma
    assert 0.85 < np.mean(chi2) < 1.05


def test_robust_jacobian_by_its_optimum() -> None:
    """SciPy on the whitened residuals cannot leave the estimate by more than a tenth of its sigma."""
    maps = two_maps(1, wrong_ratio=0.0)
    result = link(maps, chi2_gate=1e9)
    assert isinstance(result, Sim3Estimate)
    A = result.S_dst_src[:3, :3]
    whiten = np.linalg.inv(np.linalg.cholesky(maps.cov_dst + A @ maps.cov_src @ A.T))

    def residual(xi: np.ndarray) -> np.ndarray:
        r = maps.dst - sim3.act(result.S_dst_src @ sim3.exp(xi), maps.src)
        return (whiten @ r[..., None]).ravel()

    best = least_squares(residual, np.zeros(7), loss="linear")
    numerical = np.linalg.inv(best.jac.T @ best.jac) * COVARIANCE_INFLATION
    np.testing.assert_allclose(result.covariance, numerical, rtol=0.05, atol=1e-3 * np.abs(numerical).max())
    assert (np.abs(best.x) < 0.3 * np.sqrt(np.diag(result.covariance))).all()


def test_robust_is_deterministic_and_equivariant() -> None:
    """Same seed, same bits; swapping the maps inverts the estimate."""
    maps = two_maps(2)
    a, b = link(maps, 5), link(maps, 5)
    assert isinstance(a, Sim3Estimate)
    assert isinstance(b, Sim3Estimate)
    np.testing.assert_array_equal(a.S_dst_src, b.S_dst_src)
    back = estimate_sim3_robust(maps.dst, maps.src, maps.cov_dst, maps.cov_src, np.random.default_rng(5))
    assert isinstance(back, Sim3Estimate)
    xi = error(a.S_dst_src, sim3.inverse(back.S_dst_src))
    assert xi @ np.linalg.solve(a.covariance, xi) < 1e-4


@pytest.mark.parametrize(
    "unknown", [np.nan, np.inf, 1e140 * np.eye(3), np.diag([1e-4, 1e-4, 1e14])], ids=["nan", "inf", "overflow", "ray"]
)
def test_unknown_covariances_are_never_inliers(unknown: object) -> None:
    """Their rows are left out and the masks keep their length."""
    maps = two_maps(3)
    maps.cov_src[40:45] = unknown
    result = link(maps)
    assert isinstance(result, Sim3Estimate)
    assert result.inliers.shape == (100,)
    assert not result.inliers[40:45].any()
    assert result.inliers[45:].sum() > 45


@pytest.mark.parametrize(
    ("case", "reasons"),
    [
        ("few", {FailureReason.TOO_FEW_MATCHES}),
        ("random", {FailureReason.TOO_FEW_INLIERS}),
        ("line", {FailureReason.DEGENERATE}),
        ("thick line", {FailureReason.DEGENERATE}),
        ("coincident", {FailureReason.DEGENERATE}),
        ("scale", {FailureReason.SCALE, FailureReason.DEGENERATE}),
    ],
)
def test_failures_have_reasons(case: str, reasons: set[FailureReason]) -> None:
    """No exception, no link."""
    maps = two_maps(4, wrong_ratio=0.0)
    rng = np.random.default_rng(0)
    options: dict[str, object] = {}
    if case == "few":
        maps = TwoMaps(maps.S_dst_src, *(getattr(maps, f.name)[:5] for f in dataclasses.fields(maps)[1:]))
    elif case == "random":
        maps.dst[:] = rng.normal(size=maps.dst.shape) * 20
    elif case in ("line", "thick line"):
        thickness = 0.0 if case == "line" else 0.01
        maps.src[:] = np.outer(np.linspace(2, 10, 100), [0.1, 0.2, 1.0]) + thickness * rng.normal(size=(100, 3))
        maps.dst[:] = sim3.act(maps.S_dst_src, maps.src)
        maps.cov_src[:], maps.cov_dst[:] = 0.04 * np.eye(3), 0.04 * np.eye(3)
    elif case == "coincident":
        maps.src[:], maps.dst[:] = 1.0, 2.0
    else:
        options["scale_bounds"] = (0.01, 0.5)
    result = link(maps, **options)
    assert isinstance(result, Failure)
    assert result.reason in reasons


def test_rotation_part_is_a_rotation() -> None:
    """After all steps R'R is still the identity to rounding."""
    result = link(two_maps(5))
    assert isinstance(result, Sim3Estimate)
    R = sim3.rotation(result.S_dst_src)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
