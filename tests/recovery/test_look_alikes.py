"""After a gap before what repeats itself: linked where the camera's velocity tells the answers apart, else apart."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.types import FailureReason
from dualslam.lab.metrics.alignment import align_points
from dualslam.lab.synthetic import make_sequence
from dualslam.run.results import trajectories_of
from dualslam.system import System

GAP_AT = 75


def past_a_gap(world: str, seed: int, missing: int) -> tuple[System, float, int]:
    """Run a world that repeats itself without some frames; the RMS error of the main map and its frames beyond them."""
    sequence = make_sequence(world, n_frames=130, seed=seed, width=480, height=360, supersampling=1.0)
    system = build_system(Config.model_validate({"seed": seed}), sequence.camera)
    for frame in sequence:
        if not GAP_AT <= frame.index < GAP_AT + missing:
            system.step(frame)
    system.finish()
    main = trajectories_of(system).main
    p, q = main.T_world_cam[:, :3, 3], sequence.ground_truth_T_world_cam[main.index][:, :3, 3]
    s, R, t = align_points(p, q)
    rmse_m = float(np.sqrt(((s * p @ R.T + t - q) ** 2).sum(axis=1).mean()))
    return system, rmse_m, int((main.index >= GAP_AT).sum())


@pytest.mark.slow
def test_a_rival_that_the_camera_cannot_have_come_to_forbids_no_link() -> None:
    """Cars 5.5 m apart at 5.5 m/s: one period off within 0.6 s is an acceleration that no car has shown."""
    system, rmse_m, n_beyond = past_a_gap("parked", 1, 17)
    (linked,) = system.events.of_kind(EventKind.LINKED)
    assert linked.data["rivals"] > 0
    assert n_beyond > 30
    assert rmse_m < 0.1


@pytest.mark.slow
def test_the_wrong_one_of_two_is_not_believed_and_what_is_beyond_it_has_no_pose() -> None:
    """A board in whose gap the first pose is one period off: two maps, each right, and none of the walk beyond."""
    system, rmse_m, n_beyond = past_a_gap("board", 1, 17)
    assert not system.events.of_kind(EventKind.LINKED)
    refused = system.events.of_kind(EventKind.LINK_REFUSED)
    assert any(event.data["reason"] in (FailureReason.LEAP, FailureReason.LOOK_ALIKE) for event in refused)
    assert n_beyond == 0
    assert rmse_m < 0.02
    later = list(trajectories_of(system).unlinked.values())
    assert [int(component.index.min()) >= GAP_AT + 17 for component in later] == [True]
