"""Poses from another front end, gaps crossed: on scenes of points where both front ends see what truth says."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend.local_ba import bundle_adjust_arrays
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Track, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.gap.auxiliary_map import Auxiliary, AuxiliaryMap, TrackViews, triangulate
from dualslam.frontends.gap.pnp_odometry import PnpOdometry, Route
from dualslam.frontends.gap.relocalisation import GapPose, relocalise_across_gap
from dualslam.frontends.gap.second_pose import SecondPose
from dualslam.map.submap import NO_LANDMARK
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, path, random_features
from tests.frontends.tracking.test_tracking import front_end
from tests.seeds import first_of

POSITION_M, ROTATION_RAD = 0.06, 0.005
KEYFRAMES = [40, 43, 46, 49]
"""Of the submap that reverse tracking starts from, at its truth."""
FAR_M = 60.0
"""Thrice what the scene measures."""
DRIVE = path(60, np.array([0.05, 0.0, 0.2]), np.array([0.0, 0.004, 0.0]))
"""Forwards: what lies ahead is seen at another scale on the other side of a gap."""


class WorldFeatures:
    """Features of a world of points, or those that a test has put into their place; it notes what was asked for."""

    def __init__(self, world: PointWorld) -> None:
        self.find: Callable[[View], Features | Failure] = lambda view: world.features(view.index)
        self.asked: list[int] = []
        self.prefetched: list[int] = []

    def of(self, view: View) -> Features | Failure:
        self.asked.append(view.index)
        return self.find(view)

    def prefetch(self, views: Iterable[View]) -> None:
        self.prefetched += [view.index for view in views]


def worlds(covered: range = range(0)) -> tuple[PointWorld, PointWorld]:
    """The live front end's points and the auxiliary front end's, which are others, along the same path."""
    hidden = frozenset(covered)
    xyz = cloud(1200, seed=1) * (1.5, 1.0, 2.5)
    live = PointWorld(xyz, DRIVE, covered=hidden)
    auxiliary = PointWorld(cloud(1200, seed=7) * (1.5, 1.0, 2.5), DRIVE, seed=3, covered=hidden)
    return live, auxiliary


def odometry(
    live: PointWorld,
    auxiliary: PointWorld | WorldFeatures,
    config: Config | None = None,
    tracks_live: bool = False,
    own: WorldFeatures | None = None,
    keyframes: Sequence[int] = KEYFRAMES,
    notes_rivals: bool = False,
) -> PnpOdometry:
    features = [] if own is None else [own]
    features.append(WorldFeatures(auxiliary) if isinstance(auxiliary, PointWorld) else auxiliary)
    reverse_tracker = PnpOdometry(
        front_end(live, list(keyframes), 40),
        [Auxiliary(OrbFrontend(), each) for each in features],
        Route([live.view(k) for k in KEYFRAMES], [live.view(i) for i in range(39, -1, -1)]),
        bundle_adjust_arrays,
        config or Config(),
        CAMERA,
        tracks_live,
        notes_rivals,
    )
    reverse_tracker.start_at(40)
    return reverse_tracker


def walk(reverse_tracker: PnpOdometry, live: PointWorld, frames: range) -> dict[int, Track | Failure]:
    steps = {}
    for i in frames:
        steps[i] = reverse_tracker.track(live.view(i))
        if steps[i] and reverse_tracker.keyframe_due(steps[i]):
            reverse_tracker.insert_keyframe(steps[i])
    return steps


def errors(steps: dict[int, Track | Failure], world: PointWorld) -> FloatArray:
    """(N, 6): rotation and position of each posed frame against the truth, in whose frame and unit the submap is."""
    posed = {i: track for i, track in steps.items() if isinstance(track, Track)}
    T = np.stack([track.T_cam_submap for track in posed.values()])
    return se3.log(T @ world.T_world_cam[list(posed)])


class TestFollowing:
    def test_poses_are_right_and_come_from_the_guest_alone(self) -> None:
        """The live front end sees nothing of its landmarks, and the frames are posed all the same."""
        live, auxiliary = worlds()
        reverse_tracker = odometry(live, auxiliary)
        blind = [replace(live.view(i), features=random_features(np.random.default_rng(i))) for i in range(39, 25, -1)]
        steps = {view.index: reverse_tracker.track(view) for view in blind}
        assert all(isinstance(track, Track) for track in steps.values())
        assert all((track.landmark_ids == NO_LANDMARK).mean() > 0.9 for track in steps.values() if track)
        error = errors(steps, live)
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M
        assert np.linalg.norm(error[:, :3], axis=1).max() < ROTATION_RAD

    def test_keyframes_hold_landmarks_of_live_features(self) -> None:
        live, auxiliary = worlds()
        reverse_tracker = odometry(live, auxiliary)
        before = len(reverse_tracker.submap.landmarks)
        steps = walk(reverse_tracker, live, range(39, 19, -1))
        new = [k for k in reverse_tracker.submap.keyframes if k < 40]
        assert len(new) >= 2
        assert len(reverse_tracker.submap.landmarks) > before + 50
        lm = reverse_tracker.submap.landmarks
        assert lm["descriptor"].shape[1] == live.descriptors.shape[1]
        for k in new:
            assert (reverse_tracker.submap.landmark_of[k] >= 0).sum() > 50
            true = live.T_world_cam[k][:3, 3]
            assert np.linalg.norm(reverse_tracker.submap.T_submap_kf[k][:3, 3] - true) < POSITION_M
        assert np.linalg.norm(errors(steps, live)[:, 3:], axis=1).max() < POSITION_M

    def test_an_image_that_is_gone_is_a_failure_with_its_reason(self) -> None:
        live, auxiliary = worlds()
        features = WorldFeatures(auxiliary)
        features.find = lambda view: Failure(FailureReason.UNREADABLE, "gone")
        reverse_tracker = odometry(live, features)
        failure = reverse_tracker.track(live.view(39))
        assert isinstance(failure, Failure)
        assert failure.detail == "gone"


class TestGapRelocalisation:
    covered = range(22, 40)

    def test_it_leaps_a_gap_and_a_second_frame_confirms(self) -> None:
        live, auxiliary = worlds(self.covered)
        reverse_tracker = odometry(live, auxiliary)
        steps = walk(reverse_tracker, live, range(39, 14, -1))
        assert not any(steps[i] for i in self.covered)
        first, second = steps[21], steps[20]
        assert isinstance(first, Failure)
        assert first.reason is FailureReason.UNCONFIRMED
        assert isinstance(second, Track)
        assert second.wide
        assert all(steps[i] for i in range(20, 14, -1))
        error = errors(steps, live)
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M * 2
        assert np.linalg.norm(error[:, :3], axis=1).max() < ROTATION_RAD
        assert 20 in reverse_tracker.submap.keyframes

    def test_the_live_front_end_walks_where_it_can(self) -> None:
        live, auxiliary = worlds(range(25, 32))
        features = WorldFeatures(auxiliary)
        reverse_tracker = odometry(live, features, tracks_live=True)
        before = walk(reverse_tracker, live, range(39, 31, -1))
        assert all(before.values())
        assert not features.asked
        beyond = walk(reverse_tracker, live, range(31, 9, -1))
        assert all(beyond[i] for i in range(23, 9, -1))
        # Those before the gap that it matches with, those in it and the two that confirm it; then live features again.
        assert {24, 23} <= set(features.asked)
        assert not {i for i in features.asked if i < 21}
        error = errors(before | beyond, live)
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M * 2

    def test_the_first_frame_beyond_has_its_pose_once_it_is_confirmed(self) -> None:
        live, auxiliary = worlds(self.covered)
        reverse_tracker = odometry(live, auxiliary)
        walk(reverse_tracker, live, range(39, 20, -1))
        assert reverse_tracker.confirmed() is None
        walk(reverse_tracker, live, range(20, 19, -1))
        first = reverse_tracker.confirmed()
        assert first is not None
        assert first.view.index == 21
        error = errors({21: first}, live)[0]
        assert np.linalg.norm(error[3:]) < POSITION_M * 2
        assert np.linalg.norm(error[:3]) < ROTATION_RAD
        walk(reverse_tracker, live, range(19, 18, -1))
        assert reverse_tracker.confirmed() is None

    @pytest.mark.parametrize("tracks_live", [False, True])
    def test_frames_that_are_missing_are_leapt_as_those_that_show_nothing(self, tracks_live: bool) -> None:
        live, auxiliary = worlds()
        reverse_tracker = odometry(live, auxiliary, tracks_live=tracks_live)
        steps = walk(reverse_tracker, live, range(39, 33, -1)) | walk(reverse_tracker, live, range(22, 14, -1))
        assert all(steps[i] for i in range(39, 33, -1))
        assert isinstance(steps[22], Failure)
        assert steps[22].reason is FailureReason.UNCONFIRMED
        assert isinstance(steps[21], Track)
        assert steps[21].wide
        # The submap is told what the gap relocalisation knows of the pose, of the gap relocalisation alone.
        assert reverse_tracker.submap.relative_poses.keys() == {21}
        known = reverse_tracker.submap.relative_poses[21]
        assert known.keyframe_id >= 34
        np.testing.assert_array_equal(known.covariance, steps[21].covariance)
        T_live = live.T_world_cam
        off = se3.log(se3.inverse(known.T_ref_kf) @ se3.inverse(T_live[known.keyframe_id]) @ T_live[21])
        assert np.linalg.norm(off[3:]) < POSITION_M * 2
        error = errors(steps, live)
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M * 2

    def test_a_keyframe_of_an_earlier_walk_ends_the_gap(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Beyond it nothing is in doubt any more, and another gap is crossed."""
        live, auxiliary = worlds(range(27, 34))
        reverse_tracker = odometry(live, auxiliary, tracks_live=True, keyframes=[14, 17, 20, *KEYFRAMES])
        doubt = Failure(FailureReason.LOOK_ALIKE, "")
        monkeypatch.setattr("dualslam.frontends.gap.pose_finder.refuse_look_alike", lambda *_, **__: doubt)
        steps = walk(reverse_tracker, live, range(39, 20, -1))
        assert steps[26] is steps[21] is doubt
        monkeypatch.undo()
        steps = walk(reverse_tracker, live, range(20, 11, -1)) | walk(reverse_tracker, live, range(2, -1, -1))
        assert all(steps[i] for i in range(20, 11, -1))
        assert isinstance(steps[2], Failure)
        assert steps[2].reason is FailureReason.UNCONFIRMED
        assert isinstance(steps[1], Track)
        assert np.linalg.norm(errors(steps, live)[:, 3:], axis=1).max() < POSITION_M * 2

    def test_a_keyframe_of_an_earlier_walk_leaves_no_rivals(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """They are of a frame that nothing has confirmed: the keyframe is where the earlier walk has put it."""
        live, auxiliary = worlds(range(27, 34))
        reverse_tracker = odometry(live, auxiliary, keyframes=[20, *KEYFRAMES], notes_rivals=True)
        other = SecondPose(np.eye(4), 100, 100, 200, 200)
        monkeypatch.setattr("dualslam.frontends.gap.pose_finder.find_other_poses", lambda *_, **__: [other])
        walk(reverse_tracker, live, range(39, 25, -1))
        assert [rival.index for rival in reverse_tracker.rivals] == [26]
        walk(reverse_tracker, live, range(20, 19, -1))
        assert not reverse_tracker.rivals

    def test_the_scale_beyond_is_that_before(self) -> None:
        live, auxiliary = worlds(self.covered)
        reverse_tracker = odometry(live, auxiliary)
        walk(reverse_tracker, live, range(39, 9, -1))
        beyond = sorted(k for k in reverse_tracker.submap.keyframes if k < 22)
        est = np.stack([reverse_tracker.submap.T_submap_kf[k][:3, 3] for k in beyond])
        true = live.T_world_cam[beyond][:, :3, 3]
        ratio = np.linalg.norm(est[0] - est[-1]) / np.linalg.norm(true[0] - true[-1])
        assert abs(ratio - 1) < 0.02

    def test_what_a_leap_needs_is_foreseen(self) -> None:
        live, auxiliary = worlds(range(25, 32))
        features = WorldFeatures(auxiliary)
        reverse_tracker = odometry(live, features, tracks_live=True)
        walk(reverse_tracker, live, range(39, 31, -1))
        assert not features.prefetched
        for i in range(31, 9, -1):
            before, features.asked = set(features.prefetched), []
            reverse_tracker.track(live.view(i))
            assert set(features.asked) <= set(features.prefetched)
            if i < 24:  # with the first frame beyond the gap came those that it is matched with, and the next one
                assert set(features.asked) <= before

    def test_own_features_cross_first_and_no_others_are_asked(self) -> None:
        live, auxiliary = worlds()
        features = WorldFeatures(auxiliary)
        reverse_tracker = odometry(live, features, tracks_live=True, own=WorldFeatures(live))
        steps = walk(reverse_tracker, live, range(39, 31, -1))
        steps |= walk(reverse_tracker, live, range(24, 9, -1))
        assert all(steps[i] for i in range(23, 9, -1))
        assert not features.asked
        assert np.linalg.norm(errors(steps, live)[:, 3:], axis=1).max() < POSITION_M * 2

    def test_what_own_features_leave_in_doubt_the_others_decide(self) -> None:
        """A sixth of what own features show stands elsewhere beyond the gap, and asks for another pose by itself."""
        live, auxiliary = worlds(range(25, 32))
        elsewhere = live.xyz.copy()
        elsewhere[:200, 1] += 0.6
        own, features = WorldFeatures(live), WorldFeatures(auxiliary)
        beyond = replace(live, xyz=elsewhere)
        np.testing.assert_array_equal(beyond.descriptors, live.descriptors)
        own.find = lambda view: (beyond if view.index < 25 else live).features(view.index)
        reverse_tracker = odometry(live, features, tracks_live=True, own=own)
        steps = walk(reverse_tracker, live, range(39, 22, -1))
        assert isinstance(steps[23], Track)
        assert {24, 23} <= set(features.asked)
        assert np.linalg.norm(errors(steps, live)[:, 3:], axis=1).max() < POSITION_M * 2

    @pytest.mark.parametrize(("limit", "others_are_asked"), [(0.002, False), (0.001, True)])
    def test_landmarks_may_hold_the_scale_that_own_features_leave_open(
        self, limit: float, others_are_asked: bool
    ) -> None:
        """Own features leave it open by 0.3 %; the landmarks beyond hold it to 0.12 %, the others to 0.08 %."""
        live, auxiliary = worlds(range(25, 32))
        own, features = WorldFeatures(live), WorldFeatures(auxiliary)

        def find(view: View) -> Features:
            found = live.features(view.index)
            return replace(found, sigma_px=4 * found.sigma_px)

        own.find = find
        config = Config.model_validate({"linking": {"wrong_scale": limit}})
        reverse_tracker = odometry(live, features, config, tracks_live=True, own=own)
        steps = walk(reverse_tracker, live, range(39, 31, -1)) | walk(reverse_tracker, live, range(24, 9, -1))
        assert all(steps[i] for i in range(23, 9, -1))
        assert bool(features.asked) is others_are_asked
        assert np.linalg.norm(errors(steps, live)[:, 3:], axis=1).max() < POSITION_M * 2

    def test_no_gap_no_features_of_the_guest(self) -> None:
        """The older submap ends where this one begins, and nothing lies between that the auxiliary front end would be
        needed for.
        """
        live, auxiliary = worlds()
        features = WorldFeatures(auxiliary)
        reverse_tracker = odometry(live, features, tracks_live=True)
        assert all(walk(reverse_tracker, live, range(39, 20, -1)).values())
        assert not features.prefetched
        assert not features.asked

    def test_poses_that_contradict_each_other_are_not_believed(self) -> None:
        """Rows of like houses: beyond the gap, frame after frame shows what was before it from another place, and each
        pose is as well supported as the true one. Only what was not seen before the gap tells how the camera moved.
        """
        live, auxiliary = worlds(self.covered)
        before = PointWorld(auxiliary.xyz[:600], DRIVE, seed=3, covered=auxiliary.covered)
        np.testing.assert_array_equal(before.descriptors, auxiliary.descriptors[:600])

        def seen_alike(view: View) -> Features:
            xyz = auxiliary.xyz.copy()
            xyz[:600, 1] += 0.6 if view.index % 2 else -0.6
            return (PointWorld(xyz, DRIVE, seed=3) if view.index < 22 else before).features(view.index)

        features = WorldFeatures(before)
        features.find = seen_alike
        reverse_tracker = odometry(live, features)
        steps = {i: reverse_tracker.track(live.view(i)) for i in range(39, 14, -1)}
        assert not any(steps.values())
        assert {steps[i].reason for i in range(21, 14, -1)} == {FailureReason.UNCONFIRMED}

    def test_a_small_step_is_decided_by_landmarks_that_are_still_seen(self) -> None:
        """The auxiliary front end's own points keep no scale here, and one frame is missing: the live landmarks do."""
        live, auxiliary = worlds(range(38, 40))
        config = Config.model_validate({"linking": {"wrong_scale": 1e-4}})
        reverse_tracker = odometry(live, auxiliary, config)
        steps = walk(reverse_tracker, live, range(39, 29, -1))
        assert all(steps[i] for i in range(37, 29, -1))
        assert steps[37].wide
        error = errors(steps, live)
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M
        assert np.linalg.norm(error[:, :3], axis=1).max() < ROTATION_RAD

    def test_a_scale_that_is_not_known_is_refused(self) -> None:
        live, auxiliary = worlds(self.covered)
        config = Config.model_validate({"linking": {"wrong_scale": 1e-4}})
        reverse_tracker = odometry(live, auxiliary, config)
        steps = walk(reverse_tracker, live, range(39, 14, -1))
        assert not any(steps.values())
        assert steps[21].reason is FailureReason.SCALE


def wide_case(seed: int, n_views: int, wrong: float, look_alikes: int = 0) -> tuple[GapPose | Failure, FloatArray]:
    """Wide matches of frame 15 of the drive with frames from 40 on, some of them wrong; the pose, and the truth."""
    _, auxiliary = worlds()
    rng = np.random.default_rng(seed)
    frontend, submap = OrbFrontend(), front_end(worlds()[0], KEYFRAMES, 40).submap
    tracks = AuxiliaryMap(submap)
    for k in KEYFRAMES[:n_views]:
        features = auxiliary.features(k)
        tracks.add(k, features, {j: frontend.match_wide(tracks.features(j), features) for j in tracks.frames})
        tracks.put(k, k, se3.inverse(auxiliary.T_world_cam[k]))
    features = auxiliary.features(15)
    matches = {k: frontend.match_wide(tracks.features(k), features) for k in tracks.frames}
    tracks.add(15, features, matches)
    rows = tracks.rows_with_track(15)
    if look_alikes:  # what lies far ahead, as beyond a long gap, and little of it
        rows = rows[np.linalg.norm(features.uv_rect_px[rows] - CAMERA.K[:2, 2], axis=1) < 80][:40]
    uv = features.uv_rect_px[rows].copy()
    swap = rng.random(len(rows)) < wrong
    uv[swap] = rng.uniform([0, 0], SIZE_PX, (int(swap.sum()), 2))
    views = tracks.views(15, rows, tracks.frames)
    views, uv, sigma_px = with_look_alikes(
        views, uv, features.sigma_px[rows], look_alikes, auxiliary.T_world_cam[15], seed
    )
    swap = np.append(swap, np.ones(look_alikes, bool))
    found = relocalise_across_gap(views, uv, sigma_px, CAMERA.K, SIZE_PX, bundle_adjust_arrays, seed)
    if found:
        # A pixel anywhere may lie on the epipolar line of a track that only one view knows.
        assert found.inliers[swap].sum() <= 0.1 * swap.sum()
    return found, auxiliary.T_world_cam[15]


def with_look_alikes(
    views: TrackViews, uv: FloatArray, sigma_px: FloatArray, n: int, T_world_cam: FloatArray, seed: int
) -> tuple[TrackViews, FloatArray, FloatArray]:
    """Add false matches with the last known frame: road at the image's edge that looks alike everywhere.

    They lie where a camera that is turned by a degree would see points that are far away.
    """
    K_inverse = np.linalg.inv(CAMERA.K)
    rng, width_height = np.random.default_rng(seed), np.array(SIZE_PX)
    corner = rng.uniform(0.75 * width_height, width_height, (n, 2))
    uv_known, seen = np.zeros((n, *views.uv_px.shape[1:])), np.zeros((n, views.visible.shape[1]), bool)
    uv_known[:, -1], seen[:, -1] = corner, True
    turned = se3.exp(np.array([0.008, 0.012, -0.015, 0.0, 0.0, 0.0])) @ se3.inverse(T_world_cam)
    xyz = se3.act(se3.inverse(views.T_cam_submap[-1]), FAR_M * np.column_stack([corner, np.ones(n)]) @ K_inverse.T)
    far = se3.act(turned, xyz) @ CAMERA.K.T
    more = TrackViews(
        views.T_cam_submap,
        np.concatenate([views.uv_px, uv_known]),
        np.concatenate([views.sigma_px, np.ones(seen.shape)]),
        np.concatenate([views.visible, seen]),
    )
    return more, np.concatenate([uv, far[:, :2] / far[:, 2:]]), np.concatenate([sigma_px, np.ones(n)])


class TestGapPose:
    @pytest.mark.parametrize("wrong", [0.0, 0.4])
    @pytest.mark.parametrize("n_views", [2, 4])
    def test_pose_with_wrong_matches(self, n_views: int, wrong: float) -> None:
        found, T_world_cam = wide_case(1, n_views, wrong)
        assert isinstance(found, GapPose)
        error = se3.log(found.T_cam_submap @ T_world_cam)
        assert np.linalg.norm(error[3:]) < 2 * POSITION_M
        assert np.linalg.norm(error[:3]) < ROTATION_RAD
        assert 0.5 < found.chi2 < 1.5

    def test_uncertainty_is_that_of_the_errors(self) -> None:
        distance2 = []
        for seed in range(4):
            found, T_world_cam = wide_case(seed, 3, 0.1)
            assert isinstance(found, GapPose)
            error = se3.log(found.T_cam_submap @ T_world_cam)
            distance2.append(error @ np.linalg.solve(found.covariance, error))
        # Six degrees of freedom, the covariance inflated by 1.5 squared.
        assert 0.5 < np.mean(distance2) < 12

    @pytest.mark.parametrize("seed", first_of(range(3)))
    def test_road_that_looks_alike_bends_no_pose(self, seed: int) -> None:
        found, T_world_cam = wide_case(seed, 3, 0.6, look_alikes=12)
        assert isinstance(found, GapPose)
        error = se3.log(found.T_cam_submap @ T_world_cam)
        assert error @ np.linalg.solve(found.covariance, error) < 22.5  # 99.9 % for six degrees of freedom

    def test_one_known_view_knows_no_scale(self) -> None:
        found, _ = wide_case(1, 1, 0.0)
        assert isinstance(found, Failure) or found.scale_sigma > 0.5

    def test_points_of_the_known_views_are_right(self) -> None:
        live, auxiliary = worlds()
        frontend, tracks = OrbFrontend(), AuxiliaryMap(front_end(live, KEYFRAMES, 40).submap)
        for k in KEYFRAMES:
            features = auxiliary.features(k)
            tracks.add(k, features, {j: frontend.match_wide(tracks.features(j), features) for j in tracks.frames})
            tracks.put(k, k, se3.inverse(auxiliary.T_world_cam[k]))
        rows = tracks.rows_with_track(49)
        xyz, good = triangulate(tracks.views(49, rows, tracks.frames), CAMERA.K)
        words = auxiliary.features(49).descriptors[rows[good]]
        true = auxiliary.xyz[[int(np.bitwise_count(auxiliary.descriptors ^ d).sum(1).argmin()) for d in words]]
        depth = np.linalg.norm(true - auxiliary.T_world_cam[49][:3, 3], axis=1)
        relative = np.linalg.norm(xyz[good] - true, axis=1) / depth
        assert good.sum() > 50
        assert np.median(relative) < 0.1
