"""Pixels decide whether two places are one: the right one passes, with the right similarity; others do not."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from dualslam.build import create_frontend
from dualslam.core.config.settings import FrontendConfig, LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FailureReason
from dualslam.frontends.tracking.local_map import look
from dualslam.linking.join_test import ambiguity_gate
from dualslam.map.submap import Submap
from dualslam.places import PlaceMatch, PlaceVerifier, find_second_pose
from dualslam.testing.point_world import CAMERA
from tests.places.worlds import N_LAP, driven_lap, run, twice_the_same


@cache
def verifier() -> PlaceVerifier:
    frontend = create_frontend(FrontendConfig())
    return PlaceVerifier(frontend, partial(look, frontend, CAMERA), LinkingConfig(), 0)


def keyframe_near(submap: Submap, index: int) -> int:
    return min(submap.keyframes, key=lambda k: abs(k - index))


def moved_copy(submap: Submap, submap_id: int) -> tuple[Submap, np.ndarray]:
    """The same map in another frame and unit; returns ``S_moved_submap`` too."""
    twin = submap.copy()
    twin.id = submap_id
    T = se3.from_parts(so3.exp([0.3, -0.5, 0.2]), [2.0, 1.0, -3.0])
    twin.transform(1.7, T)
    return twin, sim3.from_parts(1.7, T[:3, :3], T[:3, 3])


def test_the_same_place_in_another_map_gives_the_similarity_between_the_maps() -> None:
    submap = driven_lap().atlas.submaps[0]
    other, S_other_submap = moved_copy(submap, 1)
    q = keyframe_near(submap, 40)
    match = verifier().verify((submap, q), (other, keyframe_near(other, 43)))
    assert isinstance(match, PlaceMatch)
    error = sim3.log(sim3.inverse(match.S_place_query) @ S_other_submap)
    assert np.abs(error).max() < 0.02
    assert match.n_inliers >= 50
    assert len(match.keyframes_place) >= 3
    assert len(match.keyframes_query) >= 3
    assert error @ np.linalg.solve(match.covariance, error) < 24.3  # chi-square, 7 degrees of freedom, 99.9 %


def test_it_does_not_depend_on_what_was_asked_before() -> None:
    submap = driven_lap().atlas.submaps[0]
    other, _ = moved_copy(submap, 1)
    asked = (submap, keyframe_near(submap, 40)), (other, keyframe_near(other, 43))
    first = verifier().verify(*asked)
    verifier().verify((submap, keyframe_near(submap, 20)), (other, keyframe_near(other, 22)))
    second = verifier().verify(*asked)
    assert isinstance(first, PlaceMatch)
    assert isinstance(second, PlaceMatch)
    assert np.array_equal(first.S_place_query, second.S_place_query)


def test_the_end_of_the_lap_is_its_beginning() -> None:
    submap = driven_lap().atlas.submaps[0]
    match = verifier().verify((submap, keyframe_near(submap, N_LAP + 20)), (submap, keyframe_near(submap, 20)))
    assert isinstance(match, PlaceMatch)


def test_another_place_is_refused() -> None:
    submap = driven_lap().atlas.submaps[0]
    assert not verifier().verify((submap, keyframe_near(submap, 80)), (submap, keyframe_near(submap, 20)))


def test_what_sees_the_same_landmarks_is_no_revisit() -> None:
    submap = driven_lap().atlas.submaps[0]
    refused = verifier().verify((submap, keyframe_near(submap, 40)), (submap, keyframe_near(submap, 42)))
    assert not refused
    assert refused.reason is FailureReason.DEGENERATE


def test_a_pose_at_the_place_is_confirmed_and_one_beside_it_refused() -> None:
    submap = driven_lap().atlas.submaps[0]
    k = keyframe_near(submap, 40)
    features, T_cam_submap = submap.keyframes[k].features, se3.inverse(submap.T_submap_kf[k])
    assert verifier().check_pose(submap, k, T_cam_submap, features) is None
    beside = se3.from_parts(so3.exp([0.0, 0.3, 0.0]), np.zeros(3)) @ T_cam_submap
    assert verifier().check_pose(submap, k, beside, features) is not None


def test_a_second_pose_is_found_where_a_thing_is_there_twice() -> None:
    rng = np.random.default_rng(1)
    src = rng.uniform(-1, 1, (60, 3)) + [0, 0, 4]
    there = src + [5.0, 0.0, 0.0]
    tight = np.broadcast_to(1e-4 * np.eye(3), (120, 3, 3))
    pairs = np.concatenate([src, src]), np.concatenate([src, there])
    point, explained = np.tile(np.arange(60), 2), np.arange(120) < 60
    settings = {"min_support": 20, "chi2_gate": 11.3, "max_hypotheses": 256}
    second = find_second_pose(*pairs, tight, tight, point, np.eye(4), explained, rng, **settings)
    assert second is not None
    assert not ambiguity_gate(second.support, second.first_support).passed
    np.testing.assert_allclose(second.S_dst_src[:3, 3], [5.0, 0.0, 0.0], atol=1e-3)
    assert (second.support, second.first_support) == (60, 60)


def test_scattered_pairs_are_no_second_pose() -> None:
    rng = np.random.default_rng(2)
    src, dst = rng.uniform(-1, 1, (2, 200, 3))
    dst[:60] = src[:60]
    tight = np.broadcast_to(1e-4 * np.eye(3), (200, 3, 3))
    settings = {"min_support": 20, "chi2_gate": 11.3, "max_hypotheses": 256}
    assert (
        find_second_pose(src, dst, tight, tight, np.arange(200), np.eye(4), np.arange(200) < 60, rng, **settings)
        is None
    )


def test_a_world_that_repeats_itself_closes_no_false_loop() -> None:
    system = run(twice_the_same(n=100))
    assert [link for link in system.atlas.believed if link.a == link.b] == []
