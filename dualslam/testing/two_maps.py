"""Small synthetic scenes with known truth, shared by the geometry tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.geometry.projection import project_points

K = np.array([[700.0, 0.0, 600.0], [0.0, 710.0, 180.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class TwoViews:
    """Points seen by two cameras, exactly."""

    T_w_a: np.ndarray
    T_w_b: np.ndarray
    xyz: np.ndarray
    uv_a: np.ndarray
    uv_b: np.ndarray


def two_views(seed: int, n: int = 200, near: float = 2.0, far: float = 20.0) -> TwoViews:
    """Return points in front of two cameras half a unit apart."""
    rng = np.random.default_rng(seed)
    T_w_a = se3.exp([0.1, -0.2, 0.05, 0.3, 0.2, -0.5])
    T_w_b = T_w_a @ se3.exp([0.02, 0.05, -0.03, 0.5, 0.05, 0.1])
    xyz = se3.act(T_w_a, np.c_[rng.uniform(-0.8, 0.8, (n, 2)), np.ones(n)] * rng.uniform(near, far, n)[:, None])
    uv_a, _ = project_points(K, se3.inverse(T_w_a), xyz)
    uv_b, _ = project_points(K, se3.inverse(T_w_b), xyz)
    return TwoViews(T_w_a, T_w_b, xyz, uv_a, uv_b)


def monocular_covariance(
    xyz: np.ndarray, centre: np.ndarray, baseline: float = 1.0, sigma: float = 0.002
) -> np.ndarray:
    """Return covariances (N, 3, 3) like those of triangulation: long along the ray, growing with depth squared."""
    ray = xyz - centre
    depth = np.linalg.norm(ray, axis=1)
    ray = ray / depth[:, None]
    across2, along2 = (sigma * depth) ** 2, (sigma * depth**2 / baseline) ** 2
    outer = ray[:, :, None] * ray[:, None, :]
    return across2[:, None, None] * np.eye(3) + (along2 - across2)[:, None, None] * outer


def sample(rng: np.random.Generator, covariance: np.ndarray) -> np.ndarray:
    """Return one draw (N, 3) from each of N covariances."""
    return (np.linalg.cholesky(covariance) @ rng.normal(size=(len(covariance), 3, 1)))[..., 0]


@dataclass(frozen=True, eq=False)
class TwoMaps:
    """Matched noisy points of two maps, some matched wrongly."""

    S_dst_src: np.ndarray
    src: np.ndarray
    dst: np.ndarray
    cov_src: np.ndarray
    cov_dst: np.ndarray
    wrong: np.ndarray


def two_maps(seed: int, n: int = 100, wrong_ratio: float = 0.3) -> TwoMaps:
    """Return points of one scene mapped twice from different places."""
    rng = np.random.default_rng(seed)
    S = sim3.exp([0.3, -0.5, 0.2, 1.0, 2.0, -1.0, 0.6])
    src = np.c_[rng.uniform(-1, 1, (n, 2)), np.ones(n)] * rng.uniform(2, 12, n)[:, None]
    dst = sim3.act(S, src)
    cov_src = monocular_covariance(src, np.zeros(3))
    cov_dst = monocular_covariance(dst, sim3.act(S, np.array([2.0, 0.0, 0.0])))
    wrong = np.zeros(n, bool)
    wrong[: round(n * wrong_ratio)] = True
    swapped = dst.copy()
    swapped[wrong] = np.roll(dst[wrong], 1, axis=0)
    return TwoMaps(S, src + sample(rng, cov_src), swapped + sample(rng, cov_dst), cov_src, cov_dst, wrong)
