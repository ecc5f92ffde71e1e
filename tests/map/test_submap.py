"""The arrays under a map: tables that grow, observations that die, landmarks that merge, events, stage times."""

from __future__ import annotations

import time

import numpy as np
import pytest

from dualslam.atlas.record import StageTimer
from dualslam.core.events import EventKind, EventLog
from dualslam.core.geometry import se3
from dualslam.core.types import Keyframe, Start, View
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.map.tables import Table, observation_table
from dualslam.testing.point_world import make_features, path


def features(n: int):
    uv = np.column_stack([np.arange(n), np.arange(n)]).astype(float)
    words = np.arange(4 * n, dtype=np.uint8).reshape(n, 4)
    return make_features(uv, 0.5 + np.arange(n), np.arange(n) % 3, words)


@pytest.fixture
def submap() -> Submap:
    """Three keyframes of six features; landmark j is feature j of all of them, feature 5 is free."""
    made = Submap(7, np.eye(3), np.zeros(4, np.uint8))
    for k, T in zip((10, 20, 30), path(3, np.array([1.0, 0, 0]), np.array([0, 0.1, 0])), strict=True):
        made.add_keyframe(Keyframe(k, 0.1 * k, features(6)), T)
    xyz = np.column_stack([np.arange(5.0), np.zeros(5), np.full(5, 4.0)])
    ids = made.add_landmarks(xyz, features(5).descriptors, np.ones(5), 10)
    for k in (10, 20, 30):
        made.add_observations(k, np.arange(5), ids)
    made.gauge = (10, 30)
    return made


def assert_consistent(submap: Submap) -> None:
    """`landmark_of` says the same as the live observations, and each is of a live landmark."""
    obs = submap.observations
    alive = np.flatnonzero(obs["alive"])
    said = {(k, f, j) for k, of in submap.landmark_of.items() for f, j in enumerate(of.tolist()) if j != NO_LANDMARK}
    rows = [obs[name][alive].tolist() for name in ("kf", "feature", "landmark")]
    assert set(zip(*rows, strict=True)) == said
    assert submap.landmarks["alive"][obs["landmark"][alive]].all()


class TestSubmap:
    def test_an_estimate_does_not_bring_a_culled_keyframe_back(self, submap: Submap) -> None:
        """A graph knows it until its next update; what is posed against it follows the keyframe that it is tied to."""
        ids, T = np.array([10, 20, 30]), submap.keyframe_poses([10, 20, 30])
        submap.remove_keyframe(20, 30)
        T[:, :3, 3] += 1.0
        submap.apply_estimate(ids, T, np.zeros(0, np.int64), np.zeros((0, 3)))
        assert list(submap.T_submap_kf) == [10, 30]
        np.testing.assert_allclose(submap.resolve_anchor(20, np.eye(4)), T[1], atol=1e-12)

    def test_patches_appear_as_large_as_before_in_a_map_that_has_grown(self, submap: Submap) -> None:
        """The distances at which landmarks were described follow an estimate."""
        lm, ids, distance = submap.landmarks, np.arange(5), submap.landmarks["distance_mu"].copy()
        lm["first_kf"][:] = [10, 10, 20, 20, 99]  # 99: in another submap
        submap.remove_keyframe(20, 30)
        T = submap.keyframe_poses([10, 30])
        T[:, :3, 3] *= 3.0
        submap.apply_estimate(np.array([10, 30]), T, ids, 3.0 * lm["xyz_mu"])
        np.testing.assert_allclose(lm["distance_mu"][:2], 3.0 * distance[:2])
        assert lm["distance_mu"][2] > distance[2]  # by way of the keyframe that its own is anchored to
        assert lm["distance_mu"][4] == distance[4]

    def test_of_a_start(self) -> None:
        T = path(3, np.array([0.2, 0, 0]), np.zeros(3))
        feature = np.array([[0, 1, 2], [0, -1, 2], [3, 4, 5]])
        xyz = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 2]])
        start = Start([View(i, 0.1 * i, features(6)) for i in (4, 5, 6)], T, xyz, feature, {})
        made = Submap.from_start(start, 0, np.eye(3))
        assert_consistent(made)
        assert list(made.keyframes) == [4, 5, 6]
        assert made.gauge == (4, 6)
        assert made.n_observations(np.arange(3)).tolist() == [3, 2, 3]
        np.testing.assert_allclose(made.landmarks["distance_mu"], np.linalg.norm(xyz - T[2, :3, 3], axis=1))

    def test_covisibility(self, submap: Submap) -> None:
        submap.remove_observations(
            np.flatnonzero((submap.observations["kf"] == 20) & (submap.observations["feature"] < 3))
        )
        ids, counts = submap.covisible(np.arange(5))
        assert ids.tolist() == [10, 30, 20]
        assert counts.tolist() == [5, 5, 2]
        assert submap.landmarks_of_keyframes([20]).tolist() == [3, 4]
        assert_consistent(submap)

    def test_removed_landmarks_take_their_observations_along(self, submap: Submap) -> None:
        submap.remove_landmarks(np.array([1, 3]))
        assert_consistent(submap)
        assert submap.landmarks_of_keyframes([10, 20, 30]).tolist() == [0, 2, 4]
        assert submap.current_ids(np.array([0, 1, -1])).tolist() == [0, -1, -1]
        submap.remove_landmarks(np.zeros(0, np.int64))
        assert len(submap.landmarks) == 5

    def test_merged_landmarks(self, submap: Submap) -> None:
        (twin,) = submap.add_landmarks(np.array([[0.0, 0, 4]]), features(1).descriptors, np.ones(1), 30)
        submap.remove_observations(
            np.flatnonzero((submap.observations["kf"] == 20) & (submap.observations["landmark"] == 0))
        )
        submap.add_observations(np.array([20, 30]), np.array([5, 5]), np.array([twin, twin]))
        submap.merge_landmarks(np.array([0]), np.array([twin]))
        assert_consistent(submap)
        assert submap.current_id(int(twin)) == 0
        # The view that only the twin had moved over; in keyframe 30 landmark 0 was seen already.
        assert submap.landmark_of[20][5] == 0
        assert submap.landmark_of[30][5] == NO_LANDMARK
        submap.merge_landmarks(np.array([1]), np.array([0]))
        assert submap.current_ids(np.array([twin, 0])).tolist() == [1, 1]
        submap.merge_landmarks(np.array([1]), np.array([twin]))  # the same by now
        assert_consistent(submap)

    def test_counts_follow_every_change(self, submap: Submap) -> None:
        """They are kept from one question to the next."""
        asked = np.arange(5)
        assert submap.n_observations(asked).tolist() == [3, 3, 3, 3, 3]
        row = np.flatnonzero((submap.observations["kf"] == 20) & (submap.observations["landmark"] == 0))
        submap.remove_observations(row)
        assert submap.n_observations(asked).tolist() == [2, 3, 3, 3, 3]
        submap.add_observations(20, np.array([0]), np.array([0]))  # one has died, one has come: as many as before
        assert submap.n_observations(asked).tolist() == [3, 3, 3, 3, 3]
        (twin,) = submap.add_landmarks(np.array([[0.0, 0, 4]]), features(1).descriptors, np.ones(1), 30)
        assert submap.n_observations(np.array([0, twin])).tolist() == [3, 0]
        submap.add_observations(30, np.array([5]), np.array([twin]))
        submap.merge_landmarks(np.array([twin]), np.array([1]))
        assert submap.n_observations(np.array([1, twin])).tolist() == [0, 3]
        twin_map = submap.copy()
        twin_map.remove_landmarks(np.array([2]))
        assert twin_map.n_observations(asked).tolist() == [3, 0, 0, 3, 3]
        submap.take_over(twin_map)
        assert submap.n_observations(asked).tolist() == [3, 0, 0, 3, 3]

    def test_pixels_of_observations(self, submap: Submap) -> None:
        rows = np.array([12, 3, 7])
        uv, sigma = submap.observed_pixels(rows)
        np.testing.assert_array_equal(uv[:, 0], submap.observations["feature"][rows])
        np.testing.assert_array_equal(sigma, 0.5 + submap.observations["feature"][rows])

    def test_culled_keyframes_are_anchored(self, submap: Submap) -> None:
        T = submap.T_submap_kf[20].copy()
        submap.remove_keyframe(20, 10)
        assert_consistent(submap)
        np.testing.assert_allclose(submap.resolve_anchor(20, np.eye(4)), T, atol=1e-12)
        assert submap.n_observations(np.arange(5)).tolist() == [2] * 5

    def test_change_of_gauge_moves_everything_alike(self, submap: Submap) -> None:
        submap.remove_keyframe(20, 10)
        before = submap.copy()
        T = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
        submap.transform(2.0, T)
        in_camera = se3.act(se3.inverse(before.T_submap_kf[30]), before.landmarks["xyz_mu"])
        moved = se3.act(se3.inverse(submap.T_submap_kf[30]), submap.landmarks["xyz_mu"])
        np.testing.assert_allclose(moved, 2 * in_camera, atol=1e-12)
        np.testing.assert_allclose(submap.landmarks["distance_mu"], 2 * before.landmarks["distance_mu"])
        old, new = before.resolve_anchor(20, np.eye(4)), submap.resolve_anchor(20, np.eye(4))
        np.testing.assert_allclose(new[:3, 3], 2 * T[:3, :3] @ old[:3, 3] + T[:3, 3], atol=1e-12)

    def test_what_is_known_of_a_pose_follows_the_keyframe_that_it_is_relative_to(self, submap: Submap) -> None:
        """As long as both are there: culled, the other one stands where its anchor says."""

        def error() -> float:
            known = submap.relative_poses[30]
            T_submap_kf = submap.T_submap_kf[known.keyframe_id] @ known.T_ref_kf
            return float(np.abs(T_submap_kf - submap.T_submap_kf[30]).max())

        T_ref_kf = se3.inverse(submap.T_submap_kf[20]) @ submap.T_submap_kf[30]
        submap.relative_poses[30] = RelativePose(20, T_ref_kf, np.diag([1.0, 1, 1, 4, 4, 4]))
        submap.transform(2.0, se3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])))
        assert error() < 1e-12
        np.testing.assert_allclose(np.diag(submap.relative_poses[30].covariance), [1, 1, 1, 16, 16, 16])
        twin = submap.copy()
        submap.remove_keyframe(20, 10)
        assert submap.relative_poses[30].keyframe_id == 10
        assert error() < 1e-12
        submap.remove_keyframe(30, 10)
        assert not submap.relative_poses
        twin.remove_keyframe(20, 30)  # of its own place relative to itself there is nothing to know
        assert not twin.relative_poses

    def test_a_copy_is_independent(self, submap: Submap) -> None:
        twin = submap.copy()
        submap.remove_landmarks(np.arange(5))
        submap.remove_keyframe(20, 10)
        submap.T_submap_kf[10][:] = 0
        assert_consistent(twin)
        assert twin.landmarks["alive"].all()
        assert list(twin.keyframes) == [10, 20, 30]
        assert twin.T_submap_kf[10][3, 3] == 1

    def test_a_keyframe_is_inserted_once(self, submap: Submap) -> None:
        with pytest.raises(ValueError, match="has keyframe 10 already"):
            submap.add_keyframe(submap.keyframes[10], np.eye(4))


class TestTable:
    def test_rows_stay_where_they_are(self) -> None:
        table = Table(a=(np.int64, ()), b=(np.float64, (3,)))
        for n in (1, 70, 0, 500):
            first = len(table)
            rows = table.append(n, a=np.arange(first, first + n))
            assert rows.tolist() == list(range(first, first + n))
        assert table["a"].tolist() == list(range(571))
        assert not table["b"].any()
        table["b"][3] = (1, 2, 3)
        assert table["b"][3].tolist() == [1, 2, 3]

    def test_a_copy_holds_the_same_and_grows_by_itself(self) -> None:
        for n in (0, 3):
            table = observation_table()
            table.append(n, kf=7, alive=True)
            twin = table.copy()
            twin.append(100, kf=8)
            twin["alive"][:n] = False
            assert table["kf"].tolist() == [7] * n
            assert table["alive"].all()
            assert twin["kf"].tolist() == [7] * n + [8] * 100

    def test_columns_make_the_same_table_again(self) -> None:
        table = Table(a=(np.int64, ()), b=(np.uint8, (2,)))
        table.append(5, a=np.arange(5), b=7)
        columns = table.columns()
        twin = Table.from_columns(columns)
        columns["a"][:] = 0
        table["a"][:] = 0
        assert twin["a"].tolist() == [0, 1, 2, 3, 4]
        assert twin["b"].dtype == np.uint8


def test_events_are_flat_and_in_order() -> None:
    log = EventLog()
    log.add(EventKind.INITIALISED, 3, 0.3, 0, n_points=100)
    log.add(EventKind.FAILED, 9, 0.9, 0, reason="too_few_matches")
    assert len(log) == 2
    assert [event.event for event in log] == [EventKind.INITIALISED, EventKind.FAILED]
    assert log.of_kind(EventKind.FAILED)[0].as_dict() == {
        "event": "failed",
        "frame": 9,
        "timestamp_s": 0.9,
        "submap": 0,
        "reason": "too_few_matches",
    }


def test_stage_timer_counts_work_not_waiting() -> None:
    timer = StageTimer()
    with timer.measure("wait"):
        time.sleep(0.2)
    with timer.measure("work"):
        began = time.thread_time()
        while time.thread_time() - began < 0.02:
            pass
    timer.add("work", 1.0)
    assert timer.stages["wait"].seconds < 0.1
    assert 1.02 <= timer.stages["work"].seconds < 1.2
    assert timer.stages["work"].calls == 2
