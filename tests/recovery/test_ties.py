"""A part of a map that lies askew, and has mapped again what the rest shows, is tied to it and comes to lie right."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pytest

from dualslam.backend.final_refinement import refine_submap, settle_ties
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.tracking.registrar import Registrar
from dualslam.map.submap import Submap
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, pose_errors
from tests.recovery.test_registration import true_map

N, STEP, LAST = 120, 6, 96  # frames, frames between keyframes, and the first frame of the part that lies askew
ASKEW_RAD = np.radians(6.0)
POSITION_M = 0.03


@pytest.fixture(scope="module")
def world() -> PointWorld:
    return PointWorld(cloud(300), hand_held(N))


def lying_askew(world: PointWorld) -> Submap:
    """Return a map whose last part has landmarks of its own, and is turned about its first camera by `ASKEW_RAD`.

    A third of the points look there as they did before.
    """
    submap, later = true_map(world, range(0, LAST, STEP)), PointWorld(world.xyz, world.T_world_cam)
    later.descriptors[np.arange(len(later.xyz)) % 3 > 0] ^= 255
    again = true_map(later, range(LAST, N, STEP))
    centre, R = again.T_submap_kf[LAST][:3, 3], so3.exp(np.array([0.0, ASKEW_RAD, 0.0]))
    again.transform(1.0, se3.from_parts(R, centre - R @ centre))
    ids = submap.copy_landmarks(again, np.arange(len(again.landmarks)))
    for k, keyframe in again.keyframes.items():
        submap.add_keyframe(keyframe, again.T_submap_kf[k])
        feature = np.flatnonzero(again.landmark_of[k] >= 0)
        submap.add_observations(k, feature, ids[again.landmark_of[k][feature]])
    return submap


def all_alike(ids: Collection[int]) -> dict[int, list[int]]:
    """Return for each keyframe all others: it may resemble any."""
    return {k: [other for other in ids if other != k] for k in ids}


def errors(submap: Submap, world: PointWorld) -> FloatArray:
    ids = sorted(submap.keyframes)
    position, _ = pose_errors(submap.keyframe_poses(ids), world.T_world_cam[ids])
    return position


def test_a_part_that_lies_askew_comes_to_lie_right(world: PointWorld) -> None:
    submap = lying_askew(world)
    config = Config()
    before = errors(submap, world)
    registrar = Registrar(OrbFrontend(), config, submap, CAMERA)
    assert registrar.tie(all_alike) > 50
    settle_ties(submap, config.graph.robust_k)
    refine_submap(submap, config.graph.robust_k)
    assert before.max() > 3 * POSITION_M
    assert errors(submap, world).max() < POSITION_M


def test_a_map_that_shares_its_landmarks_is_left_alone(world: PointWorld) -> None:
    submap = true_map(world, range(0, N, STEP))
    registrar = Registrar(OrbFrontend(), Config(), submap, CAMERA)
    assert registrar.tie(all_alike) == 0
