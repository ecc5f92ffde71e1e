"""What a frame has seen poses it anew: in landmarks that have moved, merged or died, and in other pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.endings import part_off
from dualslam.atlas.propagation import pose_frames_anew, rows_of_frames
from dualslam.atlas.record import MAX_OBSERVED, Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import settle_poses
from dualslam.core.types import Features, FrameStatus
from dualslam.linking.correspondences import landmarks_shown_in
from dualslam.map.frame_observations import FrameObservations, seen_now
from dualslam.map.frame_records import FrameRow
from dualslam.map.split import submap_of
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.testing.graph_scene import guessed_submap, make_features, make_scene

N, FRAME = 8, 100
OFF = se3.exp([0.01, -0.02, 0.01, 0.05, -0.03, 0.04])


def seen_by_a_frame(noise_px: float = 0.0, seed: int = 0) -> tuple[Submap, FrameObservations, np.ndarray]:
    """A true map, what a frame between two of its keyframes sees of it, and where that frame is."""
    scene = make_scene(N, 100, 0.0)
    submap = guessed_submap(scene, pose_noise=0.0, point_noise=0.0)
    T = scene.T_true[4] @ se3.exp([0.01, 0.0, 0.0, 0.02, 0.01, 0.0])
    ids = np.flatnonzero(submap.landmarks["alive"])
    xyz_cam = se3.act(se3.inverse(T), submap.landmarks["xyz_mu"][ids])
    ids, xyz_cam = ids[xyz_cam[:, 2] > 0.1], xyz_cam[xyz_cam[:, 2] > 0.1]
    uv = xyz_cam @ submap.K.T
    uv = uv[:, :2] / uv[:, 2:] + np.random.default_rng(seed).normal(0, max(noise_px, 1e-9), (len(ids), 2))
    features = make_features(np.concatenate([uv, uv[:5] + 3.0]), np.ones(len(uv) + 5), np.zeros(len(uv) + 5, np.int64))
    landmark_ids = np.concatenate([ids, np.full(5, NO_LANDMARK)])
    return submap, FrameObservations.of(features, landmark_ids, submap.id), T


def posed(
    seen: FrameObservations, submap: Submap, T_submap_cam: np.ndarray, shape: float, min_inliers: int
) -> np.ndarray:
    """Where a frame is by what it sees; NaN where that does not tell."""
    frame, ids, *pixels = seen_now([seen], submap)
    start, xyz_mu = se3.inverse(T_submap_cam)[None], submap.landmarks["xyz_mu"][ids]
    (T_cam_submap,) = settle_poses(submap.K, start, frame, xyz_mu, *pixels, shape=shape, min_inliers=min_inliers)
    return se3.inverse(T_cam_submap)


def off_by(T: np.ndarray, T_true: np.ndarray) -> float:
    return float(np.abs(se3.log(se3.inverse(T_true) @ T)).max())


def test_features_without_a_landmark_are_not_kept() -> None:
    submap, seen, _ = seen_by_a_frame()
    assert len(seen.landmark_ids) == len(seen.uv_px) > 50
    assert (seen.landmark_ids != NO_LANDMARK).all()
    assert seen.submap_id == submap.id


def test_a_frame_that_was_posed_wrongly_is_posed_by_the_landmarks_as_they_are() -> None:
    submap, seen, T = seen_by_a_frame()
    assert off_by(posed(seen, submap, T @ OFF, 0.4, 25), T) < 1e-4


def test_a_frame_goes_along_with_its_landmarks() -> None:
    submap, seen, T = seen_by_a_frame()
    submap.transform(1.0, OFF)
    assert off_by(posed(seen, submap, T, 0.4, 25), OFF @ T) < 1e-4


def test_a_frame_of_a_bent_map_is_posed_by_what_a_right_one_shows_in_the_same_keyframes() -> None:
    submap, seen, T = seen_by_a_frame()
    bent = submap.copy()
    bent.id = 1
    bent.landmarks["xyz_mu"][:] *= [1.0, 1.0, 1.5]
    n = len(submap.landmarks)
    for k, ids in submap.landmark_of.items():
        submap.landmark_of[k] = np.where(ids == NO_LANDMARK, NO_LANDMARK, n - 1 - ids)
    submap.landmarks["xyz_mu"][:] = submap.landmarks["xyz_mu"][::-1].copy()  # the same map by other numbers
    unknown = seen.landmark_ids[0]
    for ids in bent.landmark_of.values():
        ids[ids == unknown] = NO_LANDMARK
    there = seen.in_submap(submap.id, landmarks_shown_in(submap, bent))
    assert len(there.landmark_ids) == len(seen.landmark_ids) - 1
    assert off_by(posed(there, submap, T @ OFF, 0.4, 25), T) < 1e-4


def test_outliers_have_no_say_under_the_loss_that_the_map_has() -> None:
    submap, seen, T = seen_by_a_frame(noise_px=0.05)
    uv_rect_px = seen.uv_rect_px.copy()
    uv_rect_px[::4] += [3.0, 0.0]
    seen = replace(seen, uv_rect_px=uv_rect_px)
    loose, tight = (off_by(posed(seen, submap, T, shape, 25), T) for shape in (40.0, 0.2))
    assert tight < 0.2 * loose


def test_dead_landmarks_are_passed_over_and_too_few_pose_nothing() -> None:
    submap, seen, T = seen_by_a_frame()
    submap.landmarks["xyz_mu"][seen.landmark_ids[:40]] += 1.0  # wrong, and dead for it
    submap.remove_landmarks(seen.landmark_ids[:40].astype(np.int64))
    assert off_by(posed(seen, submap, T @ OFF, 0.4, 25), T) < 1e-4
    submap.remove_landmarks(seen.landmark_ids[:-24].astype(np.int64))
    assert np.isnan(posed(seen, submap, T, 0.4, 25)[:3]).all()


def test_merged_landmarks_are_followed() -> None:
    submap, seen, T = seen_by_a_frame()
    old = seen.landmark_ids[:30].astype(np.int64)
    new = submap.copy_landmarks(submap, old)
    submap.landmarks["xyz_mu"][old] += 1.0
    submap.merge_landmarks(new, old)
    n_all = len(seen.landmark_ids)
    assert off_by(posed(seen, submap, T, 0.4, n_all), T) < 1e-4


def test_in_another_state_of_the_submap_landmarks_have_other_numbers_or_none() -> None:
    submap, seen, T = seen_by_a_frame()
    n = len(submap.landmarks)
    id_of = np.full(n, NO_LANDMARK)
    id_of[seen.landmark_ids[5:]] = submap.copy_landmarks(submap, seen.landmark_ids[5:].astype(np.int64))
    there = seen.in_submap(7, id_of)
    assert there.submap_id == 7
    assert len(there.landmark_ids) == len(there.uv_px) == len(there.sigma_px) == len(seen.landmark_ids) - 5
    assert there.landmark_ids.min() >= n
    assert off_by(posed(there, submap, T @ OFF, 0.4, 25), T) < 1e-4


def test_pixels_follow_all_changes_of_the_camera_in_turn() -> None:
    submap, seen, T = seen_by_a_frame()

    def aside(features: Features) -> Features:
        return replace(features, uv_rect_px=features.uv_rect_px + [4.0, 0.0])

    def doubled(features: Features) -> Features:
        return replace(features, uv_rect_px=2.0 * features.uv_rect_px)

    submap.K = np.diag([2.0, 2.0, 1.0]) @ submap.K
    submap.K[0, 2] += 8.0
    assert off_by(posed(seen.with_change(aside).with_change(doubled), submap, T @ OFF, 0.4, 25), T) < 1e-4


def record_of(submap: Submap, seen: FrameObservations, T_submap_cam: np.ndarray, keyframe_id: int = 4) -> Record:
    record = Record()
    record.atlas.add(submap)
    T_kf_cam = se3.inverse(submap.T_submap_kf[keyframe_id]) @ T_submap_cam
    record.rows[FRAME] = FrameRow(FRAME, 10.0, FrameStatus.INITIALISING)
    record.pose(FramePose(FRAME, 10.0, submap.id, keyframe_id, T_kf_cam), 90, 80, seen)
    return record


def test_frames_are_posed_anew_and_keep_their_rows() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T @ OFF)
    assert pose_frames_anew(record, submap, 0.4, 25) == 1
    pose = record.poses[FRAME]
    assert off_by(submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam), T) < 1e-4
    assert record.rows[FRAME].n_inliers == 80


def test_a_frame_of_a_culled_keyframe_is_posed_against_the_one_that_stands_for_it() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T @ OFF)
    submap.remove_keyframe(4, 3)
    assert pose_frames_anew(record, submap, 0.4, 25) == 1
    assert record.poses[FRAME].keyframe_id == 3
    assert off_by(submap.T_submap_kf[3] @ record.poses[FRAME].T_kf_cam, T) < 1e-4


@pytest.mark.parametrize("why", ["keyframe", "no pose", "in another submap", "seen in another submap"])
def test_what_is_no_frame_of_the_submap_stays(why: str) -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T @ OFF)
    if why == "keyframe":
        submap.keyframes[FRAME] = submap.keyframes[4]
    elif why == "no pose":
        del record.poses[FRAME]
    elif why == "in another submap":
        record.poses[FRAME] = replace(record.poses[FRAME], submap_id=5)
    else:
        record.observations[FRAME] = replace(seen, submap_id=5)
    before = dict(record.poses)
    assert pose_frames_anew(record, submap, 0.4, 25) == 0
    assert record.poses == before


def test_a_new_pose_takes_the_place_of_what_the_one_before_went_by() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T)
    assert record.observations[FRAME] is seen
    record.pose(record.poses[FRAME])
    assert FRAME not in record.observations


def test_of_a_long_run_the_newest_frames_are_kept() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T)
    pose = record.poses[FRAME]
    for i in range(FRAME + 1, FRAME + MAX_OBSERVED + 3):
        record.rows[i] = FrameRow(i, 0.1 * i, FrameStatus.INITIALISING)
        record.pose(replace(pose, index=i), observations=seen)
    assert sorted(record.observations) == list(range(FRAME + 3, FRAME + MAX_OBSERVED + 3))


def test_pixels_change_in_the_frames_of_the_submap_that_changes_and_where_it_is_known_how() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T)
    record.observations.update({FRAME + 1: seen, FRAME + 2: replace(seen, submap_id=5)})
    record.change_pixels(submap.id, {FRAME: lambda features: features, FRAME + 2: lambda features: features}.get)
    assert [len(record.observations[FRAME + i].changes) for i in range(3)] == [1, 0, 0]


def test_frames_that_go_over_to_a_part_of_the_map_take_along_what_they_have_seen() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T @ OFF, keyframe_id=5)
    part = submap_of(submap, 1, [3, 4, 5, 6, 7])
    part_off(record, submap, part, 2)
    assert record.observations[FRAME].submap_id == 1
    assert 50 < len(record.observations[FRAME].landmark_ids) <= len(seen.landmark_ids)
    assert pose_frames_anew(record, part, 0.4, 25) == 1
    pose = record.poses[FRAME]
    assert off_by(part.resolve_anchor(pose.keyframe_id, pose.T_kf_cam), T) < 1e-4


def test_frames_are_chosen_evenly_and_only_those_that_have_seen_enough() -> None:
    submap, seen, T = seen_by_a_frame()
    record = record_of(submap, seen, T)
    few = replace(
        seen,
        landmark_ids=seen.landmark_ids[:9],
        uv_px=seen.uv_px[:9],
        uv_rect_px=seen.uv_rect_px[:9],
        sigma_px=seen.sigma_px[:9],
    )
    for i in range(FRAME + 1, FRAME + 9):
        T_kf_cam = se3.exp([0.0, 0.0, 0.0, 0.1 * (i - FRAME), 0.0, 0.0])
        record.rows[i] = FrameRow(i, 0.1 * i, FrameStatus.INITIALISING)
        record.pose(FramePose(i, 0.1 * i, submap.id, 4, T_kf_cam), observations=few if i == FRAME + 8 else seen)
    rows = rows_of_frames(record, submap, 3, 25)
    assert len(rows.T_submap_cam) == 2  # of the first, the middle and the last, which has seen too little
    np.testing.assert_allclose(rows.T_submap_cam[0], T, atol=1e-12)
    T_middle = submap.T_submap_kf[4] @ se3.exp([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    np.testing.assert_allclose(rows.T_submap_cam[1], T_middle, atol=1e-12)
    n = len(seen.landmark_ids)
    np.testing.assert_array_equal(rows.frame, np.repeat([0, 1], n))
    np.testing.assert_array_equal(rows.landmark_ids[:n], seen.landmark_ids)
    np.testing.assert_allclose(rows.uv_px[n:], seen.uv_rect_px)
    assert len(rows_of_frames(Record(), submap, 3, 25).T_submap_cam) == 0


def test_a_landmark_that_two_have_become_is_seen_once() -> None:
    submap, seen, _ = seen_by_a_frame()
    a, b = seen.landmark_ids[:2].astype(np.int64)
    submap.merge_landmarks(np.array([a]), np.array([b]))
    _, ids, uv_px, sigma_px = seen_now([seen], submap)
    assert len(ids) == len(uv_px) == len(sigma_px) == len(seen.landmark_ids) - 1
    assert ids[0] == a
    np.testing.assert_allclose(uv_px[0], seen.uv_rect_px[0])


def test_many_frames_tell_what_each_of_them_tells() -> None:
    """Whatever their pixels went through: frames with the same changes are taken together."""
    submap, seen, _ = seen_by_a_frame()

    def aside(features: Features) -> Features:
        return replace(features, uv_rect_px=features.uv_rect_px + [4.0, 0.0])

    moved = seen.with_change(aside)
    number = np.arange(len(submap.landmarks))
    fewer = seen.in_submap(submap.id, np.where(number % 2, number, NO_LANDMARK))
    frames = [seen, moved, moved, seen, fewer, fewer.with_change(aside)]
    each = [seen_now([one], submap) for one in frames]
    together = seen_now(frames, submap)
    np.testing.assert_array_equal(together[0], np.repeat(np.arange(6), [len(one[0]) for one in each]))
    for of_all, *of_each in zip(together[1:], *(one[1:] for one in each), strict=True):
        np.testing.assert_array_equal(of_all, np.concatenate(of_each))
