"""The audit of links: exact maps of a known path, links that are true, and links that are wrong by a known amount."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import Failure, FloatArray, Keyframe
from dualslam.io.trajectory_files import Trajectory
from dualslam.lab.audits.link_audit import LinkAudit, UnbrokenAudit, audit_links, audit_unbroken, truth_by_frame
from dualslam.map.submap import Submap
from dualslam.testing.point_world import path, random_features

N = 60
OVERLAP = (26, 28, 30)
# From the world to each map.
S_OLD_WORLD = sim3.from_parts(0.4, so3.exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, -1.0]))
S_NEW_WORLD = sim3.from_parts(2.0, so3.exp(np.array([-0.1, 0.9, 0.0])), np.array([-3.0, 0.0, 1.0]))
S_OLD_NEW = S_OLD_WORLD @ sim3.inverse(S_NEW_WORLD)


def world(straight: bool = False) -> FloatArray:
    turn = np.zeros(3) if straight else np.array([0.0, 0.02, 0.005])
    return path(N, np.array([0.05, 0.0, 0.2]), turn)


def submap(m: int, S: FloatArray, frames: range, T_world_cam: FloatArray) -> Submap:
    made = Submap(m, np.eye(3), np.zeros(32, np.uint8))
    for k in frames:
        features = random_features(np.random.default_rng(k), 5)
        made.add_keyframe(Keyframe(k, 0.1 * k, features), sim3.act_on_pose(S, T_world_cam[k]))
    return made


def audit(
    S_link: FloatArray,
    T_world_cam: FloatArray,
    tail: float = 1.0,
    drift: tuple[int, float] = (N, 1.0),
    noise: float = 0.0,
) -> LinkAudit:
    """Audit a link between two maps.

    `tail`: scale of the old map from the overlap on, about the overlap: corrupted, which is not the link's fault.
    `drift`: a frame, and the scale of the new map from there on. `noise`: of the new map's centres, in its unit.
    """
    atlas = Atlas()
    old, new = submap(0, S_OLD_WORLD, range(36), T_world_cam), submap(1, S_NEW_WORLD, range(25, N), T_world_cam)
    pivot = old.T_submap_kf[OVERLAP[-1]][:3, 3].copy()
    for k in range(OVERLAP[-1] + 1, 36):
        old.T_submap_kf[k][:3, 3] = pivot + tail * (old.T_submap_kf[k][:3, 3] - pivot)
    rng = np.random.default_rng(0)
    since, scale = drift
    pivot = new.T_submap_kf[min(since, N - 1)][:3, 3].copy()
    for k, T in new.T_submap_kf.items():
        T[:3, 3] = pivot + (scale if k > since else 1.0) * (T[:3, 3] - pivot) + noise * rng.normal(size=3)
    atlas.add(old)
    atlas.add(new)
    atlas.link(Link(0, 1, S_link, np.eye(7), LinkKind.RECOVERY, OVERLAP))
    poses = [FramePose(i, 0.1 * i, int(i >= 30), i, np.eye(4)) for i in range(N)]
    (found,) = audit_links(atlas, poses, dict(enumerate(T_world_cam)), reach=4)
    assert isinstance(found, LinkAudit)
    return found


@pytest.mark.parametrize("straight", [False, True])
def test_a_true_link_has_no_error(straight: bool) -> None:
    found = audit(S_OLD_NEW, world(straight), tail=1.4)
    assert abs(found.scale) < 1e-9
    assert found.rotation_deg < 1e-5
    assert found.position < 1e-9
    assert not found.wrong


def test_a_wrong_scale_is_named_in_full() -> None:
    wrong = S_OLD_NEW @ sim3.from_parts(1.08, np.eye(3), np.zeros(3))
    found = audit(wrong, world())
    assert found.scale == pytest.approx(0.08)
    assert found.shared_scale == pytest.approx(0.08)
    assert found.wrong


def test_a_wrong_turn_is_named_in_full() -> None:
    about_the_overlap = sim3.act(S_NEW_WORLD, world()[28][:3, 3])
    turn = se3.from_parts(so3.exp(np.radians([0.0, 4.0, 0.0])), np.zeros(3))
    shift = se3.from_parts(np.eye(3), about_the_overlap)
    found = audit(S_OLD_NEW @ shift @ turn @ se3.inverse(shift), world())
    assert found.rotation_deg == pytest.approx(4.0)
    assert abs(found.scale) < 1e-9
    assert found.wrong


def test_a_wrong_place_is_given_in_metres_of_the_world() -> None:
    aside_m = sim3.rotation(S_NEW_WORLD) @ np.array([1.0, 0.0, 0.0])
    shifted = S_OLD_NEW @ se3.from_parts(np.eye(3), 2.0 * aside_m)  # the new map's unit is half a metre
    found = audit(shifted, world())
    assert found.position_m == pytest.approx(1.0)
    assert found.wrong == (1.0 / found.path_m > 0.05)


def test_a_scale_that_was_lost_on_the_way_to_the_live_end_makes_the_link_wrong() -> None:
    found = audit(S_OLD_NEW, world(), drift=(35, 1.2))
    assert abs(found.scale) < 1e-9  # at the overlap it is true
    assert found.live_scale == pytest.approx(0.2)
    assert found.wrong
    assert found.surely_wrong
    assert found.worst_scale == pytest.approx(0.2)
    assert found.shared_scale is not None
    assert abs(found.shared_scale) < 1e-9  # and over what both maps posed


def test_what_drifts_after_the_start_is_not_the_links_fault() -> None:
    found = audit(S_OLD_NEW, world(), drift=(45, 1.5))
    assert not found.wrong
    assert abs(found.worst_scale) < 1e-9


@pytest.mark.parametrize(("bent", "error"), [(1.0, 0.0), (1.2, 1 / 1.2 - 1)])
def test_a_map_that_never_broke_is_audited_at_the_same_places(bent: float, error: float) -> None:
    T = world()
    found = audit(S_OLD_NEW, T, drift=(35, 1.2))
    assert found.frames_live is not None
    first = found.frames_live[0]
    assert found.frames_old[1] < first
    whole = sim3.act_on_pose(S_NEW_WORLD, T)
    pivot = whole[first, :3, 3].copy()  # from the live end on it is stretched
    whole[first:, :3, 3] = pivot + (whole[first:, :3, 3] - pivot) / bent
    control = audit_unbroken(found, dict(enumerate(whole)), dict(enumerate(T)))
    assert isinstance(control, UnbrokenAudit)
    assert abs(control.scale) < 1e-9
    assert control.live_scale == pytest.approx(error, abs=1e-9)


def test_a_map_without_frames_where_the_link_is_says_nothing() -> None:
    T = world()
    found = audit(S_OLD_NEW, T)
    assert isinstance(audit_unbroken(found, {0: np.eye(4)}, dict(enumerate(T))), Failure)


def test_no_more_frames_count_than_it_takes_to_tell() -> None:
    wider = audit(S_OLD_NEW, world(), noise=0.05)
    nearer = audit(S_OLD_NEW, world(), noise=0.001)
    assert nearer.n_new < wider.n_new
    assert 2.0 * nearer.scale_sigma < 0.05


def test_the_truth_of_a_noisy_map_has_its_sigma() -> None:
    T = world()
    rng = np.random.default_rng(0)
    noisy = T.copy()
    noisy[:, :3, 3] += 0.05 * rng.normal(size=(N, 3))
    atlas = Atlas()
    atlas.add(submap(0, S_OLD_WORLD, range(36), noisy))
    atlas.add(submap(1, S_NEW_WORLD, range(25, N), noisy))
    atlas.link(Link(0, 1, S_OLD_NEW, np.eye(7), LinkKind.RECOVERY, OVERLAP))
    (found,) = audit_links(atlas, [], dict(enumerate(T)))
    assert isinstance(found, LinkAudit)
    assert 0.002 < found.scale_sigma < 0.04
    assert abs(found.scale) < 4 * found.scale_sigma


def test_frames_without_truth_are_left_out_and_too_few_are_said_so() -> None:
    T = world()
    truth = truth_by_frame(np.arange(N), 0.1 * np.arange(N), Trajectory(0.1 * np.arange(40, 60) + 0.001, T[40:]))
    assert sorted(truth) == list(range(40, 60))
    atlas = Atlas()
    atlas.add(submap(0, S_OLD_WORLD, range(36), T))
    atlas.add(submap(1, S_NEW_WORLD, range(25, N), T))
    atlas.link(Link(0, 1, S_OLD_NEW, np.eye(7), LinkKind.RECOVERY, OVERLAP))
    (found,) = audit_links(atlas, [], truth)
    assert not isinstance(found, LinkAudit)
    assert "submap 0" in found.detail
