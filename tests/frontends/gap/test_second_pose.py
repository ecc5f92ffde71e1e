"""A scene that repeats itself leaves two poses standing; one that does not leaves one."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.camera.models import PinholeCamera
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.types import FailureReason, Features, FloatArray
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.gap.second_pose import Sight, find_other_poses, match_under, refuse_look_alike
from tests.seeds import first_of

CAMERA = PinholeCamera(640, 480, 400.0, 400.0, 320.0, 240.0)
K = CAMERA.K
PERIOD_M = 1.5
SIGMA_PX = 0.5
ORB = OrbFrontend()


def row_of_things(n_alike: int, n_own: int, seed: int) -> tuple[FloatArray, np.ndarray]:
    """Points (N, 3) with descriptors: some that come again every `PERIOD_M`, and some that do not."""
    rng = np.random.default_rng(seed)
    one = rng.uniform([0, -1.5, 4], [PERIOD_M, 1.5, 6], (n_alike, 3))
    xyz = np.concatenate([one + [PERIOD_M * n, 0, 0] for n in range(-4, 5)])
    descriptors = np.tile(rng.integers(0, 256, (n_alike, 32), dtype=np.uint8), (9, 1))
    own = rng.uniform([-5, -1.5, 4], [5, 1.5, 6], (n_own, 3))
    return np.concatenate([xyz, own]), np.concatenate([descriptors, rng.integers(0, 256, (n_own, 32), dtype=np.uint8)])


def seen_from(T_cam_w: FloatArray, xyz: FloatArray, descriptors: np.ndarray, seed: int) -> tuple[Features, np.ndarray]:
    uv, depth = project_points(K, T_cam_w, xyz)
    rows = np.flatnonzero((depth > 0) & ((uv > 0) & (uv < CAMERA.size_px)).all(axis=1))
    uv = uv[rows] + SIGMA_PX * np.random.default_rng([seed, 1]).normal(size=(len(rows), 2))
    ones = np.ones(len(rows))
    return Features(uv, uv, SIGMA_PX * ones, ones, np.zeros(len(rows), np.int64), 0 * ones, descriptors[rows]), rows


def sight(n_alike: int, n_own: int, seed: int) -> tuple[FloatArray, np.ndarray, Features, FloatArray]:
    """What was seen before the gap, and the frame beyond it with its true pose."""
    xyz, descriptors = row_of_things(n_alike, n_own, seed)
    _, before = seen_from(np.eye(4), xyz, descriptors, seed)
    T = se3.exp(np.array([0.0, 0.01, 0.0, -0.6, 0.0, 0.05]))
    features, _ = seen_from(T, xyz, descriptors, seed)
    return xyz[before], descriptors[before], features, T


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_what_repeats_is_refused_whichever_pose_came_first(seed: int) -> None:
    xyz, descriptors, features, T = sight(40, 10, seed)
    a_period_off = T.copy()
    a_period_off[:3, 3] += T[:3, :3] @ [PERIOD_M, 0.0, 0.0]
    for first in (T, a_period_off):
        refused = refuse_look_alike(Sight(ORB, descriptors, xyz, features, K, CAMERA), first, seed)
        assert refused is not None
        assert refused.reason is FailureReason.LOOK_ALIKE
        assert refused.numbers["second_pose"] >= 12


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_all_poses_that_are_a_period_off_are_told_and_each_has_its_own_matches(seed: int) -> None:
    xyz, descriptors, features, T = sight(60, 0, seed)
    others = find_other_poses(Sight(ORB, descriptors, xyz, features, K, CAMERA), T, seed)
    places = np.array([np.linalg.inv(other.T_cam_w)[0, 3] - np.linalg.inv(T)[0, 3] for other in others])
    assert len(others) >= 2
    assert np.abs(places / PERIOD_M - np.round(places / PERIOD_M)).max() < 0.05
    assert {-1.0, 1.0} <= set(np.round(places / PERIOD_M).tolist())
    assert len(set(np.round(places / PERIOD_M).tolist())) == len(places), "no place twice"
    for T_cam_w in (T, *(other.T_cam_w for other in others)):
        found = match_under(Sight(ORB, descriptors, xyz, features, K, CAMERA), T_cam_w)
        uv, _ = project_points(K, T_cam_w, xyz[found.index[:, 0]])
        assert len(found) >= 12
        assert np.unique(found.index[:, 0]).size == np.unique(found.index[:, 1]).size == len(found)
        assert np.linalg.norm(uv - features.uv_px[found.index[:, 1]], axis=1).max() < 12.0 * SIGMA_PX


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_a_pose_that_has_little_of_what_was_seen_in_view_is_none_the_worse_for_it(seed: int) -> None:
    """A period on, less than half of the points is in view: from where the camera was before it more of them fit."""
    xyz, descriptors = row_of_things(60, 30, seed)
    xyz *= [3.0, 1.0, 1.0]
    _, before = seen_from(np.eye(4), xyz, descriptors, seed)
    T = np.eye(4)
    T[0, 3] = -3.0 * PERIOD_M
    features, _ = seen_from(T, xyz, descriptors, seed)
    second, *_ = find_other_poses(Sight(ORB, descriptors[before], xyz[before], features, K, CAMERA), np.eye(4), seed)
    assert np.linalg.norm(second.T_cam_w[:3, 3] - T[:3, 3]) < 0.1
    assert second.support < 0.5 * second.first_support
    assert second.support > 0.9 * second.in_view
    assert second.makes_doubtful


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_what_does_not_repeat_has_one_pose(seed: int) -> None:
    xyz, descriptors, features, T = sight(0, 250, seed)
    assert find_other_poses(Sight(ORB, descriptors, xyz, features, K, CAMERA), T, seed) == []


def test_few_things_that_repeat_leave_the_pose_certain() -> None:
    xyz, descriptors, features, T = sight(5, 250, 4)
    assert refuse_look_alike(Sight(ORB, descriptors, xyz, features, K, CAMERA), T, 4) is None
    refused = refuse_look_alike(Sight(ORB, descriptors, xyz, features, K, CAMERA), T, 4, any_is_doubt=True)
    assert refused is not None  # where others can decide
    assert refused.numbers["second_pose"] < 0.5 * refused.numbers["first_pose"]


def test_nothing_to_compare_is_no_second_pose() -> None:
    xyz, descriptors, features, T = sight(0, 250, 5)
    assert find_other_poses(Sight(ORB, descriptors[:0], xyz[:0], features, K, CAMERA), T, 5) == []
