"""Landmarks are matched through shared keyframes: by keypoint, by descriptor, one to one."""

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.types import Features, Keyframe
from dualslam.linking import DescriptorMatcher, propose_correspondences
from dualslam.linking.correspondences import shared_keyframes
from dualslam.testing.link_worlds import FRAME_STEP, Case, hamming, make_case, make_world

MATCHER = DescriptorMatcher(hamming, 64.0)
SEED, LAYOUT = 3, "street"


@pytest.fixture
def case() -> Case:
    return make_case(LAYOUT, SEED, outliers=0.0)


def point_of_landmark(submap, ids):
    """The world's point of each landmark, by the feature of its first observation in an untouched keyframe."""
    world = make_world(LAYOUT, SEED)
    obs, points = submap.observations, []
    for j in ids.tolist():
        row = int(np.flatnonzero(obs["landmark"] == j)[0])
        frame = int(obs["kf"][row]) // FRAME_STEP
        points.append(int(np.flatnonzero(world.feature_of[frame] == obs["feature"][row])[0]))
    return np.array(points)


def shuffle_features(submap, keyframe_ids, rng, jitter_px):
    """As if another run of the detector had made the new map's features: other order, other scatter."""
    for k in keyframe_ids:
        f = submap.keyframes[k].features
        order = rng.permutation(len(f))
        moved = f.take(order)
        uv = moved.uv_rect_px + jitter_px * rng.normal(size=(len(f), 2))
        submap.keyframes[k] = Keyframe(k, 0.0, replace(moved, uv_px=uv, uv_rect_px=uv))
        submap.landmark_of[k] = submap.landmark_of[k][order]
        inverse = np.argsort(order)
        rows = np.flatnonzero(submap.observations["kf"] == k)
        submap.observations["feature"][rows] = inverse[submap.observations["feature"][rows]]


def test_pairs_by_identity_are_the_same_points(case):
    pairs = propose_correspondences(case.old, case.new)
    assert len(pairs) > 200
    assert pairs.shared_pixel.all()
    a, b = point_of_landmark(case.old, pairs.landmark_old), point_of_landmark(case.new, pairs.landmark_new)
    assert np.array_equal(a, b)


def test_features_that_only_one_map_has_found_stand_apart(case):
    """A keyframe may hold more features in one map: no row behind the common ones means the same point in both."""
    n_before = len(propose_correspondences(case.old, case.new))
    for submap, shift in ((case.old, 40.0), (case.new, 70.0)):
        for k in shared_keyframes(case.old, case.new):
            f = submap.keyframes[k].features
            more = f.take(np.arange(5 if submap is case.old else 9))
            uv = more.uv_px + shift
            columns = {
                name: np.concatenate([getattr(f, name), getattr(replace(more, uv_px=uv, uv_rect_px=uv), name)])
                for name in ("uv_px", "uv_rect_px", "sigma_px", "scale", "octave", "angle_rad", "descriptors")
            }
            submap.keyframes[k] = Keyframe(k, 0.0, Features(**columns))
            ids = np.setdiff1d(np.flatnonzero(submap.landmarks["alive"]), submap.landmark_of[k])[: len(more)]
            submap.landmark_of[k] = np.concatenate([submap.landmark_of[k], np.full(len(more), -1)])
            submap.add_observations(k, len(f) + np.arange(len(ids)), ids)
    pairs = propose_correspondences(case.old, case.new)
    assert len(pairs) > 0.98 * n_before
    a, b = point_of_landmark(case.old, pairs.landmark_old), point_of_landmark(case.new, pairs.landmark_new)
    assert np.array_equal(a, b)


def test_pairs_are_one_to_one_and_views_belong_to_them(case):
    pairs = propose_correspondences(case.old, case.new, MATCHER)
    assert len(np.unique(pairs.landmark_old)) == len(np.unique(pairs.landmark_new)) == len(pairs)
    assert np.bincount(pairs.view_pair, minlength=len(pairs)).min() >= 1
    assert np.bincount(pairs.view_pair).max() > 3  # several keyframes, one pair
    ids = pairs.keyframes[pairs.view_keyframe]
    for v in range(0, len(ids), 37):
        k, pair = int(ids[v]), pairs.view_pair[v]
        for submap, landmark in ((case.old, pairs.landmark_old), (case.new, pairs.landmark_new)):
            assert (submap.landmark_of[k] == landmark[pair]).sum() == 1
    assert set(pairs.keyframes.tolist()) <= set(shared_keyframes(case.old, case.new))


def test_other_features_of_the_same_frames_are_matched_by_descriptor(case):
    shared = shared_keyframes(case.old, case.new)
    points_new = point_of_landmark(case.new, np.arange(len(case.new.landmarks)))
    shuffle_features(case.new, shared, np.random.default_rng(0), jitter_px=0.5)
    assert len(propose_correspondences(case.old, case.new)) == 0
    pairs = propose_correspondences(case.old, case.new, MATCHER)
    assert len(pairs) > 150
    assert not pairs.shared_pixel.any()
    right = point_of_landmark(case.old, pairs.landmark_old) == points_new[pairs.landmark_new]
    assert right.mean() > 0.99


def test_descriptor_and_radius_are_limits(case):
    shuffle_features(case.new, shared_keyframes(case.old, case.new), np.random.default_rng(0), jitter_px=0.5)
    assert len(propose_correspondences(case.old, case.new, DescriptorMatcher(hamming, -1.0))) == 0
    assert len(propose_correspondences(case.old, case.new, DescriptorMatcher(hamming, 64.0, 1e-6))) == 0


def test_copied_features_count_as_identical(case):
    """Features that came back from another process are equal, not the same object."""
    before = propose_correspondences(case.old, case.new)
    for k, keyframe in list(case.new.keyframes.items()):
        f = keyframe.features
        case.new.keyframes[k] = Keyframe(k, 0.0, f.take(np.arange(len(f))))
    after = propose_correspondences(case.old, case.new)
    assert np.array_equal(before.landmark_old, after.landmark_old)


def test_culled_landmarks_are_not_matched(case):
    before = propose_correspondences(case.old, case.new)
    case.old.remove_landmarks(before.landmark_old[:50])
    after = propose_correspondences(case.old, case.new)
    assert not np.isin(before.landmark_old[:50], after.landmark_old).any()
    assert len(after) == len(before) - 50


def test_a_point_that_is_two_landmarks_is_paired_once(case):
    """A duplicate in the new map, seen in fewer keyframes, loses."""
    before = propose_correspondences(case.old, case.new)
    n_views = np.bincount(before.view_pair)
    pair = int(np.argmax(n_views))
    j = int(before.landmark_new[pair])
    new = case.new
    rows = new.rows_of_landmarks(np.array([j]))
    ids = new.keyframes.keys() & case.old.keyframes.keys()
    rows = rows[np.isin(new.observations["kf"][rows], list(ids))][-2:]
    kf, feature = new.observations["kf"][rows].copy(), new.observations["feature"][rows].copy()
    new.remove_observations(rows)
    twin = new.add_landmarks(new.landmarks["xyz_mu"][[j]], new.landmarks["descriptor"][[j]], np.ones(1), int(kf[0]))
    new.add_observations(kf, feature, np.repeat(twin, 2))
    after = propose_correspondences(case.old, case.new)
    assert after.landmark_new[after.landmark_old == before.landmark_old[pair]].tolist() == [j]
    assert twin[0] not in after.landmark_new


def test_covariances_are_those_of_the_points(case):
    """Whitened residuals against the truth (no drift, no outliers) are chi-square with 3 degrees of freedom."""
    exact = make_case(LAYOUT, SEED, outliers=0.0, drift=0.0)
    pairs = propose_correspondences(exact.old, exact.new)
    world = make_world(LAYOUT, SEED)
    assert np.linalg.eigvalsh(pairs.covariance_old).min() > 0
    kf = next(iter(exact.old.keyframes))
    S_w = exact.old.T_submap_kf[kf]
    truth = world.xyz[point_of_landmark(exact.old, pairs.landmark_old)]
    # Into the frame of one camera on both sides; the map's unit differs from the world's by the gauge.
    T = world.T_w_cam[kf // FRAME_STEP]
    p_true = (truth - T[:3, 3]) @ T[:3, :3]
    p_map = (pairs.xyz_old - S_w[:3, 3]) @ S_w[:3, :3]
    unit = np.median(np.linalg.norm(p_map, axis=1) / np.linalg.norm(p_true, axis=1))
    C = S_w[:3, :3].T @ pairs.covariance_old @ S_w[:3, :3]
    residual = p_map - unit * p_true
    d2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(C), residual)
    assert np.median(d2) == pytest.approx(2.366, rel=0.25)


def test_landmarks_that_their_views_do_not_fix_have_no_covariance(case):
    old = case.old
    j = int(old.landmarks_of_keyframes(list(old.keyframes)[:1])[0])
    rows = old.rows_of_landmarks(np.array([j]))
    old.remove_observations(rows[1:])
    pairs = propose_correspondences(old, case.new)
    assert j not in pairs.landmark_old


def test_nothing_in_common():
    a = make_case(LAYOUT, SEED, old_frames=range(6), new_frames=range(8, 14))
    pairs = propose_correspondences(a.old, a.new, MATCHER)
    assert len(pairs) == 0
    assert len(pairs.keyframes) == 0


def test_points_placed_anew_leave_the_newer_keyframes_out():
    """Where the older keyframes are right and the newer ones wrong, the older ones alone give the right points."""
    case = make_case(LAYOUT, SEED, outliers=0.0, drift=0.0)
    whole = propose_correspondences(case.old, case.new)
    limit = int(whole.keyframes[6])
    case.old.landmarks["xyz_mu"][:] += 1.0
    anew = propose_correspondences(case.old, case.new, old_before=limit)
    assert 100 < len(anew) < len(whole)
    both = np.searchsorted(whole.landmark_old, anew.landmark_old)
    off = np.linalg.norm(anew.xyz_old - whole.xyz_old[both], axis=1)
    sigma = np.sqrt(np.trace(anew.covariance_old, axis1=1, axis2=2))
    assert np.median(off / sigma) < 1.0
