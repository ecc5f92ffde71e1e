"""The overlap of two linked maps: what goes over, what it does to the link, when the link is not believed after all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.config.settings import FusionConfig, GraphConfig, LinkingConfig
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FailureReason
from dualslam.lab.audits.link_audit import LinkAudit, audit_links
from dualslam.map.atlas import Atlas, Link, LinkKind
from dualslam.map.solving import solve
from dualslam.map.submap import Submap
from dualslam.recovery.linking import DescriptorMatcher, LinkEstimate, estimate_link
from dualslam.recovery.overlap_refinement import RefinedOverlap, gauge_at_overlap, graft_keyframes, refine_overlap
from dualslam.testing.link_worlds import FRAME_STEP, Case, hamming, make_case, make_world

CONFIG = FusionConfig()
MATCHER = DescriptorMatcher(hamming, 64.0)
OLD, NEW = range(14), range(10, 24)


def new_graph() -> ISam2SubmapGraph:
    return ISam2SubmapGraph(GraphConfig())


def relink(old: Submap, new: Submap, onset: int | None) -> LinkEstimate | Failure:
    return estimate_link(old, new, LinkingConfig(), np.random.default_rng(0), onset, MATCHER)


def linked(layout: str, seed: int) -> tuple[Case, LinkEstimate]:
    """Two solved maps that share four keyframes, and their link."""
    case = make_case(layout, seed, OLD, NEW)
    for submap in (case.old, case.new):
        solve(submap, new_graph())
    link = relink(case.old, case.new, None)
    assert isinstance(link, LinkEstimate)
    return case, link


def audit(case: Case, new: Submap, link: LinkEstimate, layout: str, seed: int) -> LinkAudit:
    atlas = Atlas()
    atlas.add(case.old)
    atlas.add(new)
    keyframes = tuple(range(FRAME_STEP * NEW.start, FRAME_STEP * OLD.stop, FRAME_STEP))
    atlas.link(Link(0, 1, link.S_old_new, link.covariance, LinkKind.RECOVERY, keyframes))
    truth = {FRAME_STEP * f: T for f, T in enumerate(make_world(layout, seed).T_w_cam)}
    (found,) = audit_links(atlas, [], truth)
    assert isinstance(found, LinkAudit)
    return found


@pytest.fixture(scope="module")
def room() -> tuple[Case, LinkEstimate, RefinedOverlap]:
    case, link = linked("room", 0)
    refinement = refine_overlap(case.old, case.new, link, new_graph, relink, CONFIG)
    assert isinstance(refinement, RefinedOverlap)
    return case, link, refinement


@pytest.mark.slow
def test_a_refined_seam_has_a_truer_link() -> None:
    """Over rooms and streets: the larger overlap, measured in one map, tells the scale better than the smaller one."""
    before, after = [], []
    for layout, seed in (("room", 0), ("room", 3), ("room", 5), ("street", 3), ("street", 4)):
        case, link = linked(layout, seed)
        refinement = refine_overlap(case.old, case.new, link, new_graph, relink, CONFIG)
        assert isinstance(refinement, RefinedOverlap)
        before.append(audit(case, case.new, link, layout, seed).scale)
        after.append(audit(case, refinement.submap, refinement.link, layout, seed).scale)
    assert np.abs(after).max() < 0.01
    assert np.abs(after).mean() < 0.8 * np.abs(before).mean()


def test_the_healthy_end_of_the_old_map_is_in_the_new_one(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, refinement = room
    grafted = set(refinement.report.keyframe_ids)
    assert grafted == {FRAME_STEP * f for f in range(10)}
    assert refinement.submap.keyframes.keys() == case.new.keyframes.keys() | grafted
    assert refinement.link.agreeing_keyframes.min() < link.agreeing_keyframes.min()
    # The solution keeps what was taken over: the two maps do not contradict each other.
    assert refinement.report.n_outliers < 0.1 * refinement.report.n_observations
    assert refinement.report.n_merged > 100


def test_duplicate_landmarks_have_the_views_of_both_maps(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, _ = room
    new = case.new.copy()
    n_before = case.new.n_observations(link.landmark_pairs[:, 1])
    graft_keyframes(case.old, new, link, 10)
    n_after = new.n_observations(link.landmark_pairs[:, 1])
    n_old = case.old.n_observations(link.landmark_pairs[:, 0])
    assert (n_after >= n_before).all()
    assert (n_after <= n_before + n_old).all()
    assert (n_after > n_before).mean() > 0.8
    # One feature, one landmark; and no landmark twice in a keyframe.
    obs = new.observations
    alive = np.flatnonzero(obs["alive"])
    for column in ("feature", "landmark"):
        pairs = np.column_stack([obs["kf"][alive], obs[column][alive]])
        assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_grafted_points_stand_where_the_link_puts_them(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, _ = room
    new = case.new.copy()
    report = graft_keyframes(case.old, new, link, 3)
    assert report.keyframe_ids == (21, 24, 27)
    S_new_old = sim3.inverse(link.S_old_new)
    for k in report.keyframe_ids:
        np.testing.assert_allclose(new.T_submap_kf[k], sim3.act_on_pose(S_new_old, case.old.T_submap_kf[k]), atol=1e-9)
        both = (new.landmark_of[k] >= len(case.new.landmarks)) & (case.old.landmark_of[k] >= 0)
        there = case.old.landmarks["xyz_mu"][case.old.landmark_of[k][both]]
        np.testing.assert_allclose(
            new.landmarks["xyz_mu"][new.landmark_of[k][both]], sim3.act(S_new_old, there), atol=1e-9
        )


def test_neither_map_is_changed(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, _ = room
    old, new = case.old.copy(), case.new.copy()
    refine_overlap(case.old, case.new, link, new_graph, relink, CONFIG)
    for before, after in ((old, case.old), (new, case.new)):
        assert before.keyframes.keys() == after.keyframes.keys()
        assert all(np.array_equal(before.T_submap_kf[k], after.T_submap_kf[k]) for k in before.keyframes)
        assert np.array_equal(before.landmarks["xyz_mu"], after.landmarks["xyz_mu"])
        assert np.array_equal(before.observations["alive"], after.observations["alive"])


def test_a_link_that_the_refined_seam_contradicts_is_not_made(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, _ = room

    def another(old: Submap, new: Submap, onset: int | None) -> LinkEstimate | Failure:
        found = relink(old, new, onset)
        assert isinstance(found, LinkEstimate)
        return replace(found, S_old_new=found.S_old_new @ sim3.from_parts(1.06, np.eye(3), np.zeros(3)))

    refused = refine_overlap(case.old, case.new, link, new_graph, another, CONFIG)
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.CONTRADICTION
    assert refused.numbers["scale_second"] / refused.numbers["scale_first"] == pytest.approx(1.06, abs=0.02)


def test_without_keyframes_to_take_in_the_seam_stays_as_it_is(room: tuple[Case, LinkEstimate, RefinedOverlap]) -> None:
    case, link, _ = room
    refinement = refine_overlap(case.old, case.new, link, new_graph, relink, FusionConfig(overlap_keyframes=0))
    assert isinstance(refinement, Failure)
    assert refinement.reason is FailureReason.DISABLED


def test_the_gauge_goes_to_the_widest_baseline_of_the_overlap() -> None:
    """Else the scale of the overlap drifts away under the link while the map is still solved at its other end."""
    case, link = linked("street", 0)
    assert case.new.gauge not in {(39, 30), (30, 39)}
    assert gauge_at_overlap(case.new, link.agreeing_keyframes) == (39, 30)
    # An overlap that spans less than the gauge in use does not get it.
    case.new.gauge = (69, 36)
    assert gauge_at_overlap(case.new, link.agreeing_keyframes) == (69, 36)
    assert gauge_at_overlap(case.new, np.array([39])) == (69, 36)
