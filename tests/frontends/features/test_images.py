"""The whole system on rendered images, small ones: what only pixels can tell."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.core.config.corruption import Corruption
from dualslam.core.config.corruption import CorruptionKind as Spoil
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.types import FrameStatus
from dualslam.lab.synthetic import SyntheticSequence, make_sequence
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import pose_errors

SIZE = {"width": 320, "height": 240}
CONFIG = Config.model_validate({"frontend": {"n_features": 600}, "recovery": {"enabled": False}})


def run(sequence: SyntheticSequence) -> System:
    system = build_system(CONFIG, sequence.camera)
    for frame in sequence:
        system.step(frame)
    system.finish()
    return system


@pytest.mark.parametrize(
    ("scene", "n_frames", "size", "share"),
    [
        ("street", 40, SIZE, 0.02),
        pytest.param("room", 50, {"width": 640, "height": 480}, 0.02, marks=pytest.mark.slow),
    ],
    ids=["street", "room"],
)
def test_trajectory_is_right(scene: str, n_frames: int, size: dict[str, int], share: float) -> None:
    """Positions to a share of the path, or of the scene's depth where that is longer, all drift included."""
    sequence = make_sequence(scene, n_frames, seed=2, **size)
    system = run(sequence)
    main = trajectories_of(system).main
    assert len(main) >= 0.95 * n_frames
    truth = sequence.ground_truth_T_world_cam[main.index]
    translation, rotation = pose_errors(main.T_world_cam, truth)
    length = np.linalg.norm(se3.inverse(truth[:-1])[:, :3, 3] - se3.inverse(truth[1:])[:, :3, 3], axis=1).sum()
    depth = np.median(sequence.depth(0)[np.isfinite(sequence.depth(0))])
    assert translation.max() < share * max(length, depth)
    assert rotation.max() < 0.02


@pytest.mark.parametrize("kind", [Spoil.BLACKOUT, pytest.param(Spoil.WIPE, marks=pytest.mark.slow)])
def test_no_map_starts_while_nothing_is_seen(kind: Spoil) -> None:
    hidden = range(15, 28)
    dark = Corruption(kind=kind, start=hidden.start, length=len(hidden))
    sequence = make_sequence("street", 42, seed=1, events=[dark], **SIZE)
    system = run(sequence)
    assert len(system.atlas.submaps) == 2
    (again,) = system.events.of_kind(EventKind.REINITIALISED)
    assert again.frame >= hidden.stop
    for index in hidden:
        assert index not in system.poses
        assert system.rows[index].status in (FrameStatus.LOST, FrameStatus.INITIALISING)
