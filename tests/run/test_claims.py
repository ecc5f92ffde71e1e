"""What a map claims of its accuracy stands in proportion to what is true, and says where the scale is not tied."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.core.geometry import so3
from dualslam.core.noise_model import GROUP, UNSURE_SCALE
from dualslam.map.submap import Submap
from dualslam.run import claims as claims_module
from dualslam.run.claims import Claim, claims_in_atlas
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


def claims_of(submap: Submap) -> dict[int, Claim]:
    """Return what a submap claims of its keyframes by itself."""
    atlas = Atlas()
    atlas.add(submap)
    return claims_in_atlas(atlas)[submap.id]


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
        assert row.sigma_scale is None or row.sigma_scale >= 0


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
    assert max(c.sigma_scale for c in claims.values()) > max(c.sigma_scale for c in sharp.values())
    assert claims[ids[0]].sigma_position_rel == sharp[ids[0]].sigma_position_rel


def test_a_keyframe_with_its_points_behind_it_claims_nothing_negative() -> None:
    submap = run()[0].atlas.submaps[0].copy()
    last = max(submap.keyframes)
    submap.T_submap_kf[last][:3, :3] @= np.diag([-1.0, 1.0, -1.0])
    assert np.median(submap.depths_in(last)) < 0
    assert claims_of(submap)[last].sigma_scale > 0


def test_where_nothing_is_seen_on_both_sides_the_scale_is_not_known() -> None:
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    at = GROUP
    assert len(ids) > at
    held, cut = (claims_of(m)[ids[at]].sigma_scale for m in (submap, without_ties(submap, ids[at])))
    assert held < 0.05
    assert cut > 10 * held


def test_the_claim_is_against_the_stretch_that_the_others_are_tied_to_best() -> None:
    submap = run()[0].atlas.submaps[0]
    sigmas = np.array([claim.sigma_scale for claim in claims_of(submap).values()])
    assert np.count_nonzero(sigmas == 0) == 1
    assert (sigmas[sigmas > 0] < 0.05).all()


def test_a_camera_that_turns_on_the_spot_has_no_path_to_be_unsure_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its path is too short to be measured: it is known to the noise of its positions."""
    T, s = hand_held(140, 1.5), 0.08 * np.arange(80)
    T[60:] = T[59]
    T[60:, :3, :3] = T[59, :3, :3] @ so3.exp(np.column_stack([0.2 * np.sin(2 * s), 0.8 * np.sin(s), 0 * s]))
    T[60:, :3, 3] += 0.02 * np.column_stack([np.sin(1.3 * s), np.sin(2 * s), 0 * s])
    world = PointWorld(cloud(), T)
    system = system_in(world)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    submap = system.atlas.submaps[0]
    last = max(submap.keyframes)
    assert last > 100
    assert claims_of(submap)[last].sigma_scale < UNSURE_SCALE
    monkeypatch.setattr(claims_module, "GATE_SIGMAS", 1e-9)
    assert claims_of(submap)[last].sigma_scale > 5 * UNSURE_SCALE


def test_the_scale_of_a_joined_map_is_told_against_the_larger_one_along_the_best_link() -> None:
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    atlas = Atlas()
    for m in range(3):
        atlas.submaps[m] = submap.copy()
    atlas.submaps[1].remove_keyframe(ids[-1], ids[-2])
    assert claims_in_atlas(atlas)[1] == claims_of(atlas.submaps[1])
    for sigma, at in ((0.2, ids[0]), (0.03, ids[3])):
        C = sigma**2 * np.eye(7)
        atlas.link(Link(0, 1, np.eye(4), C, LinkKind.LOOP, keyframe_a=at, keyframe_b=at))
    claims = claims_in_atlas(atlas)
    assert claims[0] == claims[2] == claims_of(submap)
    own, scale = claims_of(atlas.submaps[1]), np.array([claim.sigma_scale for claim in claims[1].values()])
    assert [claims[1][k].sigma_position_rel for k in own] == [claim.sigma_position_rel for claim in own.values()]
    assert 0.03 < scale.min() < scale.max() < 0.1


def test_a_link_hands_on_the_scale_of_its_place_and_not_that_of_the_path_about_it() -> None:
    """What lies beyond a loss of scale is as unsure in the joined map, whichever side the link stands on."""
    submap = run()[0].atlas.submaps[0]
    ids = sorted(submap.keyframes)
    border = len(ids) // 2
    atlas = Atlas()
    atlas.submaps[0], atlas.submaps[1] = submap.copy(), without_ties(submap, ids[border])
    atlas.submaps[1].remove_keyframe(ids[-1], ids[-2])
    at = ids[border - GROUP]
    atlas.link(Link(0, 1, np.eye(4), 0.01**2 * np.eye(7), LinkKind.LOOP, keyframe_a=at, keyframe_b=at))
    claims = claims_in_atlas(atlas)[1]
    assert claims[ids[0]].sigma_scale < 0.05
    assert claims[ids[-2]].sigma_scale > 10 * claims[ids[0]].sigma_scale
