"""What a submap's factors say of the similarity between two of its keyframes, against what pixel noise does to it."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.edge_covariance import _linearise, _unit, edge_covariances
from dualslam.backend.local_ba import bundle_adjust
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3
from dualslam.map.anchors import RelativePose
from dualslam.testing.atlas_world import DriftingMap
from dualslam.testing.point_world import CAMERA

FIRST, SECOND = 4, 16
NO_DRIFT = np.zeros(7)


def stretch(seed: int = 0) -> DriftingMap:
    world = DriftingMap(21, drift=NO_DRIFT, noise_px=0.5, seed=seed)
    for k in range(21):
        world.add(k)
    return world


def test_derivatives_against_numerical_ones() -> None:
    submap = stretch().submap
    window = np.arange(8)
    kf, point, x, J_pose, J_point = _linearise(submap, window, 1e6)
    row = 5
    k = int(window[kf[row]])

    def pixel(xi: np.ndarray, moved: np.ndarray) -> np.ndarray:
        T = submap.T_submap_kf[k] @ se3.exp(xi)
        p = se3.act(submap.T_submap_kf[k], x[row]) + moved
        return np.asarray(CAMERA.project(((p - T[:3, 3]) @ T[:3, :3])[None])[0] / 0.5)

    step = 1e-6
    for i in range(6):
        d = np.eye(6)[i] * step
        np.testing.assert_allclose(
            (pixel(d, np.zeros(3)) - pixel(-d, np.zeros(3))) / (2 * step), J_pose[row, :, i], rtol=1e-5, atol=1e-3
        )
    for i in range(3):
        d = np.eye(3)[i] * step
        np.testing.assert_allclose(
            (pixel(np.zeros(6), d) - pixel(np.zeros(6), -d)) / (2 * step), J_point[row, :, i], rtol=1e-5, atol=1e-3
        )
    # With the points held, the unit at a keyframe is a matter of its own pose alone.
    n_points = int(point.max()) + 1
    R = submap.keyframe_poses(window)[:, :3, :3]
    derivative = _unit(3, kf, point, x, R[3], np.zeros((n_points, 3, 48)), 8)
    assert not derivative[:18].any()
    assert not derivative[24:].any()
    here = x[kf == 3]
    for i in range(6):
        moved = [np.log(se3.act(se3.inverse(se3.exp(s * np.eye(6)[i])), here)[:, 2]).mean() for s in (step, -step)]
        np.testing.assert_allclose((moved[0] - moved[1]) / (2 * step), derivative[18 + i], rtol=1e-5, atol=1e-6)


def test_against_solutions_of_noisy_pixels() -> None:
    said = edge_covariances(stretch().submap, [(FIRST, SECOND)], robust_k=100.0)[0]
    found = []
    for seed in range(60):
        world = stretch(seed)
        submap = world.submap
        solved = bundle_adjust(submap, list(range(2, 21)), [0, 1], robust_k=100.0, max_iterations=10)
        submap.apply_estimate(*solved.estimate)
        T = se3.inverse(submap.T_submap_kf[FIRST]) @ submap.T_submap_kf[SECOND]
        true = se3.inverse(world.T_true[FIRST]) @ world.T_true[SECOND]
        units = [world.unit(0, k) for k in (FIRST, SECOND)]
        S = sim3.from_parts(units[0] / units[1], true[:3, :3], units[0] * true[:3, 3])
        found.append(sim3.log(sim3.inverse(S) @ T))
    ratio = np.sqrt((np.array(found) ** 2).mean(0)) / np.sqrt(np.diag(said))
    assert (ratio > 0.6).all(), ratio
    assert (ratio < 1.5).all(), ratio


def test_the_longer_the_way_the_less_is_known() -> None:
    submap = stretch().submap
    C = edge_covariances(submap, [(4, 6), (4, 10), (4, 18)], 0.8)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    assert (np.diff(sigma[:, 6]) > 0).all()
    assert (np.diff(np.linalg.norm(sigma[:, 3:6], axis=1)) > 0).all()
    assert (np.linalg.eigvalsh(C) > 0).all()


def test_another_front_ends_leap_counts_and_a_held_bend_does_not() -> None:
    submap = stretch().submap
    alone = edge_covariances(submap, [(4, 10)], 0.8)[0]
    T = se3.inverse(submap.T_submap_kf[4]) @ submap.T_submap_kf[10]
    submap.relative_poses[10] = RelativePose(4, T, 1e-10 * np.eye(6))
    assert np.trace(edge_covariances(submap, [(4, 10)], 0.8)[0][:6, :6]) < 0.1 * np.trace(alone[:6, :6])
    np.testing.assert_array_equal(edge_covariances(submap, [(4, 10)], 0.8, frozenset({10}))[0], alone)


def test_a_keyframe_that_is_not_there_is_named() -> None:
    with pytest.raises(SolverError, match="keyframe 77"):
        edge_covariances(stretch().submap, [(4, 77)], 0.8)
