"""A recovery with its frames numbered the other way round is the same recovery."""

from __future__ import annotations

import numpy as np

from dualslam.map.submap import Submap
from tests.backend.test_self_calibration import TRUE, make_submap


def same(a: Submap, b: Submap) -> bool:
    columns = [(x.columns(), y.columns()) for x, y in ((a.landmarks, b.landmarks), (a.observations, b.observations))]
    return (
        list(a.keyframes) == list(b.keyframes)
        and all(a.keyframes[k].id == b.keyframes[k].id == k for k in a.keyframes)
        and all(np.array_equal(a.T_submap_kf[k], b.T_submap_kf[k]) for k in a.keyframes)
        and all(np.array_equal(a.landmark_of[k], b.landmark_of[k]) for k in a.keyframes)
        and {k: anchor.keyframe_id for k, anchor in a.anchors.items()}
        == {k: anchor.keyframe_id for k, anchor in b.anchors.items()}
        and a.gauge == b.gauge
        and all(np.array_equal(x[name], y[name]) for x, y in columns for name in x)
    )


def test_renumbering_twice_gives_the_submap_back() -> None:
    submap = make_submap(TRUE, turning=True, n=12)
    submap.remove_keyframe(5, 4)
    turned = submap.renumbered(lambda k: 100 - k)
    assert sorted(turned.keyframes) == [100 - k for k in sorted(submap.keyframes, reverse=True)]
    assert turned.anchors[95].keyframe_id == 96
    assert not same(turned, submap)
    assert same(turned.renumbered(lambda k: 100 - k), submap)


def test_a_renumbered_submap_is_a_copy() -> None:
    submap = make_submap(TRUE, turning=True, n=6)
    before = submap.observations["kf"].copy()
    turned = submap.renumbered(lambda k: 50 - k)
    turned.landmarks["xyz_mu"][:] = 0.0
    np.testing.assert_array_equal(submap.observations["kf"], before)
    assert submap.landmarks["xyz_mu"].any()
