"""Self-calibration against scenes with known truth: it finds a wrong camera, and leaves a right one alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend import self_calibration
from dualslam.backend.self_calibration import (
    calibrate_together,
    choose_window,
    estimate_calibration,
    estimate_correction,
    find_preferred_camera,
    make_problem,
)
from dualslam.build import adjust_submap
from dualslam.core.bundle import BundleProblem
from dualslam.core.camera.corrected import LensCorrection, correct
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.settings import CalibrationConfig
from dualslam.core.geometry import so3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.types import Failure, FailureReason, FloatArray, Keyframe
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.map.lens import change_camera
from dualslam.map.submap import Submap
from dualslam.testing.graph_scene import make_features

WIDTH, HEIGHT = 640, 480
TRUE = PinholeCamera(WIDTH, HEIGHT, 500.0, 500.0, 319.5, 239.5)
CONFIG = CalibrationConfig()


def make_submap(camera: PinholeCamera, turning: bool, n: int = 30, noise_px: float = 0.4, seed: int = 0) -> Submap:
    """Return a submap of images that `TRUE` took, made with `camera`: poses and points are right but for noise."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-6, -4, 2], [6, 4, 14], (900, 3)) if turning else rng.uniform([-5, -3, 3], [5, 3, 40], (1500, 3))
    T = np.tile(np.eye(4), (n, 1, 1))
    s = np.linspace(0, 1, n)
    T[:, 2, 3] = (1.0 if turning else 12.0) * s
    if turning:
        T[:, 0, 3], T[:, 1, 3] = 1.5 * np.sin(5 * s), 0.5 * np.cos(7 * s)
        angles = np.column_stack([0.15 * np.sin(6 * s), 0.5 * np.sin(4 * s), 0.2 * np.sin(5 * s)])
        T[:, :3, :3] = [so3.exp(a) for a in angles]
    submap = Submap(0, camera.K, np.zeros(4, np.uint8))
    ids = np.full(len(xyz), -1)
    views = []
    for k in range(n):
        p = (xyz - T[k, :3, 3]) @ T[k, :3, :3]
        uv = TRUE.project(p) + noise_px * rng.normal(size=(len(xyz), 2))
        inside = (p[:, 2] > 1) & (uv > 0).all(1) & (uv < (WIDTH, HEIGHT)).all(1)
        views.append((np.flatnonzero(inside), uv[inside]))
    seen = np.bincount(np.concatenate([rows for rows, _ in views]), minlength=len(xyz)) >= 3
    for k, (rows, uv) in enumerate(views):
        features = make_features(uv, np.full(len(uv), noise_px))
        submap.add_keyframe(Keyframe(k, 0.1 * k, features), T[k])
        new = seen[rows] & (ids[rows] < 0)
        guess = xyz[rows[new]] * (1 + 0.005 * rng.normal(size=(int(new.sum()), 1)))
        ids[rows[new]] = submap.add_landmarks(guess, np.zeros((len(guess), 4), np.uint8), np.ones(len(guess)), k)
        known = ids[rows] >= 0
        submap.add_observations(k, np.flatnonzero(known), ids[rows[known]])
    submap.gauge = (0, n - 1)
    return submap


def wrong_camera(f: float = 1.03) -> PinholeCamera:
    return PinholeCamera(WIDTH, HEIGHT, TRUE.fx * f, TRUE.fy * f, TRUE.cx, TRUE.cy)


def sigmas_off(found: LensCorrection, truth: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.abs(found.vector - truth) / np.sqrt(np.diag(covariance))


def with_false_matches(submap: Submap, seed: int) -> Submap:
    """Let a tenth of all features lie 5 px too far out; sigmas are ten times the noise, so none is large by these."""
    rng = np.random.default_rng(seed)
    for k, keyframe in submap.keyframes.items():
        uv, outward = keyframe.features.uv_px.copy(), keyframe.features.uv_px - TRUE.K[:2, 2]
        false = rng.random(len(uv)) < 0.1
        uv[false] += 5.0 * outward[false] / np.linalg.norm(outward[false], axis=1, keepdims=True)
        submap.keyframes[k] = replace(keyframe, features=make_features(uv, np.full(len(uv), 4.0)))
    return submap


class TestTogether:
    def test_all_maps_of_a_run_find_their_lens_and_change_to_it(self) -> None:
        """One of them drives straight ahead, and could not say it by itself."""
        camera = wrong_camera()
        maps = [with_false_matches(make_submap(camera, turning=i < 2, seed=i), i) for i in range(3)]
        before = [submap.copy() for submap in maps]
        found = calibrate_together(maps, camera, None, change_camera=change_camera, config=CONFIG)
        assert found
        estimate, changed = found
        assert estimate.accepted
        assert abs(estimate.correction.log_focal + np.log(1.03)) < 0.004
        truth = np.array([-np.log(1.03), 0, 0, 0, 0])
        assert sigmas_off(estimate.correction, truth, estimate.covariance).max() < 2.0
        expected = correct(camera, estimate.correction)
        for submap, old, new in zip(maps, before, changed, strict=True):
            np.testing.assert_array_equal(submap.K, camera.K)  # it is not changed
            np.testing.assert_array_equal(new.K, expected.K)
            ids = np.arange(30)
            T, T_old = new.keyframe_poses(ids), old.keyframe_poses(ids)
            np.testing.assert_array_equal(T[0], T_old[0])
            lengths = [np.linalg.norm(each[:, :3, 3] - T[0, :3, 3], axis=1) for each in (T, T_old)]
            assert lengths[0][lengths[1].argmax()] == pytest.approx(lengths[1].max())
            uv, _ = new.observed_pixels(np.arange(len(new.observations)))
            raw, _ = old.observed_pixels(np.arange(len(old.observations)))
            np.testing.assert_allclose(uv, expected.rectify(raw)[0])

    def test_the_maps_get_better_also_one_that_was_made_backwards(self) -> None:
        camera, truth = wrong_camera(), make_submap(TRUE, turning=True).keyframe_poses(np.arange(30))[:, :3, 3]
        maps = [make_submap(camera, turning=True, seed=i) for i in range(2)]
        for submap in maps:
            adjust_submap(submap, 1.345)
        backwards = {k: maps[1].keyframes[k] for k in reversed(maps[1].keyframes)}  # as reverse tracking adds them
        maps[1].keyframes.clear()
        maps[1].keyframes.update(backwards)
        found = calibrate_together(maps, camera, None, change_camera=change_camera, config=CONFIG)
        assert found
        for old, new in zip(maps, found[1], strict=True):
            errors = [
                np.sqrt((distances_when_aligned(m.keyframe_poses(np.arange(30))[:, :3, 3], truth) ** 2).mean())
                for m in (old, new)
            ]
            assert errors[1] < 0.3 * errors[0]

    def test_maps_without_turns_say_nothing(self) -> None:
        camera = wrong_camera()
        found = calibrate_together(
            [make_submap(camera, turning=False, seed=i) for i in range(2)],
            camera,
            None,
            change_camera=change_camera,
            config=CONFIG,
        )
        assert isinstance(found, Failure)
        assert found.reason is FailureReason.DEGENERATE


class TestEstimate:
    def test_right_camera_is_left_alone(self) -> None:
        estimate = estimate_calibration(make_submap(TRUE, turning=True), TRUE, CONFIG)
        assert estimate
        assert not estimate.accepted
        assert estimate.path_change == 0.0
        assert sigmas_off(estimate.correction, np.zeros(5), estimate.covariance).max() < 1.5

    @pytest.mark.parametrize("f", [1.03, 0.95])
    def test_wrong_focal_length_is_found(self, f: float) -> None:
        camera = wrong_camera(f)
        estimate = estimate_calibration(make_submap(camera, turning=True), camera, CONFIG)
        assert estimate
        assert estimate.accepted
        truth = np.array([-np.log(f), 0, 0, 0, 0])
        assert sigmas_off(estimate.correction, truth, estimate.covariance).max() < 1.5
        assert abs(estimate.correction.log_focal + np.log(f)) < 0.004
        assert estimate.cost_after < estimate.cost_before

    def test_the_change_of_the_path_is_the_error_that_the_wrong_camera_makes(self) -> None:
        camera = wrong_camera(1.12)
        submap = make_submap(camera, turning=True)
        truth = submap.keyframe_poses(np.arange(len(submap.keyframes)))[:, :3, 3]
        estimate = estimate_calibration(submap, camera, CONFIG)
        preferred = find_preferred_camera(submap, np.arange(len(truth)), camera, CONFIG)
        assert estimate
        assert preferred is not None
        error = umeyama(preferred.T_now[:, :3, 3], truth)
        assert error
        path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
        assert estimate.path_change == pytest.approx(error.rmse / path, rel=0.1)
        assert estimate.path_change > 0.005

    @pytest.mark.parametrize(("f", "counts"), [(1.02, False), (1.12, True)])
    def test_an_unsure_answer_counts_only_where_the_given_focal_length_is_far_off(
        self, f: float, counts: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        camera = wrong_camera(f)
        monkeypatch.setattr(self_calibration, "INFLATION", 9.0)
        estimate = estimate_calibration(make_submap(camera, turning=True, n=6), camera, CONFIG)
        assert CONFIG.max_focal_sigma < estimate.numbers["log_focal_sigma"]
        assert bool(estimate) is counts

    def test_another_answer_must_differ_by_more_than_is_unknown_of_both(self) -> None:
        """An answer a little off, as the same map can give it: against itself the new one is sure, not against both."""
        camera = wrong_camera()
        submap = make_submap(camera, turning=True)
        first = estimate_calibration(submap, camera, CONFIG)
        assert first
        # Five sigmas along a direction in which nothing else makes up for it.
        values, vectors = np.linalg.eigh(first.covariance)
        off = LensCorrection.of_vector(first.correction.vector + 5.0 * np.sqrt(values[-1]) * vectors[:, -1])
        surely = estimate_calibration(submap, correct(camera, off), CONFIG)
        of_both = estimate_calibration(submap, correct(camera, off), CONFIG, present_covariance=first.covariance)
        assert surely
        assert of_both
        assert surely.accepted
        assert not of_both.accepted
        np.testing.assert_allclose(of_both.correction.vector, surely.correction.vector)
        assert of_both.distance2 == pytest.approx(0.5 * surely.distance2, rel=0.05)

    def test_driving_straight_ahead_says_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        camera = wrong_camera()
        submap = make_submap(camera, turning=False)
        estimate = estimate_calibration(submap, camera, CONFIG)
        assert isinstance(estimate, Failure)
        assert estimate.reason is FailureReason.DEGENERATE
        # Without the short cut over the turning the estimate itself has to say so.
        monkeypatch.setattr(self_calibration, "MIN_ROTATION_DEG", 0.0)
        estimate = estimate_calibration(submap, camera, CONFIG)
        assert isinstance(estimate, Failure) or not estimate.accepted

    def test_points_that_only_fit_behind_the_cameras_are_left_out_without_a_word(
        self, capfd: pytest.CaptureFixture[str]
    ) -> None:
        camera = wrong_camera()
        submap = make_submap(camera, turning=True)
        problem = make_problem(submap, choose_window(submap, 60), camera, 15000)
        T, uv_px, xyz = problem.T_submap_kf, problem.uv_px.copy(), problem.xyz_mu.copy()
        for j in range(5):
            rows = np.flatnonzero(problem.point == j)
            kf = problem.kf[rows]
            behind = T[kf[0], :3, 3] - (2.0 + j) * T[kf[0], :3, 2]
            xyz[j] = T[kf[0], :3, 3] + 0.3 * T[kf[0], :3, 2]
            p = np.einsum("rji,rj->ri", T[kf, :3, :3], behind - T[kf, :3, 3])
            uv_px[rows] = p[:, :2] / p[:, 2:] * problem.K[0, 0] + problem.K[:2, 2]
        estimate = estimate_correction(replace(problem, uv_px=uv_px, xyz_mu=xyz), WIDTH, LensCorrection(), CONFIG)
        assert estimate
        assert abs(estimate.correction.log_focal + np.log(1.03)) < 0.004
        # Without them it goes on from where it had got to, and not from the beginning.
        assert estimate.cost_before < 1.5 * estimate.cost_after
        assert capfd.readouterr().out == ""

    def test_no_camera_turns_away_from_all_that_it_has_seen(self) -> None:
        """Three begin turned by 75 degrees. A view behind a camera must not cost less than any in front of it."""
        camera = wrong_camera()
        submap = make_submap(camera, turning=True)
        problem = make_problem(submap, choose_window(submap, 60), camera, 15000)
        T = problem.T_submap_kf.copy()
        T[10:13, :3, :3] @= so3.exp(np.array([0.0, np.radians(75.0), 0.0]))
        estimate = estimate_correction(replace(problem, T_submap_kf=T), WIDTH, LensCorrection(), CONFIG)
        assert estimate
        assert abs(estimate.correction.log_focal + np.log(1.03)) < 0.004

    def test_distortion_is_found(self) -> None:
        submap = make_submap(TRUE, turning=True)
        problem = make_problem(submap, choose_window(submap, 60), TRUE, 15000)
        bent = LensCorrection(k1=-0.05, k2=0.02, du_px=4.0, dv_px=-3.0)
        xy = (problem.uv_px - problem.K[:2, 2]) / problem.K[0, 0]
        uv = bent.distort_px(problem.K, xy)
        bent_problem = BundleProblem(
            problem.K,
            problem.T_submap_kf,
            problem.fixed,
            problem.xyz_mu,
            problem.kf,
            problem.point,
            uv,
            problem.sigma_px,
        )
        estimate = estimate_correction(bent_problem, WIDTH, LensCorrection(), CONFIG)
        assert estimate
        assert estimate.accepted
        assert sigmas_off(estimate.correction, bent.vector, estimate.covariance).max() < 1.5

    def test_same_seed_same_answer(self) -> None:
        camera = wrong_camera()
        submap = make_submap(camera, turning=True, n=12)
        a, b = (estimate_calibration(submap, camera, CONFIG, seed=3) for _ in range(2))
        assert a
        assert b
        assert np.array_equal(a.correction.vector, b.correction.vector)
        assert np.array_equal(a.covariance, b.covariance)


class TestPreferredCamera:
    """What is asked of a map before it is linked: less than a better camera."""

    def test_the_right_camera_is_not_contradicted(self) -> None:
        found = find_preferred_camera(make_submap(TRUE, turning=True, n=10), np.arange(10), TRUE, CONFIG)
        assert found
        assert not found.beyond_chance
        assert abs(found.log_focal) < 0.01

    def test_one_need_not_be_sure_of_another(self, monkeypatch: pytest.MonkeyPatch) -> None:
        camera = wrong_camera(1.06)
        monkeypatch.setattr(self_calibration, "INFLATION", 9.0)
        submap = make_submap(camera, turning=True, n=6)
        answer = estimate_calibration(submap, camera, CONFIG)
        assert isinstance(answer, Failure)
        assert answer.reason is FailureReason.DEGENERATE
        found = find_preferred_camera(submap, np.arange(6), camera, CONFIG)
        assert found
        assert found.log_focal == pytest.approx(-np.log(1.06), abs=0.02)
        assert found.beyond_chance

    def test_its_poses_are_those_under_the_camera_that_is_asked_for(self) -> None:
        camera = wrong_camera(1.06)
        submap, ids = make_submap(camera, turning=True, n=20), np.arange(2, 18)
        true = submap.keyframe_poses(ids)
        adjust_submap(submap, 1.345)  # the pixels of the wrong camera bend it
        found = find_preferred_camera(submap, ids, camera, CONFIG)
        assert found
        np.testing.assert_array_equal(found.keyframe_ids, ids)
        errors = []
        for path in (found.T_now[:, :3, 3], found.T_preferred[:, :3, 3]):
            errors.append(distances_when_aligned(path, true[:, :3, 3]).mean())
        assert errors[1] < 0.3 * errors[0]
        paths = (submap.keyframe_poses(ids), found.T_now, found.T_preferred)
        reach = [np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1) for T in paths]
        far = int(reach[0].argmax())
        np.testing.assert_allclose([each[far] for each in reach], reach[0][far], rtol=1e-9)

    def test_a_camera_that_is_known_no_better_is_not_contradicted(self) -> None:
        camera, ids = wrong_camera(1.03), np.arange(10)
        submap = make_submap(camera, turning=True, n=10)
        unsure = np.diag([0.02, 5.0, 5.0, 0.02, 0.02]) ** 2
        found = [find_preferred_camera(submap, ids, camera, CONFIG, present_covariance=P) for P in (None, unsure)]
        assert [each.beyond_chance for each in found if each] == [True, False]
        assert [len(each.T_off) for each in found if each] == [0, 5]

    def test_a_map_that_does_not_turn_says_nothing(self) -> None:
        camera = wrong_camera(1.06)
        assert find_preferred_camera(make_submap(camera, turning=False, n=10), np.arange(10), camera, CONFIG) is None

    def test_a_camera_that_is_taken_at_its_word_is_not_asked_about(self) -> None:
        camera, config = wrong_camera(1.06), CalibrationConfig(refine=False)
        assert find_preferred_camera(make_submap(camera, turning=True, n=10), np.arange(10), camera, config) is None


class TestProblem:
    def test_observations_are_bounded(self) -> None:
        submap = make_submap(TRUE, turning=True)
        problem = make_problem(submap, choose_window(submap, 60), TRUE, 2000)
        assert 1500 < len(problem.kf) <= 2000
        assert np.bincount(problem.point).min() >= 3

    def test_pixels_are_those_of_the_given_camera(self) -> None:
        submap = make_submap(TRUE, turning=True, n=6)
        window = choose_window(submap, 60)
        plain = make_problem(submap, window, TRUE, 15000)
        corrected = make_problem(submap, window, correct(TRUE, LensCorrection(log_focal=0.01)), 15000)
        np.testing.assert_array_equal(plain.uv_px, corrected.uv_px)
        np.testing.assert_array_equal(plain.K, corrected.K)

    def test_window_is_where_the_camera_turns(self) -> None:
        submap = make_submap(TRUE, turning=False, n=30)
        for k in range(14, 20):
            submap.T_submap_kf[k][:3, :3] = so3.exp(np.array([0.0, 0.1 * (k - 13), 0.0]))
        window = choose_window(submap, 10)
        assert len(window) == 10
        assert set(range(13, 20)) <= set(window.tolist())
