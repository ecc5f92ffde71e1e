"""Failure, reverse tracking, the link and the map's files, with descriptors that are nothing like ORB's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from dualslam.core.types import Features
from dualslam.io.map_files import load_submap, save_submap
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in
from tests.frontends.example_package.patch_corners import PatchFrontend

COVERED = frozenset(range(35, 50))
POSITION_M, ROTATION_RAD = 0.08, 0.01


@dataclass(frozen=True)
class SiftWorld(PointWorld):
    """Bytes that are unit vectors; continuous scales in thirds of a doubling; orientations that are not zero."""

    def features(self, i: int) -> Features:
        features = super().features(i)
        vectors = np.exp(0.6 * projected(features, 128))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        octave = np.rint(3 * np.log2(features.scale)).astype(np.int64)
        angle = np.full(len(features), 0.01 * i)
        descriptors = np.minimum(np.rint(512 * vectors), 255).astype(np.uint8)
        return replace(features, descriptors=descriptors, octave=octave, angle_rad=angle)


@dataclass(frozen=True)
class PatchWorld(PointWorld):
    """Unit vectors in single precision; a single octave."""

    def features(self, i: int) -> Features:
        features = super().features(i)
        vectors = projected(features, 64)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        ones = np.ones(len(features))
        return replace(features, descriptors=vectors.astype(np.float32), octave=0 * features.octave, scale=ones)


def projected(features: Features, length: int) -> np.ndarray:
    """The bits of the world's descriptors as as many normal numbers: nearby ones stay near."""
    signs = 2.0 * np.unpackbits(features.descriptors, axis=1) - 1.0
    return np.asarray(signs @ np.random.default_rng(7).normal(size=(256, length)) / 16)


@pytest.fixture(scope="module", params=[pytest.param(name, marks=pytest.mark.slow) for name in ("sift", "patches")])
def recovered(request: pytest.FixtureRequest) -> tuple[System, PointWorld]:
    """A run through a black-out, live features and recovery on the front end of that name."""
    patches = f"{PatchFrontend.__module__}:{PatchFrontend.__name__}"
    world_of, name = {"sift": (SiftWorld, "sift"), "patches": (PatchWorld, patches)}[request.param]
    world = world_of(cloud(), hand_held(70), covered=COVERED)
    system = system_in(world, recovery={"enabled": True}, frontend={"name": name})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system, world


def test_both_sides_of_a_black_out_end_in_one_map(recovered: tuple[System, PointWorld]) -> None:
    system, world = recovered
    assert len(system.atlas.submaps) == 2
    main = trajectories_of(system).main
    assert set(main.index.tolist()) == set(range(70)) - COVERED
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def test_descriptors_survive_the_map_files(recovered: tuple[System, PointWorld], tmp_path: Path) -> None:
    submap = recovered[0].atlas.submaps[0]
    save_submap(tmp_path / "0.npz", submap)
    again = load_submap(tmp_path / "0.npz")
    k = next(iter(submap.keyframes))
    for old, new in (
        (submap.landmarks["descriptor"], again.landmarks["descriptor"]),
        (submap.keyframes[k].features.descriptors, again.keyframes[k].features.descriptors),
    ):
        assert old.dtype == new.dtype
        np.testing.assert_array_equal(old, new)
