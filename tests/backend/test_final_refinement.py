"""A map's last refinement: nearer to the truth than a batch that outliers pull at, and never a map that is broken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend import local_ba
from dualslam.backend.final_refinement import ITERATIONS, refine_submap
from dualslam.backend.local_ba import bundle_adjust
from dualslam.backend.observability import compute_residuals
from dualslam.core.bundle import FrameRows
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.projection import project_points
from dualslam.core.types import Features, FloatArray, Keyframe
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.map.submap import Submap
from dualslam.testing.graph_scene import HEIGHT, WIDTH, Feeder, GraphScene, K, guessed_submap, make_features, make_scene
from tests.seeds import first_of

N, ROBUST_K = 30, 0.8


def scene_with_outliers(share: float, seed: int, off_px: float = 4.0, noise_px: float = 0.3) -> GraphScene:
    """A scene some of whose features are not where their points are: all off to the same side, as edges pull them."""
    scene = make_scene(N, 100, noise_px, seed)
    rng = np.random.default_rng(seed)

    def pulled(f: Features) -> Features:
        off = (rng.random(len(f)) < share)[:, None] * rng.normal([off_px, 0.0], 0.5, (len(f), 2))
        return make_features(f.uv_px + off * f.sigma_px[:, None], f.sigma_px, f.octave)

    scene.features = [pulled(f) for f in scene.features]
    return scene


def error(submap: Submap, scene: GraphScene) -> float:
    """RMS of the camera's centres, after one alignment."""
    ids = np.array(list(submap.keyframes))
    centres, true = submap.keyframe_poses(ids)[:, :3, 3], scene.T_true[ids][:, :3, 3]
    return float(np.sqrt((distances_when_aligned(centres, true) ** 2).mean()))


def solved(scene: GraphScene) -> Submap:
    """A map at its optimum under the graph's own loss."""
    submap = guessed_submap(scene)
    submap.apply_estimate(*bundle_adjust(submap, list(range(1, N)), [0], ROBUST_K, 20).estimate)
    return submap


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_outliers_lose_their_say(seed: int) -> None:
    scene = scene_with_outliers(0.08, seed)
    submap = solved(scene)
    before = error(submap, scene)
    refine_submap(submap, ROBUST_K)
    assert error(submap, scene) < 0.9 * before


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_without_outliers_little_changes(seed: int) -> None:
    scene = make_scene(N, 100, 0.3, seed)
    submap = solved(scene)
    before = error(submap, scene)
    refine_submap(submap, ROBUST_K)
    assert error(submap, scene) < 1.2 * before


def test_the_first_keyframe_and_the_unit_stay() -> None:
    submap = solved(scene_with_outliers(0.08, 0))
    before = submap.keyframe_poses(np.arange(N))
    refine_submap(submap, ROBUST_K)
    after = submap.keyframe_poses(np.arange(N))
    np.testing.assert_allclose(after[0], before[0], atol=1e-4)
    assert np.abs(after - before).max() > 1e-4
    spread = [((T[:, :3, 3] - T[0, :3, 3]) ** 2).sum() for T in (before, after)]
    assert spread[1] == pytest.approx(spread[0], rel=1e-4)


def test_pixels_without_noise_are_borne() -> None:
    scene = make_scene(N, 100, 0.0)
    submap = guessed_submap(scene, pose_noise=1e-4, point_noise=1e-4)
    before = error(submap, scene)
    refine_submap(submap, ROBUST_K)
    assert error(submap, scene) < 0.1 * before


def test_landmarks_too_uncertain_to_take_part_follow_the_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(N, 100, 0.3, 4)
    submap = solved(scene)
    monkeypatch.setattr(local_ba, "MAX_DEPTH_SIGMA", 0.02)
    beside = ~bundle_adjust(submap, list(range(1, N)), [0], ROBUST_K, 1).result.adjusted
    assert 0.1 < beside.mean() < 0.9
    for k in range(N):  # a map that has bent, in one piece
        T = se3.from_parts(so3.exp(np.array([0.0, 0.001 * k, 0.0])), np.array([0.0, 0.002 * k, 0.0]))
        submap.T_submap_kf[k] = T @ submap.T_submap_kf[k]
    refine_submap(submap, ROBUST_K)
    rows = np.flatnonzero(submap.observations["alive"] & beside[submap.observations["landmark"]])
    uv, sigma = submap.observed_pixels(rows)
    kf, landmark = (submap.observations[name][rows] for name in ("kf", "landmark"))
    xyz = submap.landmarks["xyz_mu"][landmark]
    chi2 = compute_residuals(submap.K, submap.keyframe_poses(np.arange(N)), kf, xyz, uv, sigma).chi2
    assert np.median(chi2) < 2 * 0.3**2 * MEDIAN_CHI2[2]


def test_one_keyframe_is_nothing_to_refine() -> None:
    scene = make_scene(2, 100, 0.3)
    submap = Submap(0, guessed_submap(scene).K, np.zeros(4, np.uint8))
    submap.add_keyframe(scene.keyframe(0), np.eye(4))
    refine_submap(submap, ROBUST_K)
    np.testing.assert_array_equal(submap.T_submap_kf[0], np.eye(4))


def wall_with_false_points(seed: int, n_false: int = 10, off: float = 0.03) -> tuple[Submap, FloatArray]:
    """A map of a camera that moves along a wall, and its true poses; false points near the camera move three keyframes.

    The three see little of the wall, so that a turn nearly makes up for a shift. Two of them and one other keyframe
    have seen each false point, at pixels that agree where the three are shifted by `off`.
    """
    rng, n, bent, n_wall = np.random.default_rng(seed), 14, (6, 7, 8), 400
    wall = rng.uniform([-1.0, -0.3, 0.95], [2.0, 0.25, 1.2], (n_wall, 3))
    false = rng.uniform([0.32, -0.1, 0.25], [0.52, 0.1, 0.45], (n_false, 3))
    views = [(*bent[:2], rng.integers(2, 5)) if j % 2 else (*bent[1:], rng.integers(10, 13)) for j in range(n_false)]
    T_true = np.array([se3.from_parts(np.eye(3), np.array([0.06 * k, 0.0, 0.0])) for k in range(n)])
    slip = se3.from_parts(so3.exp(np.array([0.0, -off, 0.0])), np.array([off, 0.0, 0.0]))
    submap, seen = Submap(0, K, np.zeros(4, np.uint8)), []
    for k in range(n):
        T = T_true[k] @ slip if k in bent else T_true[k]
        uv, _ = project_points(K, se3.inverse(T_true[k]), wall)
        inside = np.flatnonzero((np.abs(uv - [WIDTH / 2, HEIGHT / 2]) < [WIDTH / 2, HEIGHT / 2]).all(axis=1))
        inside = inside[:40] if k in bent else inside
        fooled = np.flatnonzero([k in of for of in views])
        uv = np.concatenate([uv[inside], project_points(K, se3.inverse(T), false[fooled])[0]])
        uv += 0.3 * rng.normal(size=uv.shape)
        submap.add_keyframe(Keyframe(k, 0.1 * k, make_features(uv, np.ones(len(uv)))), T)
        seen.append(np.concatenate([inside, n_wall + fooled]))
    n_points = n_wall + n_false
    submap.add_landmarks(np.concatenate([wall, false]), np.zeros((n_points, 4), np.uint8), np.ones(n_points), 0)
    for k in range(n):
        submap.add_observations(k, np.arange(len(seen[k])), seen[k])
    submap.remove_landmarks(np.flatnonzero(submap.n_observations(np.arange(n_points)) < 2))
    return submap, T_true


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_few_false_points_near_the_camera_lose_what_they_hold(seed: int) -> None:
    """One batch of all landmarks stays at the optimum of the false ones."""
    submap, T_true = wall_with_false_points(seed)
    others = list(range(1, len(T_true)))
    submap.apply_estimate(*bundle_adjust(submap, others, [0], ROBUST_K, 20).estimate)
    at_once = submap.copy()
    shape = 4 * 0.3
    at_once.apply_estimate(*bundle_adjust(at_once, others, [0], shape, 2 * ITERATIONS, forgets=True).estimate)
    refine_submap(submap, ROBUST_K)
    off = [np.abs(m.keyframe_poses(others)[:, :3, 3] - T_true[others, :3, 3]).max() for m in (submap, at_once)]
    assert off[0] < 0.6 * off[1]


def every_other(seed: int) -> tuple[Submap, FrameRows, GraphScene]:
    """A map of every other view of a scene, at its optimum, and what the views between saw of it."""
    scene = make_scene(N, 100, 0.3, seed)
    feeder = Feeder(scene, seed)
    for k in range(0, N, 2):
        feeder.add(k)
    submap = feeder.submap
    submap.apply_estimate(*bundle_adjust(submap, list(range(2, N, 2)), [0], ROBUST_K, 20).estimate)
    T, frame, ids, uv, sigma = [], [], [], [], []
    for k in range(1, N, 2):
        known = np.flatnonzero(feeder.landmark_of_point[scene.seen[k]] >= 0)
        frame.append(np.full(len(known), len(T)))
        T.append(submap.T_submap_kf[k - 1] @ se3.inverse(scene.T_true[k - 1]) @ scene.T_true[k])
        ids.append(feeder.landmark_of_point[scene.seen[k][known]])
        uv.append(scene.features[k].uv_rect_px[known])
        sigma.append(scene.features[k].sigma_px[known])
    return submap, FrameRows(np.array(T), *map(np.concatenate, (frame, ids, uv, sigma))), scene


def test_frames_between_the_keyframes_add_what_they_know() -> None:
    """Twice as many views of the same points: on average the error falls as the root of two says, or nearly."""
    with_frames, without = [], []
    for seed in range(6):
        submap, frames, scene = every_other(seed)
        alone = submap.copy()
        refine_submap(alone, ROBUST_K)
        refine_submap(submap, ROBUST_K, frames)
        without.append(error(alone, scene))
        with_frames.append(error(submap, scene))
    assert np.mean(with_frames) < 0.85 * np.mean(without)


def test_the_first_keyframe_and_the_unit_stay_where_frames_take_part() -> None:
    submap, frames, _ = every_other(3)
    before = submap.keyframe_poses(list(submap.keyframes))
    refine_submap(submap, ROBUST_K, frames)
    after = submap.keyframe_poses(list(submap.keyframes))
    np.testing.assert_array_equal(after[0], before[0])
    assert np.abs(after - before).max() > 1e-5
    spread = [((T[:, :3, 3] - T[0, :3, 3]) ** 2).sum() for T in (before, after)]
    assert spread[1] == pytest.approx(spread[0], rel=1e-9)


def test_frames_of_landmarks_that_are_gone_change_nothing() -> None:
    submap, frames, _ = every_other(1)
    alone, gone = submap.copy(), np.full(len(frames.landmark_ids), len(submap.landmarks) + 5)
    refine_submap(alone, ROBUST_K)
    refine_submap(submap, ROBUST_K, replace(frames, landmark_ids=gone))
    np.testing.assert_allclose(submap.keyframe_poses([4, 8]), alone.keyframe_poses([4, 8]), atol=1e-9)


def test_what_a_bundle_hands_back_is_of_keyframes_alone() -> None:
    submap, frames, _ = every_other(2)
    bundle = bundle_adjust(submap, [2, 4, 6], None, ROBUST_K, 5, frames=frames)
    assert len(bundle.result.T_submap_kf) == len(bundle.keyframe_ids)
    assert len(bundle.result.chi2) == len(bundle.rows)
    assert np.isfinite(bundle.result.chi2).all()


def test_a_landmark_that_nothing_sees_any_more_stays_where_it_is() -> None:
    submap = solved(make_scene(N, 100, 0.3, 5))
    (lost,) = submap.add_landmarks(np.array([[0.1, 0.2, 3.0]]), np.zeros((1, 4), np.uint8), np.ones(1), 0)
    refine_submap(submap, ROBUST_K)
    np.testing.assert_array_equal(submap.landmarks["xyz_mu"][lost], [0.1, 0.2, 3.0])
