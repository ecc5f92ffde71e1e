"""The change of a submap to a better calibration: all of it or nothing, and the other frames come along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.propagation import propagate_anchors, propagate_poses
from dualslam.atlas.trajectory import FramePose
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.build import adjust_submap, build_system
from dualslam.core.camera.base import Camera, rectify
from dualslam.core.camera.corrected import LensCorrection, correction_of
from dualslam.core.config.settings import CalibrationConfig, Config, GraphConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import CalibrationEstimate
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Frame, View
from dualslam.map.lens import Calibration, answer
from dualslam.map.submap import Submap
from dualslam.system.camera.shutter_watch import turn_rates
from dualslam.system.system import System
from tests.backend.test_self_calibration import TRUE, make_submap, wrong_camera

WRONG = 1.03
N_FRAMES = 40
RIGHT_AGAIN = LensCorrection(log_focal=-np.log(WRONG))


def estimate_of(correction: LensCorrection, accepted: bool) -> CalibrationEstimate:
    return CalibrationEstimate(correction, np.eye(5), 100.0, accepted, 2.0, 1.0, 30, 5000, 0.1)


def calibration_that_finds(found: CalibrationEstimate | Failure) -> Calibration:
    return Calibration(
        wrong_camera(WRONG),
        CalibrationConfig(),
        estimate=lambda *_: found,
        adjust=lambda submap: adjust_submap(submap, 1.345),
    )


def new_graph() -> ISam2SubmapGraph:
    return ISam2SubmapGraph(GraphConfig())


def snapshot(submap: Submap) -> tuple[object, ...]:
    return submap.K.copy(), dict(submap.keyframes), submap.landmarks["xyz_mu"].copy()


class TestRefine:
    def test_an_accepted_estimate_changes_everything(self) -> None:
        submap = make_submap(wrong_camera(WRONG), turning=True, n=12)
        calibration = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=True))
        assert calibration.refine(submap)
        assert correction_of(calibration.camera) == RIGHT_AGAIN
        np.testing.assert_allclose(submap.K, TRUE.K, atol=1e-9)
        # A graph goes on from there.
        graph = new_graph()
        submap.apply_estimate(*graph.rebuild(submap).values)
        estimate = graph.update(submap)
        assert not estimate.rebuilt
        np.testing.assert_allclose(estimate.T_submap_kf[0], submap.T_submap_kf[0], atol=1e-4)

    @pytest.mark.parametrize(
        "found", [estimate_of(RIGHT_AGAIN, accepted=False), Failure(FailureReason.SOLVER, "no"), None], ids=str
    )
    def test_otherwise_nothing_changes(self, found: CalibrationEstimate | Failure | None) -> None:
        submap = make_submap(wrong_camera(WRONG), turning=True, n=12)
        before = snapshot(submap)
        # None: a correction that has no inverse.
        calibration = calibration_that_finds(found or estimate_of(LensCorrection(k1=-9.0), accepted=True))
        refined = calibration.refine(submap)
        assert isinstance(refined, Failure)
        assert calibration.camera == wrong_camera(WRONG)
        for a, b in zip(before, snapshot(submap), strict=True):
            assert a == b if isinstance(a, dict) else np.array_equal(a, b)  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("first_sigma", "log_focal_sigma", "changes"),
        [(0.015, 0.006, True), (0.015, 0.012, False), (0.008, 0.003, False)],
    )
    def test_a_changed_camera_follows_an_answer_that_is_twice_as_sure_unless_it_was_sure_itself(
        self, first_sigma: float, log_focal_sigma: float, changes: bool
    ) -> None:
        near, covariance = LensCorrection(log_focal=RIGHT_AGAIN.log_focal + 0.01), np.diag([first_sigma**2, 1, 1, 1, 1])
        answers = [
            replace(estimate_of(near, accepted=True), covariance=covariance),
            replace(
                estimate_of(RIGHT_AGAIN, accepted=False), covariance=np.diag([log_focal_sigma**2, 1.0, 1.0, 1.0, 1.0])
            ),
        ]
        submap = make_submap(wrong_camera(WRONG), turning=True, n=12)
        calibration = Calibration(
            wrong_camera(WRONG),
            CalibrationConfig(),
            estimate=lambda *_: answers.pop(0),
            adjust=lambda submap: adjust_submap(submap, 1.345),
        )
        assert calibration.refine(submap)
        assert bool(calibration.refine(submap)) is changes
        assert correction_of(calibration.camera) == (RIGHT_AGAIN if changes else near)

    @pytest.mark.parametrize(
        ("accepted", "sigma", "taken"), [(True, 0.012, True), (False, 0.004, True), (False, 0.007, False)]
    )
    def test_an_answer_of_all_maps_is_taken_if_it_is_significant_or_much_surer(
        self, accepted: bool, sigma: float, taken: bool
    ) -> None:
        near = LensCorrection(log_focal=RIGHT_AGAIN.log_focal + 0.01)
        calibration = calibration_that_finds(replace(estimate_of(near, True), covariance=0.008**2 * np.eye(5)))
        assert calibration.refine(make_submap(wrong_camera(WRONG), turning=True, n=12))
        found = replace(estimate_of(RIGHT_AGAIN, accepted), covariance=sigma**2 * np.eye(5))
        assert calibration.take_together(found) is taken
        assert correction_of(calibration.camera) == (RIGHT_AGAIN if taken else near)
        assert calibration.log_focal_sigma == pytest.approx(sigma if taken else 0.008)

    @pytest.mark.parametrize(("path_change", "refuted"), [(0.03, True), (0.004, False)])
    def test_a_camera_that_explains_much_of_the_path_is_refuted_without_a_change(
        self, path_change: float, refuted: bool
    ) -> None:
        found = replace(estimate_of(RIGHT_AGAIN, False), path_change=path_change)
        calibration = calibration_that_finds(found)
        assert not calibration.is_refuted
        submap = make_submap(wrong_camera(WRONG), turning=True, n=12)
        job = calibration.ask(submap, {})
        failure = calibration.refine(submap)
        assert isinstance(failure, Failure)
        calibration.note(job, failure)
        assert calibration.is_refuted is refuted

    @pytest.mark.parametrize(("sigma", "asks"), [(0.005, False), (0.007, True)])
    def test_a_camera_that_twice_the_information_does_not_change_is_asked_for_no_more(
        self, sigma: float, asks: bool
    ) -> None:
        answers = [
            replace(estimate_of(RIGHT_AGAIN, True), covariance=0.008**2 * np.eye(5)),
            replace(estimate_of(RIGHT_AGAIN, False), covariance=sigma**2 * np.eye(5)),
        ]
        calibration = Calibration(
            wrong_camera(WRONG), CalibrationConfig(), lambda *_: answers.pop(0), lambda s: adjust_submap(s, 1.345)
        )
        submap = make_submap(wrong_camera(WRONG), turning=True, n=12)
        job = calibration.ask(submap, {})
        found = answer(job, calibration, new_graph)
        assert found
        calibration.take(found)
        failure = calibration.refine(submap)
        assert isinstance(failure, Failure)
        calibration.note(calibration.ask(submap, {}), failure)
        assert calibration.is_due(make_submap(TRUE, turning=True, n=30)) is asks

    def test_an_answer_is_asked_for_with_what_was_known_of_the_one_before(self) -> None:
        asked_with: list[FloatArray | None] = []

        def found(submap: Submap, camera: Camera, covariance: FloatArray | None) -> CalibrationEstimate:
            asked_with.append(covariance)
            return replace(estimate_of(RIGHT_AGAIN, len(asked_with) == 1), covariance=0.007**2 * np.eye(5))

        submap = make_submap(wrong_camera(WRONG), turning=True, n=6)
        calibration = Calibration(
            wrong_camera(WRONG), CalibrationConfig(), found, lambda submap: adjust_submap(submap, 1.345)
        )
        assert calibration.refine(submap)
        assert not calibration.refine(submap)
        assert asked_with[0] is None
        np.testing.assert_array_equal(asked_with[1], 0.007**2 * np.eye(5))

    def test_a_solver_that_fails_leaves_the_submap(self) -> None:
        def adjust(submap: Submap) -> None:
            raise SolverError("no")

        def found(submap: Submap, camera: Camera, covariance: FloatArray | None) -> CalibrationEstimate:
            return estimate_of(RIGHT_AGAIN, accepted=True)

        submap = make_submap(wrong_camera(WRONG), turning=True, n=6)
        calibration = Calibration(wrong_camera(WRONG), CalibrationConfig(), found, adjust)
        assert isinstance(calibration.refine(submap), Failure)
        np.testing.assert_array_equal(submap.K, wrong_camera(WRONG).K)
        assert correction_of(calibration.camera) == LensCorrection()

    def test_another_map_of_the_same_lens_is_changed_as_well(self) -> None:
        """Its own pixels say nothing for sure: it drives straight ahead."""
        camera = wrong_camera(WRONG)
        submap, other = make_submap(camera, turning=True, n=12), make_submap(camera, turning=False, n=12, seed=1)
        calibration = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=True))
        assert calibration.refine(submap)
        before = calibration.update(other, new_graph())
        assert before
        np.testing.assert_allclose(before.K, camera.K)
        np.testing.assert_allclose(other.K, TRUE.K, atol=1e-9)
        for keyframe in other.keyframes.values():
            uv_rect_px, _ = calibration.camera.rectify(keyframe.features.uv_px)
            np.testing.assert_allclose(keyframe.features.uv_rect_px, uv_rect_px)
        depth = [m.landmarks["xyz_mu"][:, 2].mean() / m.T_submap_kf[11][2, 3] for m in (before, other)]
        assert abs(depth[1] / depth[0] - 1) < 0.05  # it is the same map still

    def test_when_it_is_due(self) -> None:
        submap = make_submap(TRUE, turning=True, n=30)
        off = Calibration(TRUE, CalibrationConfig(refine=False), lambda *_: Failure(FailureReason.SOLVER), print)
        assert not off.is_due(submap)
        calibration = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=False))
        assert calibration.is_due(submap)
        calibration.refine(submap)
        assert not calibration.is_due(submap)

    def test_a_map_to_which_a_lost_one_is_to_be_joined_is_asked_sooner(self) -> None:
        younger, young, grown = (make_submap(wrong_camera(WRONG), turning=True, n=n) for n in (9, 10, 15))
        calibration = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=False))
        assert not calibration.is_due(young)
        assert not calibration.is_due(younger, is_waited_for=True)
        assert calibration.is_due(young, is_waited_for=True)
        assert not calibration.is_due_at_end(younger, is_waited_for=True)
        assert not calibration.refine(young)
        assert not calibration.is_due(young, is_waited_for=True)
        assert calibration.is_due(grown, is_waited_for=True)
        assert calibration.is_due_at_end(grown, is_waited_for=True)

    def test_at_a_loss_it_is_due_once_more_until_a_map_has_told(self) -> None:
        camera = wrong_camera(WRONG)
        young, submap, grown = (make_submap(camera, turning=True, n=n) for n in (29, 30, 32))
        calibration = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=False))
        assert not calibration.is_due_at_loss(young)
        assert calibration.is_due_at_loss(submap)
        calibration.refine(submap)
        assert not calibration.is_due_at_loss(submap)
        assert calibration.is_due_at_loss(grown)
        assert not calibration.is_due(grown)
        told = calibration_that_finds(estimate_of(RIGHT_AGAIN, accepted=True))
        assert told.refine(submap)
        assert not told.is_due_at_loss(grown)
        off = Calibration(camera, CalibrationConfig(refine=False), lambda *_: Failure(FailureReason.SOLVER), print)
        assert not off.is_due_at_loss(submap)


def test_frames_between_keyframes_follow_a_map_that_bends() -> None:
    before = make_submap(TRUE, turning=True, n=11)
    poses = [FramePose(k, 0.1 * k, 0, k - k % 2, np.eye(4)) for k in range(11)]
    truth = {k: T.copy() for k, T in before.T_submap_kf.items()}
    for k in range(1, 11, 2):  # culled: the odd frames are known only against the keyframe before them
        before.remove_keyframe(k, k - 1)
        poses[k] = FramePose(k, 0.1 * k, 0, k, np.eye(4))
    after = before.copy()
    bend = {k: se3.exp(np.array([0.0, 0.002 * k, 0.0, 0.01 * k, 0.0, 0.0])) for k in range(11)}
    for k in after.keyframes:
        after.T_submap_kf[k] = bend[k] @ truth[k]
    carried = {p.index: p for p in propagate_poses(poses, before, after)}
    propagate_anchors(before, after)
    assert sorted(carried) == [1, 3, 5, 7, 9]
    for k, pose in carried.items():
        assert pose.keyframe_id in after.keyframes
        T = after.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        np.testing.assert_allclose(after.resolve_anchor(k, np.eye(4)), T, atol=1e-12)
        assert np.linalg.norm(se3.log(se3.inverse(T) @ bend[k] @ truth[k])) < 0.006  # half a step


def test_frames_on_both_sides_with_one_stamp_tell_no_turn() -> None:
    submap = make_submap(TRUE, turning=True, n=3)
    turns = [se3.from_parts(so3.exp(np.array([0.0, 0.02 * i, 0.0])), np.zeros(3)) for i in range(6)]
    poses = [FramePose(i, 0.1 * step, 0, 0, turns[i]) for i, step in enumerate([0, 1, 2, 1, 4, 5])]
    rates = turn_rates(submap, poses)
    assert sorted(rates) == [0, 1, 3, 4, 5]  # 2 lies between 1 and 3
    np.testing.assert_allclose(rates[5], [0.0, 0.2, 0.0], atol=1e-9)


class CalibrationWorld:
    """Random points with descriptors of their own before a hand-held camera: what `Components.view_of` would find."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.xyz = self.rng.uniform([-7, -5, 3], [7, 5, 12], (700, 3))
        self.descriptors = self.rng.integers(0, 256, (700, 32), np.uint8)

    def T_world_cam(self, i: int) -> FloatArray:
        s = 0.03 * i
        R = so3.exp(np.array([0.12 * np.sin(3 * s), 0.35 * np.sin(2 * s), 0.15 * np.sin(2.5 * s)]))
        return se3.from_parts(R, np.array([1.2 * np.sin(2.5 * s), 0.5 * np.sin(3.5 * s), 0.6 * np.sin(1.5 * s)]))

    def view(self, frame: Frame, calibration: Calibration) -> View:
        T = self.T_world_cam(frame.index)
        p = (self.xyz - T[:3, 3]) @ T[:3, :3]
        uv = TRUE.project(p) + 0.3 * self.rng.normal(size=(len(p), 2))
        seen = (p[:, 2] > 1) & (uv > 0).all(1) & (uv < (TRUE.width, TRUE.height)).all(1)
        n = int(seen.sum())
        one = np.ones(n)
        features = Features(uv[seen], uv[seen], 0.5 * one, one, 0 * one.astype(int), 0 * one, self.descriptors[seen])
        return View(frame.index, frame.timestamp_s, rectify(features, calibration.camera, 0.0))


def run_point_world(refine: bool, first_keyframes: int = 12) -> System:
    settings = {
        "calibration": {"first_keyframes": first_keyframes, "max_observations": 6000, "refine": refine},
        # Small steps and no culling: many keyframes of few frames.
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
    }
    config = Config.model_validate(settings)
    system, world = build_system(config, wrong_camera(WRONG)), CalibrationWorld()
    calibration = system._state.parts.calibration
    system._state.parts = replace(system._state.parts, view_of=lambda frame: world.view(frame, calibration))
    for i in range(N_FRAMES):
        system.step(Frame(i, i / 30, None))
    system.finish()
    return system


def test_the_system_finds_its_camera() -> None:
    system = run_point_world(refine=True)
    first = system.events.of_kind(EventKind.CALIBRATED)[0]
    assert abs(first.data["log_focal"] + np.log(WRONG)) < 2 * first.data["log_focal_sigma"]
    assert len(system.atlas.submaps) == 1
    assert len(system.poses) == N_FRAMES
    submap = system.atlas.submaps[0]
    assert abs(np.log(submap.K[0, 0] / TRUE.fx)) < 0.25 * np.log(WRONG)
    # The newest keyframe came after the change, the first before it: both are rectified by the same camera now.
    for k in (min(submap.keyframes), max(submap.keyframes)):
        features = submap.keyframes[k].features
        camera = system._state.parts.calibration.camera
        np.testing.assert_allclose(features.uv_rect_px, camera.rectify(features.uv_px)[0])
    again = run_point_world(refine=True)
    for i, pose in system.poses.items():
        assert np.array_equal(pose.T_kf_cam, again.poses[i].T_kf_cam)


def test_a_map_that_was_never_asked_is_asked_at_the_end() -> None:
    system = run_point_world(refine=True, first_keyframes=1000)
    (found,) = system.events.of_kind(EventKind.CALIBRATED, EventKind.CALIBRATION_KEPT)
    assert (found.event, found.frame) == (EventKind.CALIBRATION_KEPT, N_FRAMES - 1)
    assert abs(found.data["log_focal"] + np.log(WRONG)) < 2 * found.data["log_focal_sigma"]
    np.testing.assert_array_equal(system.atlas.submaps[0].K, wrong_camera(WRONG).K)


def test_it_can_be_switched_off() -> None:
    system = run_point_world(refine=False)
    assert not system.events.of_kind(EventKind.CALIBRATED, EventKind.CALIBRATION_KEPT)
    np.testing.assert_array_equal(system.atlas.submaps[0].K, wrong_camera(WRONG).K)
