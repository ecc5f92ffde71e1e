"""Bundle adjustment by the Schur complement, against GTSAM's: the same optimum under both losses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
import pytest

from dualslam.backend import convert, schur
from dualslam.backend.calibration_bundle import CorrectedLens, _HeldLens
from dualslam.backend.point_refinement import huber
from dualslam.backend.schur import Loss, System, geman_mcclure, optimise
from dualslam.backend.solver import optimise_batch
from dualslam.backend.ties import insert_projections, pose_prior
from dualslam.core.bundle import BundleProblem
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, so3
from dualslam.testing.graph_scene import Feeder, make_scene, pose_errors

SHAPE, ITERATIONS, TOLERANCE = 2.0, 20, 1e-9


def problem_of(n: int, seed: int = 0) -> BundleProblem:
    """A corridor with outliers, one pose fixed."""
    scene = make_scene(n, 100, 0.5, seed)
    feeder = Feeder(scene, seed, point_noise=0.02)
    for k in range(n):
        feeder.add(k, exact=True)
    submap, rng = feeder.submap, np.random.default_rng(seed)
    obs = submap.observations
    uv, sigma = submap.observed_pixels(np.arange(len(obs)))
    uv[rng.random(len(uv)) < 0.05] += [6.0, -4.0]
    T = scene.T_true.copy()
    T[1:, :3, 3] += 0.005 * rng.normal(size=(n - 1, 3))
    views = np.bincount(obs["landmark"])
    kept = views[obs["landmark"]] >= 3
    number = np.cumsum(views >= 3) - 1
    xyz = submap.landmarks["xyz_mu"][: len(views)][views >= 3]
    return BundleProblem(
        submap.K, T, np.arange(n) == 0, xyz, obs["kf"][kept], number[obs["landmark"][kept]], uv[kept], sigma[kept]
    )


def by_gtsam(p: BundleProblem, loss: Any) -> float:
    """The cost at GTSAM's optimum."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def noise(sigma: float) -> gtsam.noiseModel.Robust:
        return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, sigma))

    poses, points = np.arange(len(p.T_submap_kf)), np.arange(len(p.xyz_mu))
    graph.push_back(pose_prior(0, p.T_submap_kf[0]))
    insert_projections(graph, p.kf, p.point, p.uv_px, p.sigma_px, convert.to_cal3_s2(p.K), noise)  # type: ignore[arg-type]
    convert.insert_poses(values, poses, p.T_submap_kf)
    convert.insert_points(values, points, p.xyz_mu)
    return optimise_batch(graph, values, poses, points, ITERATIONS, TOLERANCE).cost_after


ESTIMATORS = gtsam.noiseModel.mEstimator


@pytest.mark.parametrize(
    ("loss", "theirs"),
    [
        (partial(huber, k=SHAPE), ESTIMATORS.Huber.Create(SHAPE)),
        (partial(geman_mcclure, shape=SHAPE), ESTIMATORS.GemanMcClure.Create(SHAPE)),
    ],
)
def test_the_optimum_is_gtsam_s(loss: Loss, theirs: Any) -> None:
    problem = problem_of(12)
    found = optimise(problem, loss, ITERATIONS, TOLERANCE)
    assert found.cost_after < 0.5 * found.cost_before
    assert found.cost_after == pytest.approx(by_gtsam(problem, theirs), rel=1e-4)
    np.testing.assert_array_equal(found.state.T_submap_kf[0], problem.T_submap_kf[0])


@pytest.fixture
def in_small_chunks(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    return lambda: monkeypatch.setattr(schur, "CHUNK", 100)


def test_neither_chunks_nor_the_order_of_poses_count(in_small_chunks: Callable[[], None]) -> None:
    problem, loss = problem_of(10), partial(huber, k=SHAPE)
    problem = replace(problem, fixed=np.arange(10) < 2)  # the scale, too
    whole = optimise(problem, loss, 3, TOLERANCE)
    in_small_chunks()
    order = np.random.default_rng(1).permutation(10)
    place = np.argsort(order)
    shuffled = replace(
        problem, T_submap_kf=problem.T_submap_kf[order], fixed=problem.fixed[order], kf=place[problem.kf]
    )
    again = optimise(shuffled, loss, 3, TOLERANCE)
    np.testing.assert_allclose(again.state.T_submap_kf[place], whole.state.T_submap_kf, atol=1e-7)
    np.testing.assert_allclose(again.state.xyz_mu, whole.state.xyz_mu, atol=1e-5)


def test_a_point_behind_a_camera_moves_no_pose() -> None:
    problem, loss = problem_of(10), partial(geman_mcclure, shape=SHAPE)
    problem = replace(problem, fixed=np.arange(len(problem.fixed)) < 2)  # nor the scale, which nothing holds
    alone = optimise(problem, loss, 20, 1e-12)
    T = problem.T_submap_kf[:3]
    behind = T[0, :3, 3] - T[0, :3, 2]
    more = replace(
        problem,
        xyz_mu=np.vstack([problem.xyz_mu, behind]),
        kf=np.append(problem.kf, [0, 1, 2]),
        point=np.append(problem.point, [len(problem.xyz_mu)] * 3),
        uv_px=np.vstack([problem.uv_px, [[300.0, 200.0]] * 3]),
        sigma_px=np.append(problem.sigma_px, [1.0] * 3),
    )
    t, r = pose_errors(optimise(more, loss, 20, 1e-12).state.T_submap_kf, alone.state.T_submap_kf)
    assert t.max() < 1e-6
    assert r.max() < 1e-6


@pytest.mark.parametrize("n_fixed", [9, 10], ids=["all but one", "all"])
def test_poses_may_be_held(n_fixed: int, in_small_chunks: Callable[[], None]) -> None:
    in_small_chunks()
    problem = replace(problem_of(10), fixed=np.arange(10) < n_fixed)
    found = optimise(problem, partial(huber, k=SHAPE), 5, TOLERANCE)
    assert found.cost_after < found.cost_before
    np.testing.assert_array_equal(found.state.T_submap_kf[:n_fixed], problem.T_submap_kf[:n_fixed])


def test_what_is_no_number_is_a_failure() -> None:
    problem = problem_of(6)
    with pytest.raises(SolverError, match="no optimum"):
        optimise(replace(problem, uv_px=problem.uv_px * np.nan), partial(huber, k=SHAPE), 3, TOLERANCE)


def test_a_lens_is_found_with_poses_and_points() -> None:
    problem = problem_of(16)
    lens = CorrectedLens(problem.K, np.diag(np.array([0.1, 10.0, 10.0, 0.05, 0.05]) ** -2.0))
    true = np.array([0.02, 2.0, -1.0, 0.01, -0.005])
    scene = make_scene(16, 100, 0.0, 0)
    clean = optimise(replace(problem, fixed=np.arange(16) < 2), partial(huber, k=SHAPE), 10, TOLERANCE).state
    T, xyz = clean.T_submap_kf, clean.xyz_mu
    xyz_cam = np.einsum("rji,rj->ri", T[problem.kf, :3, :3], xyz[problem.point] - T[problem.kf, :3, 3])
    front = xyz_cam[:, 2] > 0.05
    uv_px = lens.project(xyz_cam[:, :2] / xyz_cam[:, 2:], true)
    seen = replace(
        problem,
        T_submap_kf=T,
        xyz_mu=xyz,
        kf=problem.kf[front],
        point=problem.point[front],
        uv_px=uv_px[front],
        sigma_px=problem.sigma_px[front],
        fixed=np.arange(len(scene.T_true)) == 0,
    )
    found = optimise(seen, partial(huber, k=SHAPE), 30, 1e-9, lens, np.zeros(5))
    covariance, follows = System(seen, partial(huber, k=SHAPE), lens).about_lens(found.state)
    assert (np.abs(found.state.lens - true) < np.sqrt(np.diag(covariance))).all()
    assert found.cost_after < 0.01 * found.cost_before
    # Another lens, held, moves the poses as they follow it.
    change = np.array([0.003, 0.5, -0.3, 0.002, 0.001])
    held = _HeldLens(problem.K, found.state.lens + change)
    moved = optimise(seen, partial(huber, k=SHAPE), 50, 1e-12, held, np.zeros(0)).state.T_submap_kf
    expected = so3.log(se3.exp(follows @ change)[:, :3, :3])
    turned = so3.log((se3.inverse(found.state.T_submap_kf) @ moved)[:, :3, :3])
    size = float(np.linalg.norm(turned, axis=1).max())
    assert size > 1e-5
    np.testing.assert_allclose(turned, expected, atol=0.05 * size)


def test_derivatives_of_the_lens() -> None:
    rng, at = np.random.default_rng(0), np.array([0.05, 3.0, -2.0, 0.05, -0.02])
    lens = CorrectedLens(problem_of(3).K, np.eye(5))
    xy, h = rng.uniform(-0.8, 0.8, (20, 2)), 1e-6
    by_ray, by_lens = lens.derivatives(xy, at)
    for i in range(2):
        d = (lens.project(xy + h * np.eye(2)[i], at) - lens.project(xy - h * np.eye(2)[i], at)) / (2 * h)
        np.testing.assert_allclose(by_ray[:, :, i], d, atol=1e-4)
    for i in range(5):
        d = (lens.project(xy, at + h * np.eye(5)[i]) - lens.project(xy, at - h * np.eye(5)[i])) / (2 * h)
        np.testing.assert_allclose(by_lens[:, :, i], d, atol=1e-4)
