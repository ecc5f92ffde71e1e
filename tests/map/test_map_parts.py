"""Atlas, composed trajectory, frame buffer, verdict on a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import FramePose, compose
from dualslam.core.config.settings import HealthConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Keyframe, Track, View
from dualslam.map.submap import Submap
from dualslam.testing.point_world import path, random_features


def view(i: int, features: Features | None = None) -> View:
    return View(i, 0.1 * i, features or random_features(np.random.default_rng(i), 5))


def submap(m: int, T: dict[int, FloatArray]) -> Submap:
    made = Submap(m, np.eye(3), np.zeros(32, np.uint8))
    for k, T_submap_kf in T.items():
        made.add_keyframe(Keyframe(k, 0.1 * k, view(k).features), T_submap_kf)
    return made


def similarity(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return sim3.from_parts(float(rng.uniform(0.3, 3)), so3.exp(rng.normal(size=3)), rng.normal(size=3))


def link(a: int, b: int, S_a_b: FloatArray) -> Link:
    return Link(a, b, S_a_b, np.eye(7), LinkKind.RECOVERY)


class TestAtlas:
    def test_components_and_their_common_frame(self) -> None:
        atlas = Atlas()
        for m in range(5):
            atlas.add(submap(m, {}))
        S_0_3, S_4_3 = similarity(0), similarity(1)
        atlas.link(link(4, 3, S_4_3))
        atlas.link(link(0, 3, S_0_3))
        assert atlas.components() == [[0, 3, 4], [1], [2]]
        S = atlas.S_world_submap([0, 3, 4])
        np.testing.assert_allclose(S[3], S_0_3)
        np.testing.assert_allclose(S[4], S_0_3 @ sim3.inverse(S_4_3), atol=1e-12)

    def test_links_out_of_the_set_are_not_followed(self) -> None:
        """A submap that is written in its own unit holds its own frames only, whatever it is linked to."""
        atlas = Atlas()
        for m in range(3):
            atlas.add(submap(m, {}))
        atlas.link(link(1, 2, similarity(0)))
        assert set(atlas.S_world_submap([2])) == {2}

    def test_nothing_is_replaced(self) -> None:
        atlas = Atlas()
        atlas.add(submap(0, {}))
        with pytest.raises(ValueError, match="in the atlas already"):
            atlas.add(submap(0, {}))


class TestComposition:
    def test_poses_follow_their_keyframe_and_their_submap(self) -> None:
        T = path(4, np.array([1.0, 0, 0]), np.array([0, 0.1, 0]))
        atlas = Atlas()
        atlas.add(submap(0, {0: T[0]}))
        atlas.add(submap(1, {2: T[2]}))
        step = se3.inverse(T[0]) @ T[1]
        poses = [FramePose(3, 0.3, 1, 2, step), FramePose(1, 0.1, 0, 0, step), FramePose(2, 0.2, 1, 2, np.eye(4))]
        S_0_1 = similarity(2)
        found = compose(poses, atlas, {0: np.eye(4), 1: S_0_1})
        assert found.index.tolist() == [1, 2, 3]
        np.testing.assert_allclose(found.T_world_cam[0], T[1], atol=1e-12)
        for row, T_1_cam in ((1, T[2]), (2, T[2] @ step)):
            T_0_cam = found.T_world_cam[row]
            np.testing.assert_allclose(T_0_cam[:3, :3] @ T_0_cam[:3, :3].T, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(T_0_cam, sim3.act_on_pose(S_0_1, T_1_cam), atol=1e-12)
        # The map is refined: the frames come along.
        atlas.submaps[0].T_submap_kf[0] = T[3]
        again = compose(poses, atlas, {0: np.eye(4)})
        assert again.index.tolist() == [1]
        np.testing.assert_allclose(again.T_world_cam[0], T[3] @ step, atol=1e-12)

    def test_nothing_posed(self) -> None:
        assert len(compose([], Atlas(), {})) == 0

    def test_culled_keyframes_carry_on_as_anchors_of_anchors(self) -> None:
        T = path(5, np.array([1.0, 0.2, 0]), np.array([0.05, 0.1, 0]))
        made = submap(0, dict(enumerate(T)))
        atlas = Atlas()
        atlas.add(made)
        poses = [FramePose(k, 0.1 * k, 0, k, np.eye(4)) for k in range(5)]
        for k, anchor in ((1, 2), (2, 3), (3, 4)):
            made.remove_keyframe(k, anchor)
        np.testing.assert_allclose(compose(poses, atlas, {0: np.eye(4)}).T_world_cam, T, atol=1e-12)
        moved = se3.exp(np.array([0.1, 0, 0.2, 1, 2, 3]))
        for k in made.keyframes:
            made.T_submap_kf[k] = moved @ made.T_submap_kf[k]
        np.testing.assert_allclose(compose(poses, atlas, {0: np.eye(4)}).T_world_cam, moved @ T, atol=1e-12)


def track(n_matches: int = 100, n_inliers: int = 90, chi2: float = 1.0) -> Track:
    return Track(
        view(0), np.eye(4), np.eye(4), np.zeros(0, int), np.zeros(0, int), n_matches, n_inliers, chi2, False, np.eye(6)
    )


class TestHealth:
    config = HealthConfig(min_inliers=25)

    def test_a_good_track_is_handed_through(self) -> None:
        good = track()
        assert judge_track(good, self.config) is good

    @pytest.mark.parametrize(
        ("bad", "reason"),
        [
            (track(30, 24), FailureReason.TOO_FEW_INLIERS),
            (track(100, 34), FailureReason.LOW_INLIER_RATIO),
            (track(chi2=2.6), FailureReason.CHI_SQUARE),
        ],
    )
    def test_a_bad_one_fails_with_its_reason(self, bad: Track, reason: FailureReason) -> None:
        verdict = judge_track(bad, self.config)
        assert isinstance(verdict, Failure)
        assert verdict.reason is reason
        assert verdict.numbers["n_inliers"] == bad.n_inliers
        assert verdict.detail

    def test_a_failure_stays_what_it_is(self) -> None:
        failure = Failure(FailureReason.MOTION_JUMP)
        assert judge_track(failure, self.config) is failure

    def test_no_matches_at_all(self) -> None:
        nothing = replace(track(), n_matches=0, n_inliers=0)
        assert isinstance(judge_track(nothing, self.config), Failure)
