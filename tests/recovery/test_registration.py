"""Registration of frames in a finished map: what is found is right, and what is not certain is left out."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from functools import partial

import numpy as np
import pytest

from dualslam.backend.local_ba import adjust_and_prune, parallax_rad
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3, so3
from dualslam.core.types import Failure, FailureReason, FloatArray, Keyframe, Track
from dualslam.core.walk_news import WalkWatch
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.tracking.registrar import Registrar
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.recovery.registration import MIN_PARALLAX_DEG, Registration
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, pose_errors

POSITION_M, ROTATION_RAD = 0.03, 0.005


def true_map(world: PointWorld, keyframes: Iterable[int], n_points: int | None = None) -> Submap:
    """Return a submap in world coordinates, with every point, of the first so many, that two keyframes see."""
    submap, views = Submap(0, CAMERA.K, np.zeros(32, np.uint8)), {k: world.view(k) for k in keyframes}
    ids = np.full(len(world.xyz), NO_LANDMARK)
    point_of = {
        k: np.array([np.bitwise_count(world.descriptors ^ d).sum(1).argmin() for d in view.features.descriptors])
        for k, view in views.items()
    }
    n_seen = np.bincount(np.concatenate(list(point_of.values())), minlength=len(world.xyz))
    n_seen[len(n_seen) if n_points is None else n_points :] = 0
    for k, view in views.items():
        submap.add_keyframe(Keyframe(k, view.timestamp_s, view.features), world.T_world_cam[k])
        points, features = point_of[k], view.features
        new = (n_seen[points] > 1) & (ids[points] < 0)
        ids[points[new]] = submap.add_landmarks(
            world.xyz[points[new]], features.descriptors[new], features.scale[new], k
        )
        known = ids[points] >= 0
        submap.add_observations(k, np.flatnonzero(known), ids[points[known]])
    submap.gauge = (min(views), max(views))
    return submap


def registered(world: PointWorld, submap: Submap, frames: Iterable[int]) -> list[int]:
    """Register frames, each of which may resemble any keyframe; return those that were found."""
    config, frontend = Config(), OrbFrontend()
    adjust = partial(adjust_and_prune, robust_k=config.graph.robust_k, min_parallax_rad=np.radians(MIN_PARALLAX_DEG))
    views = {i: world.view(i) for i in frames}
    alike = {i: [k for k in (*submap.keyframes, *views) if k != i] for i in views}
    registrar = Registrar(frontend, config, submap, CAMERA)
    registration = Registration(submap, views, alike, registrar, adjust, config.health, WalkWatch())
    registration.run()
    return registration.added


def turn_about(n: int, step_rad: float, step_m: FloatArray, n_walked: int) -> FloatArray:
    """Walk some frames to the right, then turn in place."""
    i = np.arange(n)[:, None]
    turned = np.maximum(i - n_walked, 0) * np.array([[0.0, step_rad, 0.0]])
    return se3.from_parts(so3.exp(turned), np.minimum(i, n_walked) * step_m)


def test_frames_in_any_order_are_found_where_they_are() -> None:
    world = PointWorld(cloud(300), hand_held(120))
    submap = true_map(world, [0, 4, 8, 12])
    frames = [90, 50, 20, 110]
    assert sorted(registered(world, submap, frames)) == sorted(frames)
    ids = sorted(submap.keyframes)
    position, angle = pose_errors(submap.keyframe_poses(ids), world.T_world_cam[ids])
    assert position.max() < POSITION_M
    assert angle.max() < ROTATION_RAD


def test_a_frame_with_two_poses_is_asked_again_when_the_map_shows_more(monkeypatch: pytest.MonkeyPatch) -> None:
    world = PointWorld(cloud(300), hand_held(120))
    refuse, n_refused = Registrar.refuse_repeated, 0

    def refuse_once(self: Registrar, track: Track, keyframe_ids: Collection[int]) -> Failure | None:
        nonlocal n_refused
        if track.view.index == 20 and not n_refused:
            n_refused += 1
            return Failure(FailureReason.LOOK_ALIKE, "another pose explains as much")
        return refuse(self, track, keyframe_ids)

    monkeypatch.setattr(Registrar, "refuse_repeated", refuse_once)
    assert registered(world, true_map(world, [0, 4, 8, 12]), [20, 50]) == [50, 20]
    assert n_refused == 1


def test_frames_of_something_else_leave_the_map_as_it_was() -> None:
    world = PointWorld(cloud(300), hand_held(60), covered=frozenset(range(20, 60)))
    submap = true_map(world, [0, 4, 8, 12])
    before = submap.copy()
    assert registered(world, submap, range(20, 24)) == []
    assert submap.keyframes.keys() == before.keyframes.keys()
    np.testing.assert_array_equal(submap.landmarks["xyz_mu"], before.landmarks["xyz_mu"])


def test_like_bars_do_not_confirm_a_wrong_pose() -> None:
    """Near where one bar is expected another one is found; matches of whole images show none."""
    rng, n_bars = np.random.default_rng(3), 240
    fence = np.column_stack([np.linspace(-6, 6, n_bars), rng.uniform(-1.5, 1.5, n_bars), np.full(n_bars, 5.0)])
    world = PointWorld(np.concatenate([cloud(200), fence]), hand_held(60))
    world.descriptors[200:] = world.descriptors[200 + np.arange(n_bars) % 6]
    submap = true_map(world, [0, 10, 20], 200)
    wrong = world.T_world_cam[30] @ se3.exp(np.array([0.0, 0.02, 0.0, 0.3, 0.1, 0.0]))
    submap.add_keyframe(Keyframe(30, world.view(30).timestamp_s, world.features(30)), wrong)
    Registrar(OrbFrontend(), Config(), submap, CAMERA).extend(30, [0, 10, 20])
    assert len(submap.seen_in(30)) < 10


def test_a_turn_in_place_leads_no_farther_than_the_points_that_were_seen_from_two_places() -> None:
    n_walked, step_rad = 8, 0.12
    T = turn_about(24, step_rad, np.array([0.15, 0.0, 0.0]), n_walked)
    rng = np.random.default_rng(5)
    around = rng.normal(size=(1500, 3)) * [1.0, 0.25, 1.0]
    xyz = around / np.linalg.norm(around, axis=1)[:, None] * rng.uniform(6, 14, (1500, 1))
    world = PointWorld(xyz, T)
    submap = true_map(world, range(0, n_walked + 1, 4))
    found = registered(world, submap, range(n_walked + 1, 24))
    n_in_view = 2 * np.arctan(0.5 * CAMERA.width / CAMERA.K[0, 0]) / step_rad
    assert 0.5 * n_in_view < max(found) - n_walked < n_in_view
    ids = sorted(submap.keyframes)
    position, _ = pose_errors(submap.keyframe_poses(ids), T[ids])
    assert position.max() < POSITION_M


def test_parallax_is_the_widest_angle_between_rays() -> None:
    submap = Submap(0, CAMERA.K, np.zeros(32, np.uint8))
    world = PointWorld(
        np.array([[0.0, 0, 10], [1.0, 0, 10]]),
        se3.from_parts(np.eye(3)[None].repeat(3, 0), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])),
    )
    for k in range(3):
        submap.add_keyframe(Keyframe(k, float(k), world.features(k)), world.T_world_cam[k])
    ids = submap.add_landmarks(world.xyz, world.descriptors, np.ones(2), 0)
    for k in range(3):
        submap.add_observations(k, np.arange(2), ids)
    angles = parallax_rad(submap, ids)
    np.testing.assert_allclose(angles, [np.arctan(0.2), 2 * np.arctan(0.1)], rtol=1e-9)
