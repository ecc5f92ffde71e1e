"""Normal equations with the points eliminated, against numerical derivatives and the dense system."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.geometry.normal_equations import eliminate_points
from dualslam.core.geometry.projection import project_points

K = np.array([[400.0, 0.0, 320.0], [0.0, 420.0, 240.0], [0.0, 0.0, 1.0]])
N_POSES, N_POINTS = 4, 12
SIZE = 6 * N_POSES


def test_against_numerical_derivatives() -> None:
    rng = np.random.default_rng(0)
    T = se3.exp(0.1 * rng.standard_normal((N_POSES, 6)))
    xyz = rng.uniform([-2, -2, 4], [2, 2, 8], (N_POINTS, 3))
    kf, point = (each.ravel() for each in np.mgrid[:N_POSES, :N_POINTS])
    seen = rng.permutation(len(kf))[: len(kf) - 5]
    kf, point, sigma_px = kf[seen], point[seen], rng.uniform(0.5, 2.0, len(seen))
    equations = eliminate_points(K, T, xyz, kf, point, sigma_px)

    def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return se3.exp(x[:SIZE].reshape(-1, 6)) @ T, xyz + x[SIZE:].reshape(-1, 3)

    def residuals(x: np.ndarray) -> np.ndarray:
        T_x, xyz_x = moved(x)
        uv = [project_points(K, T_x[k], xyz_x[[j]])[0][0] for k, j in zip(kf, point, strict=True)]
        return np.asarray((np.array(uv) / sigma_px[:, None]).ravel())

    def log_depth(x: np.ndarray) -> float:
        """Of pose 1, each point counted by how well its depth is known where the poses are."""
        T_x, xyz_x = moved(x)
        rows = np.flatnonzero(kf == 1)
        along = T[1, 2, :3]
        depth0 = xyz[point[rows]] @ along + T[1, 2, 3]
        variance = np.einsum("i,rij,j->r", along, equations.inverse[point[rows]], along) / depth0**2
        depth = xyz_x[point[rows]] @ T_x[1, 2, :3] + T_x[1, 2, 3]
        return float(np.average(np.log(depth), weights=1 / variance))

    steps = 1e-6 * np.eye(SIZE + 3 * N_POINTS)
    J = np.column_stack([(residuals(step) - residuals(-step)) / 2e-6 for step in steps])
    H = J.T @ J
    A, B, C = H[:SIZE, :SIZE], H[:SIZE, SIZE:], H[SIZE:, SIZE:]
    scale = np.abs(A).max()
    np.testing.assert_allclose(equations.reduced, A - B @ np.linalg.solve(C, B.T), atol=1e-6 * scale)
    np.testing.assert_allclose(equations.H_cross.toarray(), B, atol=1e-6 * scale)
    g = np.array([(log_depth(step) - log_depth(-step)) / 2e-6 for step in steps])
    found = equations.log_depth(np.array([1]))
    assert found is not None
    np.testing.assert_allclose(np.concatenate([found[0], found[1].ravel()]), g, atol=1e-6)
    follows = g[:SIZE] - B @ np.linalg.solve(C, g[SIZE:])
    np.testing.assert_allclose(equations.by_poses(*found), follows, atol=1e-5)
    evenly = equations.log_depth(np.array([1]), evenly=True)
    assert evenly is not None
    seen = point[kf == 1]
    depth = xyz[seen] @ T[1, 2, :3] + T[1, 2, 3]
    np.testing.assert_allclose(evenly[1][seen], T[1, 2, :3] / depth[:, None] / len(seen), atol=1e-12)
    assert equations.log_depth(np.array([N_POSES])) is None
