"""Refinding: on a rendered street, landmarks from before a gap are found beyond it, where truth says that they are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from dualslam.core.camera.base import rectify
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.projection import project_points
from dualslam.core.grey_image import GreyImage
from dualslam.core.types import FloatArray, Keyframe, Track, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.gap import refinding
from dualslam.frontends.gap.refinding import FAR_KEYFRAMES, Refinder
from dualslam.frontends.tracking.turning import straighten
from dualslam.lab.synthetic import SyntheticSequence, make_sequence
from dualslam.map.submap import NO_LANDMARK, Submap

N_FEATURES = 600
FAR, RIM, AHEAD = 39, 50, (53, 56, 59)
"""The camera drives 10 m between the first two: it is at half the distance from much of what it sees."""
MODEL_SIGMA_PX = 0.8
TRUE_PLACE_PX = 2.0
MANY = 80
"""ORB finds 60 points again between two such frames, of 600."""
POSE_OFF_M, POSE_OFF_RAD = 0.3, 0.01


@cache
def street() -> SyntheticSequence:
    """Make the world."""
    return make_sequence("street", 60, 0, 320, 240)


def view_of(index: int) -> View:
    """Render a frame and find its features."""
    image = GreyImage.of(street().frame(index).image)
    features = rectify(OrbFrontend(N_FEATURES).extract(image.pixels()), street().camera, MODEL_SIGMA_PX)
    return View(index, index / 10.0, features, image)


def true_map() -> tuple[Submap, Refinder]:
    """Make a submap of what the rim sees, in its true place, seen by frames ahead as well, and what knows its image."""
    world, view = street(), view_of(RIM)
    submap = Submap(0, world.camera.K, view.features.descriptors[0])
    column, row = np.rint(view.features.uv_px).astype(int).T
    z = world.depth(RIM)[row, column].astype(float)
    seen = np.flatnonzero(np.isfinite(z))
    features = view.features.take(seen)
    rays = np.column_stack([(features.uv_rect_px - submap.K[:2, 2]) / submap.K[0, 0], np.ones(len(seen))])
    T = world.ground_truth_T_world_cam[RIM]
    xyz = (rays * z[seen, None]) @ T[:3, :3].T + T[:3, 3]
    for index in (RIM, *AHEAD):
        T_true = world.ground_truth_T_world_cam[index]
        uv, depth = project_points(submap.K, se3.inverse(T_true), xyz)
        here = replace(features, uv_px=uv, uv_rect_px=uv) if index != RIM else features
        submap.add_keyframe(Keyframe(index, index / 10.0, here), T_true)
        if index == RIM:
            submap.add_landmarks(xyz, features.descriptors, features.scale, RIM)
        inside = (depth > 0) & ((uv > 0) & (uv < (320, 240))).all(axis=1)
        submap.add_observations(index, np.flatnonzero(inside), np.flatnonzero(inside))
    refinder = Refinder(submap, OrbFrontend(N_FEATURES), lambda: world.camera, MODEL_SIGMA_PX)
    refinder.remember(view)
    return submap, refinder


def track_of(view: View, T_cam_submap: FloatArray, ahead_m: float = POSE_OFF_M / 2) -> Track:
    """Pose a frame without any landmark, known so well that `nearly` is two standard deviations off."""
    ids = np.full(len(view.features), NO_LANDMARK, np.int64)
    covariance = np.diag([(POSE_OFF_RAD / 2) ** 2] * 3 + [0.1**2, 0.1**2, ahead_m**2])
    return Track(view, T_cam_submap, T_cam_submap, ids, np.zeros(0, np.int64), 0, 0, 1.0, True, covariance)


def depths_of_found(submap: Submap, track: Track) -> FloatArray:
    """Return how far away the landmarks are that a frame was found to see."""
    return submap.depths(track.landmark_ids[track.landmark_ids >= 0], track.T_cam_submap)


def nearly(T_cam_submap: FloatArray) -> FloatArray:
    """Return a pose that is as wrong as one that few matches gave."""
    return se3.exp(np.array([0, POSE_OFF_RAD, 0, 0, 0, POSE_OFF_M])) @ T_cam_submap


def test_landmarks_are_found_beyond_a_gap() -> None:
    submap, refinder = true_map()
    view, T_true = view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR])
    refinder.begin(FAR)
    before = track_of(view, nearly(T_true))
    track = refinder.extend(before, pose_is_given=True)
    found = np.flatnonzero(track.landmark_ids >= 0)
    assert len(found) > MANY
    uv, _ = project_points(submap.K, T_true, submap.landmarks["xyz_mu"][track.landmark_ids[found]])
    error = np.linalg.norm(uv - track.view.features.uv_rect_px[found], axis=1)
    assert (error < TRUE_PLACE_PX).mean() > 0.9
    off = track.T_cam_submap @ se3.inverse(T_true)
    assert np.linalg.norm(off[:3, 3]) < POSE_OFF_M / 2
    assert so3.rotation_angle(off[:3, :3]) < POSE_OFF_RAD / 2
    # What the frame had stands first, as it was.
    assert track.view.features.n_common(view.features) == len(view.features)
    assert len(np.unique(track.landmark_ids[found])) == len(found)


def test_a_wrong_pose_finds_nothing_to_hold_on_to() -> None:
    _, refinder = true_map()
    T_true = se3.inverse(street().ground_truth_T_world_cam[FAR])
    refinder.begin(FAR)
    wrong = track_of(view_of(FAR), se3.exp(np.array([0, 0.2, 0, 0, 0, 0])) @ T_true)
    track = refinder.extend(wrong, pose_is_given=True)
    assert np.count_nonzero(track.landmark_ids >= 0) < 10


def test_landmarks_whose_depth_is_hardly_known_are_not_looked_for() -> None:
    submap, refinder = true_map()
    rows = np.flatnonzero(np.isin(submap.observations["kf"], AHEAD[1:]))
    submap.remove_observations(rows)
    T_rim, T_next = (submap.T_submap_kf[k] for k in (RIM, AHEAD[0]))
    T_next[:3, 3] = T_rim[:3, 3] + 0.1 * (T_next[:3, 3] - T_rim[:3, 3])  # so near that nothing has parallax
    refinder.begin(FAR)
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]))
    track = refinder.extend(track, pose_is_given=True)
    assert np.count_nonzero(track.landmark_ids >= 0) < MANY / 10


def test_what_is_near_waits_until_the_pose_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    # A metre off along the road moves what is 10 m away by more than is searched, and what is 50 m away by less.
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]), ahead_m=1.0)
    nearest = []
    for rounds in (1, refinding.ROUNDS):
        monkeypatch.setattr(refinding, "ROUNDS", rounds)
        submap, refinder = true_map()
        refinder.begin(FAR)
        depths = depths_of_found(submap, refinder.extend(track, pose_is_given=True))
        nearest.append(np.percentile(depths, 10))
        assert len(depths) > MANY / 4
    assert nearest[1] < 0.8 * nearest[0]


def test_a_tracked_frame_is_searched_for_all_that_it_may_show() -> None:
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]), ahead_m=1.0)
    found = []
    for is_relocalised in (True, False):
        submap, refinder = true_map()
        refinder.begin(FAR)
        found.append(len(depths_of_found(submap, refinder.extend(track, pose_is_given=is_relocalised))))
    assert found[1] >= found[0] > MANY / 4


def test_a_few_keyframes_beyond_a_gap_are_searched_and_no_others() -> None:
    _, refinder = true_map()
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]))
    assert refinder.extend(track) is track
    refinder.begin(FAR)
    for _ in range(FAR_KEYFRAMES):
        assert len(refinder.extend(track, pose_is_given=True).view.features) > len(track.view.features)
    assert refinder.extend(track) is track


def test_a_frame_without_an_image_is_left_alone() -> None:
    _, refinder = true_map()
    refinder.begin(FAR)
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]))
    without = replace(track, view=replace(track.view, image=None))
    assert refinder.extend(without) is without


def read_while_turning(view: View, turn_rad: FloatArray) -> View:
    """Return a view whose image was read row by row meanwhile, and whose features do not show that any more."""
    camera, image = street().camera, view.image
    assert image is not None
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    shown = straighten(np.column_stack([u.ravel(), v.ravel()]).astype(float), camera, turn_rad)
    at = [np.asarray(each.reshape(camera.height, camera.width), np.float32) for each in shown.T]
    bent = cv2.remap(image.pixels(), at[0], at[1], cv2.INTER_LINEAR)
    return replace(view, image=GreyImage.of(bent), turn_rad=turn_rad)


@pytest.mark.parametrize("turned", ["frame", "keyframe", "both"])
def test_what_a_rolling_shutter_shows_elsewhere_is_looked_for_there(turned: str) -> None:
    turn_rad = np.array([0.01, 0.05, -0.03])
    submap, refinder = true_map()
    view, T_true = view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR])
    if turned != "frame":
        refinder.remember(read_while_turning(view_of(RIM), turn_rad))
    if turned != "keyframe":
        view = read_while_turning(view, turn_rad)
    refinder.begin(FAR)
    track = refinder.extend(track_of(view, nearly(T_true)), pose_is_given=True)
    found = np.flatnonzero(track.landmark_ids >= 0)
    assert len(found) > MANY
    uv, _ = project_points(submap.K, T_true, submap.landmarks["xyz_mu"][track.landmark_ids[found]])
    error = np.linalg.norm(uv - track.view.features.uv_rect_px[found], axis=1)
    assert (error < TRUE_PLACE_PX).mean() > 0.9


def test_keyframes_whose_features_have_moved_are_not_looked_at() -> None:
    _, refinder = true_map()
    refinder.forget([RIM])
    refinder.begin(FAR)
    track = track_of(view_of(FAR), se3.inverse(street().ground_truth_T_world_cam[FAR]))
    assert refinder.extend(track) is track
