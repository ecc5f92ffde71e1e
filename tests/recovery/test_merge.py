"""A walk's additions and refusals come into the map as it is by then, and its frames into that map's unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Features, FrameStatus
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.frame_records import FrameRow
from dualslam.map.split import submap_of
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.recovery.fusion import pose_frames
from dualslam.recovery.job import RecoveredFrame
from dualslam.recovery.merge import Merged, merge_recovery
from dualslam.testing.graph_scene import guessed_submap, make_scene

SCALE, T = 2.5, se3.exp([0.3, -0.2, 0.1, 2.0, 0.0, -1.0])
S_LIVE_GROWN = sim3.from_parts(SCALE, T[:3, :3], T[:3, 3])


def merged() -> tuple[Merged, Submap, np.ndarray]:
    """A walk that has refused three observations, in a map that has another frame and unit since; and their rows."""
    base = guessed_submap(make_scene(6), pose_noise=0.0)
    grown, live = base.copy(), base.copy()
    refused = np.flatnonzero(base.observations["alive"] & (base.observations["kf"] == 3))[[4, 40, 70]]
    grown.remove_observations(refused)
    live.transform(SCALE, T)
    return merge_recovery(live, base, grown), grown, refused


def test_what_the_walk_has_refused_is_no_observation_any_more_and_all_else_is() -> None:
    result, grown, refused = merged()
    np.testing.assert_allclose(result.S_live_grown, S_LIVE_GROWN, atol=1e-9)
    alive = result.submap.observations["alive"]
    assert not alive[refused].any()
    seen_still = result.submap.landmarks["alive"][result.submap.observations["landmark"]]
    others = np.setdiff1d(np.flatnonzero(grown.observations["alive"] & seen_still), refused)
    assert alive[others].all()


def test_what_the_walk_has_refused_is_found_by_what_it_is_where_the_map_numbers_its_rows_anew() -> None:
    result, grown, refused = merged()
    base = guessed_submap(make_scene(6), pose_noise=0.0)
    live = base.copy()
    live.transform(SCALE, T)
    dead = np.flatnonzero(base.observations["kf"] == 2)[::3]  # the map has dropped these itself, and forgotten them
    live.remove_observations(dead)
    live.keep_observations(np.flatnonzero(live.observations["alive"]))
    again = merge_recovery(live, base, grown).submap
    assert len(again.observations) == len(base.observations) - len(dead)
    obs = result.submap.observations
    wanted = seen_in(result.submap, np.setdiff1d(np.flatnonzero(obs["alive"]), dead))
    dying = {j for j in range(len(base.landmarks)) if not again.landmarks["alive"][j]}  # of one view now
    assert seen_in(again, np.flatnonzero(again.observations["alive"])) == {o for o in wanted if o[2] not in dying}
    assert not seen_in(base, refused) & seen_in(again, np.flatnonzero(again.observations["alive"]))


def seen_in(submap: Submap, rows: np.ndarray) -> set[tuple[int, int, int]]:
    columns = (submap.observations[name][rows].tolist() for name in ("kf", "feature", "landmark"))
    return set(zip(*columns, strict=True))


def test_frames_of_the_walk_are_posed_in_the_unit_of_the_map_and_only_where_they_had_no_pose() -> None:
    result, grown, _ = merged()
    record = Record()
    record.atlas.add(result.submap)
    T_kf_cam = se3.exp([0.0, 0.1, 0.0, 0.05, 0.0, 0.1])
    frames = [RecoveredFrame(FramePose(i, 0.1 * i, grown.id, 2, T_kf_cam), 90, 80) for i in (100, 101)]
    for i in (100, 101):
        record.rows[i] = FrameRow(i, 0.1 * i, FrameStatus.INITIALISING)
    known = FramePose(101, 10.1, 7, 0, np.eye(4))
    record.pose(known)
    posed = pose_frames(record, frames, result, result.submap)
    in_grown = grown.resolve_anchor(2, T_kf_cam)
    for frame in posed:
        in_map = result.submap.resolve_anchor(frame.pose.keyframe_id, frame.pose.T_kf_cam)
        np.testing.assert_allclose(in_map, sim3.act_on_pose(S_LIVE_GROWN, in_grown), atol=1e-9)
    assert record.poses[100] is posed[0].pose
    assert record.rows[100].status is FrameStatus.TRACKED
    assert record.poses[101] is known


def test_landmarks_of_the_walk_are_known_by_what_they_have_become() -> None:
    """A new one, one that became the same as a new one, one that became an old one, and one that has died."""
    base = guessed_submap(make_scene(6), pose_noise=0.0)
    for k in (2, 3):  # features to spare
        base.remove_observations(np.flatnonzero(base.observations["kf"] == k)[-5:])
    grown, n = base.copy(), len(base.landmarks)
    old = np.flatnonzero(base.landmarks["alive"])[:5]
    new = grown.copy_landmarks(base, old)
    for k in (2, 3):
        feature = np.flatnonzero(grown.landmark_of[k] < 0)[: len(new)]
        grown.add_observations(k, feature, new)
    grown.merge_landmarks(new[:1], new[1:2])
    grown.merge_landmarks(old[2:3], new[2:3])
    grown.remove_landmarks(new[3:4])
    result = merge_recovery(base.copy(), base, grown)
    known = result.id_of[new]
    assert known[0] == known[1] >= n
    assert known[2] == old[2]
    assert known[3] == NO_LANDMARK
    assert known[4] > n
    np.testing.assert_array_equal(result.id_of[:n], result.submap.current_ids(np.arange(n)))


def test_a_walk_of_the_camera_of_before_gets_the_pixels_of_the_present_one() -> None:
    """Its keyframes at once, what its frames have seen when it is asked for."""
    scene = make_scene(6)
    whole = guessed_submap(scene, pose_noise=0.0)
    base = submap_of(whole, 0, [0, 1, 2, 3])
    grown = base.copy()
    grown.add_keyframe(scene.keyframe(4), whole.T_submap_kf[4])

    def aside(features: Features) -> Features:
        return replace(features, uv_rect_px=features.uv_rect_px + [4.0, 0.0])

    result = merge_recovery(base.copy(), base, grown, aside)
    then, now = scene.features[4].uv_rect_px, result.submap.keyframes[4].features.uv_rect_px
    np.testing.assert_allclose(now, then + [4.0, 0.0])
    assert result.submap.keyframes[3].features is base.keyframes[3].features
    record, seen = Record(), FrameObservations.of(base.keyframes[3].features, base.landmark_of[3], base.id)
    record.rows[100] = FrameRow(100, 10.0, FrameStatus.INITIALISING)
    frame = RecoveredFrame(FramePose(100, 10.0, grown.id, 3, np.eye(4)), 90, 80, seen)
    pose_frames(record, [frame], result, result.submap, aside)
    np.testing.assert_allclose(record.observations[100].uv_rect_now_px(), seen.uv_rect_px + [4.0, 0.0])
