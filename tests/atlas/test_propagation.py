"""What follows a submap that has moved: links by any similarity, exactly; frames by the share of their way."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.propagation import propagate_links, propagate_poses
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Keyframe
from dualslam.map.submap import Submap
from dualslam.testing.graph_scene import guessed_submap, make_scene
from dualslam.testing.point_world import CAMERA, random_features

WEAK = 1e-3 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -4.0, 2.0])
"""The direction in which the link is known least."""


@pytest.mark.parametrize("moved", [0, 1])
def test_a_link_and_what_it_does_not_know_follow_either_of_its_maps(moved: int) -> None:
    atlas, S_0_1 = Atlas(), sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6])
    for m in (0, 1):
        submap = guessed_submap(make_scene(6), pose_noise=0.0)
        submap.id = m
        atlas.add(submap)
    covariance = np.outer(WEAK, WEAK) + 1e-12 * np.eye(7)
    atlas.link(Link(0, 1, S_0_1, covariance, LinkKind.RECOVERY, (2, 3, 4)))
    after = atlas.submaps[moved]
    before, T = after.copy(), se3.exp([0.3, -0.2, 0.1, 2.0, 0.0, -1.0])
    after.transform(1.7, T)
    S_after_before = sim3.from_parts(1.7, T[:3, :3], T[:3, 3])
    propagate_links(atlas, before, after)
    (link,) = atlas.links
    expected = S_after_before @ S_0_1 if moved == 0 else S_0_1 @ sim3.inverse(S_after_before)
    np.testing.assert_allclose(link.S_a_b, expected, atol=1e-9)
    # The covariance is of a right perturbation: it changes with the map on the right alone.
    weak = WEAK if moved == 0 else sim3.log(S_after_before @ sim3.exp(WEAK) @ sim3.inverse(S_after_before))
    np.testing.assert_allclose(link.covariance, np.outer(weak, weak), atol=1e-8)


def along(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_between_two_keyframes_a_frame_moves_in_proportion_to_its_way() -> None:
    before, rng = Submap(0, CAMERA.K, np.zeros(32, np.uint8)), np.random.default_rng(0)
    for k, x in ((0, 0.0), (10, 4.0)):
        before.add_keyframe(Keyframe(k, 0.1 * k, random_features(rng, 5)), along(x))
    after = before.copy()
    after.T_submap_kf[10] = along(5.0)  # a metre farther
    frames = [FramePose(i, 0.1 * i, 0, 0, along(x)) for i, x in ((2, 1.0), (7, 3.0), (12, 4.5))]
    of_another_map = FramePose(3, 0.3, 1, 0, along(1.0))
    carried = propagate_poses([*frames, of_another_map], before, after)
    centres = [float(after.resolve_anchor(p.keyframe_id, p.T_kf_cam)[0, 3]) for p in carried]
    assert [p.index for p in carried] == [2, 7, 12]
    np.testing.assert_allclose(centres, [1.25, 3.75, 5.5], atol=1e-9)  # beyond the last one it goes with that
