"""What a map claims of its accuracy stands in proportion to what is true, and says where the scale is not tied."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.core.noise_model import GROUP
from dualslam.map.submap import Submap
from dualslam.run.claims import claims_in_atlas, claims_of
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


def test_the_scale_of_a_joined_map_is_told_against_the_larger_one_along_the_best_link() -> None:
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    atlas = Atlas()
    for m in range(3):
        atlas.submaps[m] = submap.copy()
    atlas.submaps[1].remove_keyframe(ids[-1], ids[-2])
    own = claims_of(atlas.submaps[1])
    assert claims_in_atlas(atlas)[1] == own
    for sigma, at in ((0.2, ids[0]), (0.03, ids[3])):
        C = sigma**2 * np.eye(7)
        atlas.link(Link(0, 1, np.eye(4), C, LinkKind.LOOP, keyframe_a=at, keyframe_b=at))
    claims = claims_in_atlas(atlas)
    assert claims[0] == claims[2] == claims_of(submap)
    of_link = np.hypot(0.03, np.hypot(claims[0][ids[3]].sigma_scale, own[ids[3]].sigma_scale))
    assert [claims[1][k].sigma_scale for k in own] == pytest.approx(
        [np.hypot(claim.sigma_scale, of_link) for claim in own.values()]
    )
