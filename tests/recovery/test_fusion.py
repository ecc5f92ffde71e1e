"""A link is taken in as the two maps stand by then, though both have moved since it was measured: on exact maps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray
from dualslam.linking.estimate import LinkEstimate
from dualslam.recovery.fusion import fuse
from dualslam.recovery.job import FoundLink
from dualslam.testing.atlas_world import DriftingMap

SHARED = range(5, 10)
ONSET = 9
WEAK = 1e-3 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -4.0, 2.0])
"""The direction in which the link is known least."""


def fused(change_point: int | None = None) -> tuple[DriftingMap, Link, FloatArray]:
    """Map 0 of the keyframes up to 9, map 1 of those from 5 on; both have moved since the link was measured.

    Returns the link as it was taken in, too, and how map 1 has moved.
    """
    world = DriftingMap(14, drift=np.zeros(7), noise_px=0.0)
    for k in range(SHARED.stop):
        world.add(k)
    world.begin_anew()
    S_new_old = sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6])
    for k in range(SHARED.start, 14):
        world.add(k, S_new_old)
    old, new = world.atlas.submaps[0], world.atlas.submaps[1]
    job = SimpleNamespace(lost={0: old.copy()}, submap=new.copy(), onsets={0: ONSET})
    T_old, T_new = se3.exp([0.3, -0.2, 0.1, 2.0, 0.0, -1.0]), se3.exp([-0.1, 0.4, 0.2, 0.0, 1.0, 3.0])
    old.transform(1.4, T_old)
    new.transform(0.6, T_new)
    S_now_then = sim3.from_parts(0.6, T_new[:3, :3], T_new[:3, 3])
    estimate = LinkEstimate(
        S_old_new=sim3.inverse(S_new_old),
        covariance=np.outer(WEAK, WEAK) + 1e-12 * np.eye(7),
        n_matches=90,
        n_inliers=80,
        landmark_pairs=np.zeros((0, 2), np.int64),
        agreeing_keyframes=np.array(SHARED[:3]),
        change_point=change_point,
        suspected_onset=ONSET,
        sigma_scale=0.01,
        numbers={},
    )
    found = FoundLink(0, estimate, "gap")
    assert fuse(world.record, world.connections, job, found, S_now_then, [], world.now, 0.0)  # type: ignore[arg-type]
    (link,) = world.atlas.links
    return world, link, S_now_then


def test_shared_keyframes_are_at_one_place_by_the_link() -> None:
    world, link, _ = fused()
    old, new = (world.atlas.submaps[m] for m in (link.a, link.b))
    for k in SHARED:
        T = sim3.act_on_pose(link.S_a_b, new.T_submap_kf[k])
        np.testing.assert_allclose(T, old.T_submap_kf[k], atol=1e-6)


def test_what_the_link_does_not_know_is_told_in_the_frame_and_unit_of_the_new_map_as_it_is() -> None:
    _, link, S_now_then = fused()
    weak = sim3.log(S_now_then @ sim3.exp(WEAK) @ sim3.inverse(S_now_then))
    np.testing.assert_allclose(link.covariance, np.outer(weak, weak), atol=1e-8)


@pytest.mark.parametrize(("change_point", "since"), [(None, ONSET), (7, 7), (12, ONSET)])
def test_the_tail_is_condemned_from_the_earlier_of_what_was_suspected_and_what_no_longer_fits(
    change_point: int | None, since: int
) -> None:
    world, _, _ = fused(change_point)
    assert world.atlas.submaps[0].condemned == set(range(since, SHARED.stop))
    assert not world.atlas.submaps[1].condemned
