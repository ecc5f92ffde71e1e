"""Places of landmarks and what is known of them, by the keyframes that see them."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import IntArray
from dualslam.map.landmark_views import landmark_covariances, triangulate_landmarks
from dualslam.map.submap import Submap
from dualslam.testing.point_world import PointWorld, cloud, hand_held
from tests.frontends.tracking.test_tracking import true_map


def a_map() -> tuple[Submap, IntArray]:
    submap = true_map(PointWorld(cloud(), hand_held(80)), [0, 4, 8, 12])
    return submap, np.flatnonzero(submap.landmarks["alive"])


def test_covariances_come_in_the_order_that_was_asked_for() -> None:
    submap, ids = a_map()
    ids = ids[:50]
    shuffled = np.random.default_rng(0).permutation(len(ids))
    np.testing.assert_array_equal(
        landmark_covariances(submap, ids[shuffled]), landmark_covariances(submap, ids)[shuffled]
    )
    submap.remove_observations(submap.rows_of_landmarks(ids[:1]))
    assert np.isnan(landmark_covariances(submap, ids[:1])).all()


def test_fewer_keyframes_know_less() -> None:
    submap, ids = a_map()
    everywhere, early = landmark_covariances(submap, ids), landmark_covariances(submap, ids, before=8)
    both = np.isfinite(everywhere).all(axis=(1, 2)) & np.isfinite(early).all(axis=(1, 2))
    assert np.count_nonzero(both) > 50
    assert np.linalg.eigvalsh(early[both] - everywhere[both]).min() > -1e-9 * np.abs(early[both]).max()
    assert np.trace(early[both], axis1=1, axis2=2).sum() > 1.2 * np.trace(everywhere[both], axis1=1, axis2=2).sum()


def test_places_are_asked_of_the_older_keyframes_alone() -> None:
    submap, ids = a_map()
    true = submap.landmarks["xyz_mu"][ids].copy()
    before = triangulate_landmarks(submap, ids, before=8)
    # What the map holds for the places, and where the later keyframes are, plays no part.
    submap.landmarks["xyz_mu"][ids] += 1.0
    submap.T_submap_kf[8][:3, 3] += 5.0
    again = triangulate_landmarks(submap, ids, before=8)
    np.testing.assert_array_equal(again, before)
    placed = np.isfinite(before).all(axis=1)
    sigma = np.sqrt(np.trace(landmark_covariances(submap, ids[placed], true[placed], before=8), axis1=1, axis2=2))
    assert np.count_nonzero(placed) > 50
    assert np.nanmedian(np.linalg.norm(before[placed] - true[placed], axis=1) / sigma) < 1.2
    assert np.isnan(triangulate_landmarks(submap, ids, before=4)).all(), "one keyframe places nothing"
    assert np.isnan(triangulate_landmarks(submap, ids, before=0)).all()
