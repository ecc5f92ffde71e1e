"""What a map leaves behind between two runs: nothing that stands anywhere."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas import stored_map
from dualslam.atlas.stored_map import tidy
from dualslam.atlas.trajectory import compose
from dualslam.map.submap import Submap
from tests.places.worlds import lap, run


def seen(submap: Submap) -> set[tuple[int, int, tuple[float, ...]]]:
    """Keyframe, feature and place of all that is observed."""
    obs, xyz = submap.observations, submap.landmarks["xyz_mu"]
    rows = np.flatnonzero(obs["alive"])
    return {
        (int(k), int(f), tuple(xyz[j].tolist()))
        for k, f, j in zip(obs["kf"][rows], obs["feature"][rows], obs["landmark"][rows], strict=True)
    }


def test_only_the_dead_are_left_behind() -> None:
    system = run(lap(), n=60)
    system.finish()
    submap = system.atlas.submaps[0]
    spare = [k for k in submap.keyframes if k not in submap.gauge][3:6]
    for k in spare:  # culled one after the other, the last of them an anchor of those before
        submap.remove_keyframe(k, next(n for n in submap.keyframes if n > k))
    submap.remove_landmarks(np.flatnonzero(submap.n_observations(np.arange(len(submap.landmarks))) < 2))
    n_alive, before = int(submap.landmarks["alive"].sum()), seen(submap)
    way = compose(system.poses.values(), system.atlas, {0: np.eye(4)})
    assert n_alive < len(submap.landmarks)

    poses = tidy(system.atlas, system.poses)

    assert len(submap.landmarks) == n_alive
    assert submap.landmarks["alive"].all()
    assert submap.observations["alive"].all()
    assert seen(submap) == before
    for k, ids in submap.landmark_of.items():
        own = submap.observations["kf"] == k
        feature, landmark = submap.observations["feature"][own], submap.observations["landmark"][own]
        assert np.array_equal(ids[feature], landmark)
        assert np.count_nonzero(ids >= 0) == len(feature)
    assert not submap.anchors
    after = compose(poses.values(), system.atlas, {0: np.eye(4)})
    assert np.array_equal(after.index, way.index)
    assert np.allclose(after.T_world_cam, way.T_world_cam, atol=1e-12)


def test_culled_keyframes_that_something_names_stay_where_they_are() -> None:
    system = run(lap(), n=40)
    submap = system.atlas.submaps[0]
    first = submap.gauge[0]
    T = submap.T_submap_kf[first]
    second, third = [k for k in submap.keyframes if k not in submap.gauge][:2]
    submap.remove_keyframe(first, second)
    submap.remove_keyframe(second, third)
    tidy(system.atlas, system.poses)
    assert set(submap.anchors) == {first}
    assert submap.anchors[first].keyframe_id == third
    assert np.allclose(submap.resolve_anchor(first, np.eye(4)), T, atol=1e-12)


def test_of_very_many_frames_the_newest_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    system = run(lap(), n=40)
    monkeypatch.setattr(stored_map, "MAX_EARLIER_FRAMES", 10)
    poses = tidy(system.atlas, system.poses)
    assert sorted(poses) == sorted(system.poses)[-10:]
