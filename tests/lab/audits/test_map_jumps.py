"""Jumps of a map against the truth: a known place and size, and none where there is only drift and noise."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.trajectory import FramePose
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import sim3, so3
from dualslam.core.types import FloatArray, Keyframe
from dualslam.lab.audits.map_jumps import MapJump, find_map_jumps
from dualslam.map.submap import Submap
from dualslam.testing.point_world import path, random_features

N = 90
TRUTH = path(N, np.array([0.05, 0.0, 0.2]), np.array([0.0, 0.02, 0.005]))


def find(T_est: FloatArray, events: list[Event] | None = None) -> list[MapJump]:
    """The map has one keyframe; all frames are posed against it."""
    submap = Submap(3, np.eye(3), np.zeros(32, np.uint8))
    submap.add_keyframe(Keyframe(0, 0.0, random_features(np.random.default_rng(0), 5)), np.eye(4))
    atlas = Atlas()
    atlas.add(submap)
    poses = [FramePose(i, 0.1 * i, 3, 0, T) for i, T in enumerate(T_est)]
    return find_map_jumps(atlas, poses, dict(enumerate(TRUTH)), events or [])


def bent_from(frame: int, scale: float = 1.0, turn_deg: float = 0.0) -> FloatArray:
    """Everything from a frame on is another map: scaled and turned about that frame's camera."""
    T = TRUTH.copy()
    pivot = T[frame, :3, 3]
    R = so3.exp(np.radians([0.0, 0.0, turn_deg]))
    S = sim3.from_parts(scale, R, pivot - scale * R @ pivot)
    T[frame:] = sim3.act_on_pose(S, T[frame:])
    return T


def test_a_map_that_is_true_but_for_noise_and_drift_has_no_jump() -> None:
    rng = np.random.default_rng(0)
    noisy = TRUTH.copy()
    noisy[:, :3, 3] += 0.02 * rng.normal(size=(N, 3))
    assert find(noisy) == []
    growing = TRUTH.copy()
    steps = np.diff(TRUTH[:, :3, 3], axis=0) * (1 + 0.004 * np.arange(N - 1))[:, None]  # 40 % over the whole
    growing[1:, :3, 3] = TRUTH[0, :3, 3] + np.cumsum(steps, axis=0)
    assert find(growing) == []


@pytest.mark.parametrize(("scale", "turn_deg"), [(1.5, 0.0), (1.0, 6.0), (0.6, 5.0)])
def test_a_jump_is_found_at_its_place(scale: float, turn_deg: float) -> None:
    (jump,) = find(bent_from(45, scale, turn_deg))
    assert jump.submap == 3
    assert abs(jump.frame - 45) <= 3
    assert jump.log_scale == pytest.approx(-np.log(scale), abs=0.1)
    assert jump.rotation_deg == pytest.approx(turn_deg, abs=0.6)
    assert not jump.noticed


def test_a_jump_that_ends_the_map_was_noticed() -> None:
    def lost_at(frame: int) -> list[Event]:
        return [Event(EventKind.FAILED, frame, 0.1 * frame, 3)]

    assert find(bent_from(45, 1.5), lost_at(50))[0].noticed
    assert not find(bent_from(45, 1.5), lost_at(80))[0].noticed
    assert not find(bent_from(45, 1.5), lost_at(20))[0].noticed
