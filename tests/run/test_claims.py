"""What a map claims of its accuracy stands in proportion to what is true, and says where the scale is not tied."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from dualslam.core.noise_model import GROUP
from dualslam.map.submap import Submap
from dualslam.run.claims import claims_of
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

N = 90


@cache
def run() -> tuple[System, PointWorld]:
    world = PointWorld(cloud(), hand_held(N))
    system = system_in(world)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system, world


def without_ties(submap: Submap, border: int) -> Submap:
    """The same map in which nothing is seen on both sides of a keyframe."""
    cut = submap.copy()
    obs = cut.observations
    alive = np.flatnonzero(obs["alive"])
    late = obs["kf"][alive] >= border
    landmarks = obs["landmark"][alive]
    both = np.intersect1d(landmarks[late], landmarks[~late])
    cut.remove_observations(alive[late & np.isin(landmarks, both)])
    return cut


def test_every_posed_frame_has_the_claim_of_its_keyframe() -> None:
    system, _ = run()
    rows = frame_rows(system)
    main = trajectories_of(system).main.index.tolist()
    assert main
    assert [row.index for row in rows if row.in_main_map] == main
    assert all(row.in_main_map is not None for row in rows)
    assert all(row.in_main_map is None for row in system.rows.values()), "it is not known there"
    claims = claims_of(system.atlas.submaps[0])
    assert len(claims) == len(system.atlas.submaps[0].keyframes)
    for row in rows:
        claim = claims[system.atlas.submaps[0].keyframe_for(system.poses[row.index].keyframe_id)]
        assert row.sigma_position_rel == claim.sigma_position_rel
        assert row.sigma_position_rel is not None
        assert 0 < row.sigma_position_rel < 0.05
        assert row.sigma_scale is None or row.sigma_scale > 0


def test_fewer_landmarks_leave_a_position_less_sure() -> None:
    submap = run()[0].atlas.submaps[0]
    k = sorted(submap.keyframes)[len(submap.keyframes) // 2]
    poor = submap.copy()
    rows = np.flatnonzero((poor.observations["kf"] == k) & poor.observations["alive"])
    poor.remove_observations(rows[: int(0.9 * len(rows))])
    assert claims_of(poor)[k].sigma_position_rel > 2 * claims_of(submap)[k].sigma_position_rel


def test_where_pixels_fit_worse_less_is_claimed_of_what_lies_about() -> None:
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    at = len(ids) // 2
    soft = submap.copy()
    keyframe = soft.keyframes[ids[at]]
    noise = np.random.default_rng(0).normal(0.0, 3.0, keyframe.features.uv_rect_px.shape)
    features = replace(keyframe.features, uv_rect_px=keyframe.features.uv_rect_px + noise)
    soft.keyframes[ids[at]] = replace(keyframe, features=features)
    sharp, claims = claims_of(submap), claims_of(soft)
    for k in ids[at - 2 : at + 3]:
        assert claims[k].sigma_position_rel > 1.5 * sharp[k].sigma_position_rel
    assert claims[ids[at]].sigma_scale > 1.5 * sharp[ids[at]].sigma_scale
    assert claims[ids[0]].sigma_position_rel == sharp[ids[0]].sigma_position_rel


def test_where_nothing_is_seen_on_both_sides_the_scale_is_not_known() -> None:
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    at = GROUP
    assert len(ids) > at
    held, cut = (claims_of(m)[ids[at]].sigma_scale for m in (submap, without_ties(submap, ids[at])))
    assert held < 0.05
    assert cut > 10 * held
