"""Guided matching against oracles written as plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.chi_square import CHI2_95
from dualslam.core.types import Features, FloatArray, Matches
from dualslam.frontends.features import matching
from dualslam.frontends.features.matching import FeatureGrid, match_epipolar, match_projected
from dualslam.frontends.features.orb import OrbFrontend
from tests.frontends.conftest import made_up_features

FRONTEND = OrbFrontend()
K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])


def with_flipped_bits(descriptors: np.ndarray, n_bits: int, seed: int) -> np.ndarray:
    """Each descriptor with `n_bits` random bits changed (fewer where a bit is drawn twice)."""
    rng = np.random.default_rng(seed)
    bits = np.unpackbits(descriptors, axis=1)
    rows = np.arange(len(bits))[:, None]
    bits[rows, rng.integers(0, 256, (len(bits), n_bits))] ^= 1
    return np.packbits(bits, axis=1)


def assert_one_to_one(matches: Matches) -> None:
    for column in matches.index.T:
        assert len(np.unique(column)) == len(column)


def test_grid_finds_what_a_loop_finds() -> None:
    rng = np.random.default_rng(0)
    uv = rng.uniform(-20, 700, (400, 2))
    uv[7] = np.nan
    asked = rng.uniform(-60, 760, (60, 2))
    asked[3] = np.inf
    asked[4, 0] = np.nan
    radius = rng.uniform(0, 80, 60)
    query, feature = FeatureGrid.build(uv, 16.0).within(asked, radius)
    expected = {
        (m, i)
        for m in range(60)
        for i in range(400)
        if np.isfinite(asked[m]).all() and np.hypot(*(uv[i] - asked[m])) <= radius[m]
    }
    assert set(zip(query.tolist(), feature.tolist(), strict=True)) == expected
    assert len(query) == len(expected)
    assert (np.diff(query) >= 0).all()


def test_grid_of_nothing() -> None:
    for uv in (np.empty((0, 2)), np.full((3, 2), np.nan)):
        query, _ = FeatureGrid.build(uv).within(np.zeros((4, 2)), np.full(4, 1e6))
        assert len(query) == 0
    query, _ = FeatureGrid.build(np.zeros((3, 2))).within(np.empty((0, 2)), np.empty(0))
    assert len(query) == 0


def projected_oracle(
    features: Features,
    uv: FloatArray,
    radius: FloatArray,
    descriptors: np.ndarray,
    octave: np.ndarray,
    ratio: float,
    taken: np.ndarray,
) -> dict[int, int]:
    """Best clear candidate of each point, then the best point of each feature."""
    best: dict[int, tuple[float, int, int]] = {}
    for m in range(len(uv)):
        found = [
            (float(FRONTEND.distance(descriptors[m : m + 1], features.descriptors[i : i + 1])[0]), i)
            for i in range(len(features))
            if np.hypot(*(features.uv_rect_px[i] - uv[m])) <= radius[m]
            and abs(features.octave[i] - octave[m]) <= 1
            and not taken[i]
        ]
        if not found:
            continue
        distance, i = min(found, key=lambda each: each[0])
        rivals = [d for d, k in found if k != i and features.octave[k] == features.octave[i]]
        if rivals and distance > ratio * min(rivals):
            continue
        if i not in best or distance < best[i][0]:
            best[i] = (distance, m, i)
    return {m: i for distance, m, i in best.values() if distance <= FRONTEND.max_distance}


@pytest.mark.parametrize("ratio", [1.0, 0.9, 0.6])
def test_projected_matches_agree_with_a_loop(ratio: float) -> None:
    rng = np.random.default_rng(1)
    features = made_up_features(300, seed=1, width=200, height=150)
    source = rng.integers(0, 300, 200)  # with repetition: several points want the same feature
    uv = features.uv_px[source] + rng.normal(0, 4, (200, 2))
    # Distances between random descriptors tie often; many flipped bits make rivals close.
    descriptors = with_flipped_bits(features.descriptors[source], 60, seed=2)
    octave = features.octave[source] + rng.integers(-1, 2, 200)
    radius = rng.uniform(5, 30, 200)
    taken = rng.random(300) < 0.2
    grid = FeatureGrid.build(features.uv_rect_px, 16.0)
    matches = match_projected(
        FRONTEND, grid, features, uv, radius, descriptors, octave=octave, ratio=ratio, taken=taken
    )
    expected = projected_oracle(features, uv, radius, descriptors, octave, ratio, taken)
    assert dict(matches.index.tolist()) == expected
    assert len(matches) > 50
    assert_one_to_one(matches)
    assert not taken[matches.index[:, 1]].any()
    paired = FRONTEND.distance(descriptors[matches.index[:, 0]], features.descriptors[matches.index[:, 1]])
    np.testing.assert_array_equal(matches.distance, paired)


def test_projected_matches_with_nothing_in_reach() -> None:
    features = made_up_features(50, seed=3)
    grid = FeatureGrid.build(features.uv_rect_px)
    far = np.full((4, 2), 1e5)
    assert len(match_projected(FRONTEND, grid, features, far, np.full(4, 9.0), features.descriptors[:4])) == 0
    lost = np.full((4, 2), np.nan)
    assert len(match_projected(FRONTEND, grid, features, lost, np.full(4, 9.0), features.descriptors[:4])) == 0
    none = features.take(np.empty(0, np.int64))
    grid = FeatureGrid.build(none.uv_rect_px)
    assert len(match_projected(FRONTEND, grid, none, far, np.full(4, 9.0), features.descriptors[:4])) == 0


def test_projected_matches_drop_odd_rotations() -> None:
    features = made_up_features(100, seed=4)
    grid = FeatureGrid.build(features.uv_rect_px)
    angle = features.angle_rad - 0.7
    angle[:10] += 1.5
    matches = match_projected(
        FRONTEND, grid, features, features.uv_px, np.full(100, 3.0), features.descriptors, angle_rad=angle
    )
    np.testing.assert_array_equal(matches.index[:, 0], np.arange(10, 100))


def two_views(n: int, seed: int) -> tuple[Features, Features, FloatArray, FloatArray, FloatArray]:
    """Features of n points in two cameras (row j is point j in both), F_b_a, T_b_a and the points' inverse depths."""
    rng = np.random.default_rng(seed)
    angle = 0.05
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_b_a[:3, 3] = (-0.8, 0.1, 0.2)
    depth = rng.uniform(4, 20, n)
    uv_a = rng.uniform((60, 60), (580, 420), (n, 2))
    points_b = (np.c_[uv_a, np.ones(n)] @ np.linalg.inv(K).T * depth[:, None]) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    uv_b = (points_b @ K.T)[:, :2] / points_b[:, 2:]
    octave = rng.integers(0, 4, n)
    scale = 1.2**octave
    sigma = 0.5 * scale
    angles = rng.uniform(-3, 3, n)
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    noisy = [uv + rng.normal(0, 1, (n, 2)) * sigma[:, None] for uv in (uv_a, uv_b)]
    a = Features(noisy[0], noisy[0], sigma, scale, octave, angles, descriptors)
    flipped = with_flipped_bits(descriptors, 30, seed)
    b = Features(noisy[1], noisy[1], sigma, scale, octave, angles + 0.02, flipped)
    t = T_b_a[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    K_inv = np.linalg.inv(K)
    return a, b, K_inv.T @ cross @ T_b_a[:3, :3] @ K_inv, T_b_a, 1 / depth


def test_epipolar_matches_are_right_and_complete() -> None:
    a, b, F_b_a, _, _ = two_views(400, seed=5)
    rows_a, rows_b = np.arange(0, 300), np.random.default_rng(0).permutation(np.arange(100, 400))
    matches = match_epipolar(FRONTEND, a, b, rows_a, rows_b, F_b_a)
    right = matches.index[:, 0] == matches.index[:, 1]
    assert right.mean() > 0.98
    assert right.sum() > 0.9 * 200
    assert_one_to_one(matches)
    assert np.isin(matches.index[:, 0], rows_a).all()
    assert np.isin(matches.index[:, 1], rows_b).all()


@pytest.mark.parametrize("sign", [1.0, -3.0])
def test_epipolar_matches_agree_with_a_loop(sign: float, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, F_b_a, _, _ = two_views(150, seed=6)
    monkeypatch.setattr(matching, "EPIPOLAR_RATIO", 1.0)
    monkeypatch.setattr(matching, "EPIPOLE_PX", 0.0)
    monkeypatch.setattr(matching, "consistent_rotation", lambda turns: np.ones(len(turns), np.bool_))
    matches = match_epipolar(FRONTEND, a, b, np.arange(150), np.arange(150), sign * F_b_a)
    cost = np.full((150, 150), np.inf)
    for i in range(150):
        line = F_b_a @ (*a.uv_px[i], 1.0)
        for j in range(150):
            off = line @ (*b.uv_px[j], 1.0) / np.hypot(line[0], line[1])
            variance = a.sigma_px[i] ** 2 + b.sigma_px[j] ** 2
            if off**2 <= CHI2_95[1] * variance and abs(a.octave[i] - b.octave[j]) <= 1:
                cost[i, j] = FRONTEND.distance(a.descriptors[i : i + 1], b.descriptors[j : j + 1])[0]
    expected = {
        (i, int(cost[i].argmin()))
        for i in range(150)
        if cost[i].min() <= FRONTEND.max_distance and cost[:, cost[i].argmin()].argmin() == i
    }
    assert {tuple(row) for row in matches.index.tolist()} == expected


def test_features_beside_the_epipole_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    # Forward motion: the epipole is in the middle of both images.
    F_b_a = np.linalg.inv(K).T @ np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]]) @ np.linalg.inv(K)
    uv = np.array([[323.0, 240.0], [420.0, 300.0]])
    features = made_up_features(2, seed=8)
    same = Features(
        uv, uv, *(getattr(features, n) for n in ("sigma_px", "scale", "octave", "angle_rad", "descriptors"))
    )
    rows = np.arange(2)
    assert match_epipolar(FRONTEND, same, same, rows, rows, F_b_a).index.tolist() == [[1, 1]]
    monkeypatch.setattr(matching, "EPIPOLE_PX", 1.0)
    assert len(match_epipolar(FRONTEND, same, same, rows, rows, F_b_a)) == 2


def test_epipolar_matching_of_nothing() -> None:
    a, b, F_b_a, _, _ = two_views(20, seed=9)
    none = np.empty(0, np.int64)
    for rows_a, rows_b in ((none, none), (none, np.arange(20)), (np.arange(20), none)):
        assert len(match_epipolar(FRONTEND, a, b, rows_a, rows_b, F_b_a)) == 0
    assert len(match_epipolar(FRONTEND, a, b, np.arange(20), np.arange(20), np.zeros((3, 3)))) == 0
