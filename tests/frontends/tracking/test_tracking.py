"""Tracking and mapping against exact scenes: poses, wide relocalisation, keyframes, culling."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import KannalaBrandtCamera, PinholeCamera, RadTanCamera
from dualslam.core.chi_square import CHI2_95
from dualslam.core.config.settings import Config, KeyframeConfig
from dualslam.core.estimates import KeyframeReport
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray, Keyframe, Track, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.tracking.keyframing import keyframe_due, keyframe_like, parallax_deg
from dualslam.frontends.tracking.local_map import LocalMap
from dualslam.frontends.tracking.mapper import Mapper, spread_choice
from dualslam.frontends.tracking.resection import estimate_pose, resect
from dualslam.frontends.tracking.tracker import GivenPose
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.testing.point_world import (
    CAMERA,
    SIZE_PX,
    PointWorld,
    cloud,
    hand_held,
    path,
    pose_errors,
    random_features,
)

POSITION_M, ROTATION_RAD = 0.03, 0.005


def true_map(world: PointWorld, keyframes: list[int], every: int = 1) -> Submap:
    """Return a submap in world coordinates: true poses, every n-th point that two keyframes see at its truth."""
    views = {k: world.view(k) for k in keyframes}
    point_of = {
        k: [int(np.bitwise_count(world.descriptors ^ d).sum(1).argmin()) for d in view.features.descriptors]
        for k, view in views.items()
    }
    submap = Submap(0, CAMERA.K, np.zeros(32, np.uint8))
    for k in keyframes:
        submap.add_keyframe(Keyframe(k, views[k].timestamp_s, views[k].features), world.T_world_cam[k])
    n_seen = np.bincount(np.concatenate(list(point_of.values())), minlength=len(world.xyz))
    ids = np.full(len(world.xyz), NO_LANDMARK)
    for k in keyframes:
        points, features = np.array(point_of[k]), views[k].features
        new = (n_seen[points] > 1) & (ids[points] < 0) & (points % every == 0)
        ids[points[new]] = submap.add_landmarks(
            world.xyz[points[new]], features.descriptors[new], features.scale[new], k
        )
        known = ids[points] >= 0
        submap.add_observations(k, np.flatnonzero(known), ids[points[known]])
    submap.gauge = (keyframes[0], keyframes[-1])
    return submap


def front_end(world: PointWorld, keyframes: list[int], start_at: int, every: int = 1) -> VisualFrontEnd:
    config = Config()
    submap = true_map(world, keyframes, every)
    graph = ISam2SubmapGraph(config.graph)
    graph.update(submap)
    live = VisualFrontEnd(OrbFrontend(), config, submap, graph, CAMERA)
    live.start_at(start_at)
    return live


def test_tracking_leaves_the_map_alone_and_says_what_it_saw(world: PointWorld) -> None:
    live = front_end(world, [0, 4, 8], start_at=8)
    before = {name: column.copy() for name, column in live.submap.landmarks.columns().items()}
    track = tracked(live, world.view(9))
    assert all(np.array_equal(column, before[name]) for name, column in live.submap.landmarks.columns().items())
    live.submap.count_sightings(track)
    found = track.landmark_ids[track.landmark_ids >= 0]
    after = live.submap.landmarks
    assert (after["n_visible"] - before["n_visible"]).sum() == len(track.visible_ids)
    assert (after["n_found"] - before["n_found"]).nonzero()[0].tolist() == sorted(found.tolist())


@pytest.fixture
def world() -> PointWorld:
    return PointWorld(cloud(), hand_held(80))


def tracked(live: VisualFrontEnd, view: View) -> Track:
    track = live.track(view)
    assert isinstance(track, Track), track
    return track


class TestTracker:
    @pytest.mark.parametrize("order", [range(9, 26), range(15, 0, -1)], ids=["forwards", "backwards"])
    def test_poses_are_right(self, world: PointWorld, order: range) -> None:
        live = front_end(world, [0, 4, 8, 12, 16], start_at=8 if order.step > 0 else 16)
        tracks = [tracked(live, world.view(i)) for i in order]
        assert not any(track.wide for track in tracks)
        np.testing.assert_allclose(
            se3.inverse(tracks[0].T_predicted), world.T_world_cam[order.start - order.step], atol=1e-9
        )
        T = np.stack([se3.inverse(track.T_cam_submap) for track in tracks])
        error = se3.log(se3.inverse(T) @ world.T_world_cam[list(order)])
        assert np.linalg.norm(error[:, 3:], axis=1).max() < POSITION_M
        assert np.linalg.norm(error[:, :3], axis=1).max() < ROTATION_RAD

    def test_covariance_is_that_of_the_errors(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8, 12, 16], start_at=8)
        distances2 = []
        for i in range(9, 16):
            track = tracked(live, world.view(i))
            error = se3.log(track.T_cam_submap @ world.T_world_cam[i])
            distances2.append(error @ np.linalg.solve(track.covariance, error))
        # Six degrees of freedom; the points are exact.
        assert 1 < np.mean(distances2) < 16

    def test_dropped_frames_are_found_again_by_wide_matching(self, world: PointWorld) -> None:
        far = PointWorld(world.xyz, path(40, np.array([0.0, 0, 0]), np.array([0, 0.02, 0])))
        live = front_end(far, [0, 3, 6, 9], start_at=9)
        tracked(live, far.view(9))
        # 0.3 rad further at once: 135 px, beyond the guided search.
        track = tracked(live, far.view(24))
        assert track.wide
        error = se3.log(track.T_cam_submap @ far.T_world_cam[24])
        assert np.linalg.norm(error[:3]) < ROTATION_RAD
        assert not tracked(live, far.view(24)).wide

    def test_frames_that_are_missing_are_a_gap_also_where_guided_matching_finds_its_way(
        self, world: PointWorld
    ) -> None:
        live = front_end(world, [0, 4, 8, 12, 16], start_at=8)
        assert not any(tracked(live, world.view(i)).wide for i in (9, 10, 11, 14))
        assert not live.lies_beyond_gap(world.view(22))  # its motion was measured over three intervals
        assert not tracked(live, world.view(15)).wide
        assert live.lies_beyond_gap(world.view(19))
        track = tracked(live, world.view(19))
        assert track.wide
        assert np.linalg.norm(se3.log(track.T_cam_submap @ world.T_world_cam[19])[3:]) < POSITION_M

    def test_a_front_end_at_rest_knows_of_no_motion_that_leads_beyond_a_gap(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8, 12, 16], start_at=8)
        assert not live.lies_beyond_gap(world.view(12))  # as far as from one keyframe to the next
        assert live.lies_beyond_gap(world.view(13))
        assert live.lies_beyond_gap(world.view(3))
        assert tracked(live, world.view(14)).wide
        assert not front_end(world, [0, 8, 16], start_at=8).lies_beyond_gap(world.view(15))

    @pytest.mark.parametrize(("keyframes", "holds"), [([0, 1], False), ([0, 4, 8, 12], True)])
    def test_a_leap_that_loses_the_scale_is_refused(self, keyframes: list[int], holds: bool) -> None:
        """Two keyframes side by side hardly know depths; the same gap crossed from a wide map holds the scale."""
        drive = PointWorld(cloud(1200, seed=1) * (1.5, 1.0, 2.5), path(60, np.array([0.05, 0, 0.2]), np.zeros(3)))
        live = front_end(drive, keyframes, start_at=keyframes[-1], every=8)
        last = keyframes[-1] + 1
        before = tracked(live, drive.view(last))
        far = live.track(drive.view(last + 12))
        if holds:
            assert isinstance(far, Track)
            assert far.wide
            return
        assert isinstance(far, Failure)
        assert far.reason is FailureReason.SCALE
        again = tracked(live, drive.view(last))  # it stands where it stood
        np.testing.assert_allclose(again.T_cam_submap, before.T_cam_submap, atol=1e-3)

    def test_it_follows_a_map_that_has_moved(self, world: PointWorld) -> None:
        """Another unit and another frame, between two keyframes: the motion model goes on as if nothing were."""
        live, untouched = (front_end(world, [0, 4, 8, 12, 16], start_at=8) for _ in range(2))
        for i in (9, 10, 11):
            tracked(live, world.view(i))
            tracked(untouched, world.view(i))
        before = live.submap.copy()
        T_new_old = se3.exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -1.0]))
        live.submap.transform(2.5, T_new_old)
        graph = ISam2SubmapGraph(Config().graph)
        graph.update(live.submap)
        live.adopt(graph, before)
        a, b = tracked(live, world.view(13)), tracked(untouched, world.view(13))
        S_new_old = sim3.from_parts(2.5, T_new_old[:3, :3], T_new_old[:3, 3])
        for moved, still in ((a.T_predicted, b.T_predicted), (a.T_cam_submap, b.T_cam_submap)):
            np.testing.assert_allclose(
                se3.inverse(moved), sim3.act_on_pose(S_new_old, se3.inverse(still)), rtol=0, atol=1e-6
            )
        assert a.n_inliers == b.n_inliers

    def test_a_failure_leaves_the_tracker_as_it_was(self, world: PointWorld) -> None:
        live, untouched = (front_end(world, [0, 4, 8], start_at=8) for _ in range(2))
        nothing = random_features(np.random.default_rng(0), 10)
        for i, features in ((9, random_features(np.random.default_rng(1))), (10, nothing)):
            assert isinstance(live.track(View(i, i / 20, features)), Failure)
        a, b = tracked(live, world.view(11)), tracked(untouched, world.view(11))
        assert np.array_equal(a.T_cam_submap, b.T_cam_submap)

    def test_a_look_elsewhere_leaves_the_tracker_as_it_was(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The frame shows another part of the map, which has nothing in common with the one that is tracked."""
        drive = PointWorld(cloud(length_m=24.0), path(90, np.array([0.25, 0.0, 0.02]), np.zeros(3)))
        live, untouched = (front_end(drive, list(range(0, 90, 4)), start_at=8) for _ in range(2))
        far, T_cam_submap = drive.view(75), se3.inverse(drive.T_world_cam[75])

        def refused() -> Track | Failure:
            refusal = Failure(FailureReason.SCALE, "refused")
            with monkeypatch.context() as patched:
                patched.setattr("dualslam.frontends.tracking.tracker.refuse_lost_scale", lambda *_: refusal)
                return live.track(far)

        def posed() -> float:
            return live.scale_sigma_at(far, GivenPose(T_cam_submap, 50, 50, 1.0, 1e-6 * np.eye(6), wide=True))

        for i, look in enumerate((None, refused, posed, lambda: live.track_near(far, T_cam_submap)), 9):
            assert look is None or isinstance(look(), Failure) == (look is refused)
            a, b = tracked(live, drive.view(i)), tracked(untouched, drive.view(i))
            assert np.array_equal(a.T_cam_submap, b.T_cam_submap)
            assert np.array_equal(a.landmark_ids, b.landmark_ids)

    def test_no_texture_is_said(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        failure = live.track(View(9, 0.45, random_features(np.random.default_rng(0), 3)))
        assert isinstance(failure, Failure)
        assert failure.reason is FailureReason.NO_TEXTURE

    def test_wrong_matches_are_left_out(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        view = world.view(9)
        wrong = np.random.default_rng(0).permutation(len(view.features))[: len(view.features) // 5]
        view.features.uv_rect_px[wrong] += 8.0
        track = tracked(live, view)
        assert np.linalg.norm(se3.log(track.T_cam_submap @ world.T_world_cam[9])[3:]) < POSITION_M
        assert (track.landmark_ids[wrong] == NO_LANDMARK).mean() > 0.95


class TestMapping:
    def test_new_landmarks_lie_where_the_points_are(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8, every=2)
        n_before = len(live.submap.landmarks)
        for i in range(9, 40):
            track = tracked(live, world.view(i))
            if i % 5 == 0:
                live.insert_keyframe(track)
        submap = live.submap
        new = np.flatnonzero(submap.landmarks["alive"][n_before:]) + n_before
        new = new[submap.n_observations(new) >= 3]
        assert len(new) > 50
        nearest = np.linalg.norm(submap.landmarks["xyz_mu"][new, None] - world.xyz[None], axis=2).min(axis=1)
        depth = submap.landmarks["distance_mu"][new]
        assert np.median(nearest / depth) < 0.01
        # Each point once: descriptors tell them apart.
        seen = np.bitwise_count(submap.landmarks["descriptor"][new, None] ^ world.descriptors[None]).sum(-1).argmin(1)
        assert len(np.unique(seen)) > 0.97 * len(seen)

    def test_a_weak_start_grows_by_what_its_views_see_before_any_further_frame(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8, every=16)
        submap, n_before = live.submap, len(live.submap.landmarks)
        assert not live.track(world.view(9)), "the points of the start are too few to find a frame by"
        live.grow_weak_start(noise2=1.0)
        new = np.flatnonzero(submap.landmarks["alive"][n_before:]) + n_before
        assert len(new) > 4 * n_before
        nearest = np.linalg.norm(submap.landmarks["xyz_mu"][new, None] - world.xyz[None], axis=2).min(axis=1)
        assert np.median(nearest / submap.landmarks["distance_mu"][new]) < 0.02
        track = tracked(live, world.view(9))
        error = se3.log(track.T_cam_submap @ world.T_world_cam[9])
        assert np.linalg.norm(error[3:]) < POSITION_M

    def test_a_start_with_landmarks_enough_stays_as_it_is(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8, every=2)
        n_before = len(live.submap.landmarks)
        live.grow_weak_start(noise2=1.0)
        assert len(live.submap.landmarks) == n_before

    @pytest.mark.parametrize(("in_haste", "n_calls"), [(False, 2), (True, 0)])
    def test_a_keyframe_in_haste_aligns_no_patches(self, world: PointWorld, in_haste: bool, n_calls: int) -> None:
        live, aligned = front_end(world, [0, 4, 8], start_at=8), list[int]()
        live._alignment = SimpleNamespace(refine=lambda submap, rows: aligned.append(len(rows)))  # type: ignore[assignment]
        for i in range(9, 16):
            track = tracked(live, world.view(i))
        live.insert_keyframe(track, in_haste)
        assert len(aligned) == n_calls
        assert all(n > 20 for n in aligned)

    def test_a_turn_towards_far_scenery_is_tracked_by_far_landmarks(self) -> None:
        """Nothing out there shows a degree of parallax before the near points are out of view."""
        rng = np.random.default_rng(3)
        far = rng.uniform([40, -25, -30], [110, 25, 110], (1500, 3))
        far = far[np.linalg.norm(far[:, [0, 2]], axis=1) > 60]
        way = path(46, np.array([0.08, 0.0, 0.0]), np.array([0.0, 0.035, 0.0]))
        world = PointWorld(np.concatenate([cloud(400) * (0.6, 1.0, 1.0), far]), way)
        live = front_end(world, [0, 4, 8], start_at=8)
        for i in range(9, len(way)):
            track = tracked(live, world.view(i))
            if live.keyframe_due(track):
                live.insert_keyframe(track)
            error = se3.log(track.T_cam_submap @ way[i])
            assert np.linalg.norm(error[:3]) < 2 * ROTATION_RAD

    def test_a_keyframe_is_posed_by_the_map_before_it_places_anything(self, world: PointWorld) -> None:
        """Tracked a degree off, it maps as much as one that was tracked right, and as truly."""
        found = []
        for off in (np.zeros(6), np.array([0.0, 0.0175, 0.0, -0.05, 0.0, 0.0])):
            live = front_end(world, [0, 4, 8], start_at=8, every=2)
            for i in range(9, 16):
                track = tracked(live, world.view(i))
            n_before = len(live.submap.landmarks)
            report = live.insert_keyframe(replace(track, T_cam_submap=se3.exp(off) @ track.T_cam_submap))
            assert isinstance(report, KeyframeReport)
            new = np.flatnonzero(live.submap.landmarks["alive"][n_before:]) + n_before
            nearest = np.linalg.norm(live.submap.landmarks["xyz_mu"][new, None] - world.xyz[None], axis=2).min(axis=1)
            found.append((len(new), np.quantile(nearest / live.submap.landmarks["distance_mu"][new], 0.9)))
        (n_right, error_right), (n_off, error_off) = found
        assert n_off > 0.95 * n_right
        assert error_off < 1.2 * error_right

    def test_no_landmark_is_let_in_that_fits_worse_than_the_map_does(self, world: PointWorld) -> None:
        """Its gate follows residuals that are smaller than their sigmas, and opens for none that are larger."""
        worst, n_new = {}, {}
        for noise2 in (0.25, 1.0, 4.0):
            live = front_end(world, [0, 4, 8], start_at=8, every=2)
            track, submap = tracked(live, world.view(12)), live.submap
            mapper = Mapper(OrbFrontend(), Config().mapping, submap, CAMERA)
            mapper.observe(track)
            n_before, n_landmarks = len(submap.observations), len(submap.landmarks)
            mapper.grow(track, noise2=noise2)
            n_new[noise2] = len(submap.landmarks) - n_landmarks
            rows = np.arange(n_before, len(submap.observations))
            uv_px, sigma_px = submap.observed_pixels(rows)
            chi2 = []
            for i, row in enumerate(rows):
                T_cam_submap = se3.inverse(submap.T_submap_kf[int(submap.observations["kf"][row])])
                xyz_mu = submap.landmarks["xyz_mu"][submap.observations["landmark"][row]]
                error = (CAMERA.project(se3.act(T_cam_submap, xyz_mu[None]))[0] - uv_px[i]) / sigma_px[i]
                chi2.append(error @ error)
            worst[noise2] = max(chi2)
        gate = CHI2_95[2]
        assert worst[0.25] < 0.25 * gate < worst[1.0] < gate
        assert 0 < n_new[0.25] < n_new[1.0] == n_new[4.0]

    def test_nothing_is_triangulated_across_a_gap_that_few_landmarks_bridge(self) -> None:
        world = PointWorld(cloud(), path(60, np.array([0.02, 0, 0]), np.array([0, 0.02, 0])))
        before = [0, 3, 6, 9]
        live = front_end(world, before, start_at=9, every=12)
        tracked(live, world.view(9))
        n_before = len(live.submap.landmarks)
        crossed = tracked(live, world.view(24))
        assert crossed.wide
        assert np.count_nonzero(crossed.landmark_ids >= 0) < Config().keyframes.weak_landmarks
        live.insert_keyframe(crossed)
        assert len(live.submap.landmarks) == n_before  # it stands alone on its side
        for i in (27, 30, 33):
            live.insert_keyframe(tracked(live, world.view(i)))
        new = np.flatnonzero(live.submap.landmarks["alive"][n_before:]) + n_before
        assert len(new) > 30
        # Placed by this side alone; then they may be found on the other one, too.
        obs = live.submap.observations
        here = obs["alive"] & np.isin(obs["kf"], [24, 27, 30, 33])
        assert (np.bincount(obs["landmark"][here], minlength=len(live.submap.landmarks))[new] >= 2).all()

    def test_keyframe_poses_and_the_frames_between_stay_right(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        relative = {}
        for i in range(9, 60):
            track = tracked(live, world.view(i))
            if live.keyframe_due(track):
                live.insert_keyframe(track)
            relative[i] = (live.reference_id, live.relative_pose(track))
            # A keyframe stands where the graph has put it, not where it was tracked.
            assert (live.reference_id == i) == np.array_equal(relative[i][1], np.eye(4))
        T = np.stack([live.submap.resolve_anchor(k, T_kf_cam) for k, T_kf_cam in relative.values()])
        translation, rotation = pose_errors(T, world.T_world_cam[list(relative)])
        assert translation.max() < POSITION_M
        assert rotation.max() < 2 * ROTATION_RAD

    def test_redundant_keyframes_go_and_their_frames_stay_posed(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        for i in range(9, 30):
            live.insert_keyframe(tracked(live, world.view(i)))
        submap = live.submap
        culled = set(range(9, 30)) - set(submap.keyframes)
        assert len(culled) > 3
        assert culled <= set(submap.anchors)
        assert set(submap.gauge) <= set(submap.keyframes)
        assert not culled & set(submap.observations["kf"][submap.observations["alive"]].tolist())
        for k in culled:
            error = se3.log(se3.inverse(submap.resolve_anchor(k, np.eye(4))) @ world.T_world_cam[k])
            assert np.linalg.norm(error[3:]) < POSITION_M

    def test_observations_are_capped_and_spread(self) -> None:
        rng = np.random.default_rng(0)
        crowd, rest = rng.uniform([0, 0], [40, 40], (300, 2)), rng.uniform([40, 40], SIZE_PX, (100, 2))
        uv = np.concatenate([crowd, rest])
        chosen = spread_choice(uv, np.arange(len(uv)), 120, SIZE_PX)
        assert chosen.sum() == 120
        assert chosen[300:].sum() > 60
        # The highest priority of the crowded cell stays.
        assert chosen[299]
        assert spread_choice(uv, np.arange(len(uv)), 400, SIZE_PX).all()


class TestKeyframing:
    def test_standing_still_makes_no_keyframes(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        track = tracked(live, View(9, 0.45, world.view(8).features))
        assert not live.keyframe_due(track)

    def test_moving_on_makes_them(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        due = [i for i in range(9, 40) if live.keyframe_due(tracked(live, world.view(i)))]
        assert due
        assert due[0] > 9

    def test_with_little_parallax_more_has_to_be_lost(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        seen = live.submap.landmark_of[8]
        seen = seen[(seen >= 0) & (live.submap.n_observations(seen) >= 3)]
        config = KeyframeConfig(weak_landmarks=10)
        verdicts = {0.25: (True, True), 0.5: (False, True), 0.65: (False, False)}  # with little, and with much
        for share, (with_little, with_much) in verdicts.items():
            held = seen[: round(share * len(seen))]
            due: dict[bool, set[bool]] = {True: set(), False: set()}
            for i in range(9, 20):
                track = tracked(live, world.view(i))
                ids = np.where(np.isin(track.landmark_ids, seen), NO_LANDMARK, track.landmark_ids)
                ids[np.flatnonzero(ids == NO_LANDMARK)[: len(held)]] = held
                shown = replace(track, landmark_ids=ids)
                parallax = parallax_deg(shown, live.submap, 8)
                if 0.5 < parallax < 1.0 or 1.5 < parallax < config.max_parallax_deg:
                    due[parallax < 1.0].add(bool(keyframe_due(shown, live.submap, 8, config)))
            assert due == {True: {with_little}, False: {with_much}}, share

    def test_a_few_near_landmarks_that_leave_make_one_before_the_scale_is_lost(self, world: PointWorld) -> None:
        """As a bench does at a take-off."""
        live = front_end(world, [0, 4, 8], start_at=8)
        seen = live.submap.landmark_of[8]
        seen = seen[(seen >= 0) & (live.submap.n_observations(seen) >= 3)]
        track = next(
            track for i in range(9, 20) if 1.5 < parallax_deg(track := tracked(live, world.view(i)), live.submap, 8) < 4
        )
        near, far = seen[:12], seen[12:]
        centre = live.submap.T_submap_kf[8][:3, 3]
        xyz = live.submap.landmarks["xyz_mu"]
        xyz[near] = centre + 0.05 * (xyz[near] - centre)

        def due(held: IntArray) -> bool:
            ids = np.full(max(len(track.landmark_ids), len(held)), NO_LANDMARK)
            ids[: len(held)] = held
            shown = replace(track, landmark_ids=ids)
            return bool(keyframe_due(shown, live.submap, 8, KeyframeConfig()))

        assert not due(seen)
        assert not due(np.concatenate([near, far[: 3 * len(far) // 4]])), "the far ones hold little"
        assert not due(np.concatenate([near[:8], far]))
        assert due(np.concatenate([near[:2], far]))

    def test_what_is_not_mapped_and_passes_by_makes_one(self) -> None:
        """A bench below the camera, of which a map of the wall behind it has nothing; the wall hardly moves."""
        rng = np.random.default_rng(0)
        wall = rng.uniform([-40, -22, 45], [40, 2, 55], (400, 3))
        bench = rng.uniform([-2, 0.5, 2], [2, 1.5, 3], (400, 3))
        points = np.stack([wall, bench], axis=1).reshape(-1, 3)
        still, turn, step = path(9, [0.02, 0, 0], [0, 0, 0]), np.array([0, 0.01, 0]), np.array([0.05, 0, 0])

        def due(step_m: FloatArray, turn_rad: FloatArray, every: int) -> list[int]:
            T = np.concatenate([still, still[-1] @ path(6, step_m, turn_rad)[1:]])
            live = front_end(PointWorld(points, T), [0, 4, 8], start_at=8, every=every)
            tracks = [tracked(live, view) for view in PointWorld(points, T).views()[9:]]
            assert all(parallax_deg(track, live.submap, 8) < 0.5 for track in tracks) or every == 1
            return [track.view.index for track in tracks if live.keyframe_due(track)]

        nothing = np.zeros(3)
        assert 9 not in due(step, nothing, every=2)
        assert due(step, nothing, every=2), "only the wall is in the map"
        assert not due(step, nothing, every=1), "the bench is in the map, too"
        assert not due(nothing, turn, every=2), "a turn shows nothing of how far it is"
        assert not due(nothing, nothing, every=2)

    def test_parallax_is_the_angle_of_the_baseline(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        track = tracked(live, world.view(12))
        ids = track.landmark_ids[track.landmark_ids >= 0]
        depth = (live.submap.landmarks["xyz_mu"][ids] @ track.T_cam_submap[2, :3]) + track.T_cam_submap[2, 3]
        baseline = np.linalg.norm(world.T_world_cam[12, :3, 3] - world.T_world_cam[8, :3, 3])
        expected = np.degrees(np.arctan(baseline / np.median(depth)))
        assert parallax_deg(track, live.submap, 8) == pytest.approx(expected, rel=0.1)

    def test_few_landmarks_make_one_at_once(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        track = tracked(live, world.view(9))
        assert keyframe_due(track, live.submap, 8, KeyframeConfig(weak_landmarks=5000))
        assert not keyframe_due(tracked(live, world.view(8)), live.submap, 8, KeyframeConfig(weak_landmarks=5000))

    def test_where_an_earlier_run_has_the_same_in_view_it_is_gone_by(self, world: PointWorld) -> None:
        """A second camera on the way of the first, with numbers of its own; then beyond what that one has seen."""
        config, submap, first_id = Config(), true_map(world, list(range(0, 42, 3))), 100
        graph = ISam2SubmapGraph(config.graph)
        graph.update(submap)
        live = VisualFrontEnd(OrbFrontend(), config, submap, graph, CAMERA, first_id=first_id)
        live.start_at(0)
        due, passed = [], []
        for i in range(80):
            track = tracked(live, replace(world.view(i), index=first_id + i, timestamp_s=world.view(i).timestamp_s))
            if live.keyframe_due(track):
                due.append(i)
                live.insert_keyframe(track)
                continue
            before = live.reference_id
            assert not live.keyframe_due(track)
            assert live.reference_id == before, "to ask changes nothing"
            live.go_by_known(track)
            if live.reference_id < first_id:
                passed.append(live.reference_id)
        assert min(due) > 42, "on the first camera's way there is nothing to add"
        assert len(due) > 2, "beyond it there is"
        assert len(set(passed)) > 4, "one after the other"
        assert len(submap.keyframes) == 14 + len(due) - len(submap.anchors)

    def test_another_run_that_shows_too_little_today_takes_no_keyframe_s_place(self, world: PointWorld) -> None:
        submap = true_map(world, [0, 4, 8])
        live = front_end(world, [0, 4, 8], start_at=8)
        track = tracked(live, replace(world.view(9), index=109))
        assert keyframe_like(track, submap, 100, KeyframeConfig()) in submap.keyframes
        assert keyframe_like(track, submap, 100, KeyframeConfig(weak_landmarks=5000)) is None
        assert keyframe_like(track, submap, 0, KeyframeConfig()) is None, "of this run"
        elsewhere = se3.exp(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0])) @ track.T_cam_submap
        assert keyframe_like(replace(track, T_cam_submap=elsewhere), submap, 100, KeyframeConfig()) is None

    @pytest.mark.filterwarnings("error")
    def test_a_pose_from_elsewhere_without_a_landmark_is_due(self, world: PointWorld) -> None:
        live = front_end(world, [0, 4, 8], start_at=8)
        track = tracked(live, world.view(9))
        unseen = replace(track, landmark_ids=np.full_like(track.landmark_ids, NO_LANDMARK))
        assert parallax_deg(unseen, live.submap, 8) == 0.0
        assert keyframe_due(unseen, live.submap, 8, KeyframeConfig())


def test_local_map_predicts_what_the_camera_sees(world: PointWorld) -> None:
    submap = true_map(world, [0, 4, 8])
    local = LocalMap.of_landmarks(submap, submap.landmarks_of_keyframes([0, 4, 8]))
    T_cam_w = se3.inverse(world.T_world_cam[6])
    prediction = local.predict(T_cam_w, CAMERA.K, CAMERA, 1.2, 8)
    assert len(prediction.rows) > 100
    p = se3.act(T_cam_w, local.xyz_mu[prediction.rows])
    np.testing.assert_allclose(prediction.uv_px, CAMERA.project(p), atol=1e-9)
    behind = se3.inverse(se3.from_parts(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)))
    assert len(local.predict(behind, CAMERA.K, CAMERA, 1.2, 8).rows) == 0
    assert len(local.take(prediction.rows)) == len(prediction.rows)


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(640, 480, 450.0, 450.0, 319.5, 239.5),
        RadTanCamera(752, 480, 458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        RadTanCamera(640, 480, 517.3, 516.5, 318.6, 255.3, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
        KannalaBrandtCamera(1280, 720, 600.0, 600.0, 639.5, 359.5, 0.02, -0.005, 0.0, 0.0),
    ],
    ids=["pinhole", "barrel", "pincushion", "fisheye"],
)
def test_what_the_image_shows_is_looked_for_to_its_rim(camera: Camera) -> None:
    """A quarter to a third of what a barrel or a fisheye shows lies beyond a rectangle of the raw image's size."""
    rng = np.random.default_rng(0)
    angle, about = np.radians(79.0) * np.sqrt(rng.random(4000)), rng.uniform(-np.pi, np.pi, 4000)
    xyz = np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
    distance = rng.uniform(2, 8, len(xyz))
    local = LocalMap(np.arange(len(xyz)), distance[:, None] * xyz, -xyz, distance, np.zeros((len(xyz), 32), np.uint8))
    uv = camera.project(xyz)
    shown = np.flatnonzero(((uv >= 0) & (uv <= np.array(camera.size_px) - 1)).all(axis=1))
    assert np.array_equal(local.predict(np.eye(4), camera.K, camera, 1.2, 8).rows, shown)


def matches_of_a_cloud(n: int, share_wrong: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a pose, points and their pixels with half a pixel of noise; some of these belong to other points."""
    rng = np.random.default_rng(0)
    xyz = cloud(n)
    T_w_cam: FloatArray = path(2, np.array([0.5, 0.2, 0.3]), np.array([0.1, 0.2, 0.3]))[1]
    p = se3.act(se3.inverse(T_w_cam), xyz)
    uv = CAMERA.project(p) + 0.5 * rng.normal(size=(len(xyz), 2))
    wrong = rng.random(len(xyz)) < share_wrong
    uv[wrong] = rng.uniform([0, 0], SIZE_PX, (int(wrong.sum()), 2))
    return T_w_cam, xyz, uv


@pytest.mark.parametrize("share_wrong", [0.0, 0.5])
def test_resection_needs_no_guess(share_wrong: float) -> None:
    T_w_cam, xyz, uv = matches_of_a_cloud(300, share_wrong)
    found = resect(CAMERA.K, SIZE_PX, uv, xyz, 0.5, 0)
    error = se3.log(found.T_cam_w @ T_w_cam)
    assert np.linalg.norm(error[3:]) < POSITION_M
    assert np.linalg.norm(error[:3]) < ROTATION_RAD
    assert np.array_equal(found.T_cam_w, resect(CAMERA.K, SIZE_PX, uv, xyz, 0.5, 0).T_cam_w)


@pytest.mark.parametrize("share_wrong", [0.5, 0.7, 0.8])
def test_a_pose_without_a_guess_is_refined_from_what_agrees(share_wrong: float) -> None:
    """Huber's weights alone leave the right pose where most matches are wrong."""
    T_w_cam, xyz, uv = matches_of_a_cloud(120, share_wrong)
    found = estimate_pose(CAMERA.K, SIZE_PX, uv, xyz, np.full(len(xyz), 0.5), 0)
    assert not isinstance(found, Failure)
    error = se3.log(found.T_cam_w @ T_w_cam)
    assert np.linalg.norm(error[3:]) < 3 * POSITION_M
    assert np.linalg.norm(error[:3]) < 3 * ROTATION_RAD
    assert found.n_inliers > 0.8 * (1 - share_wrong) * len(xyz)
