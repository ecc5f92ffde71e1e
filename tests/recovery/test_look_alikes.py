"""Past what repeats itself: no frame lands one period off, however it was lost and whoever poses it."""

from __future__ import annotations

from collections.abc import Container

import pytest

from dualslam.build import build_system
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.types import FailureReason, FloatArray, IntArray
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.traps import BOARD_PERIOD_M, CAR_PERIOD_M
from dualslam.run.results import trajectories_of
from dualslam.system.system import System


def past_a_gap(
    world: str, seed: int, missing: Container[int], first: int = 0, n: int = 130
) -> tuple[System, IntArray, FloatArray]:
    """Return the system, the frames of the main map, and how far (N,) each is off in metres; some are `missing`."""
    sequence = make_sequence(world, n_frames=n, seed=seed, width=480, height=360, supersampling=1.0)
    system = build_system(Config.model_validate({"seed": seed}), sequence.camera)
    for i in range(first, n):
        if i not in missing:
            system.step(sequence.frame(i))
    system.finish()
    main = trajectories_of(system).main
    p, q = main.T_world_cam[:, :3, 3], sequence.ground_truth_T_world_cam[main.index][:, :3, 3]
    return system, main.index, distances_when_aligned(p, q)


@pytest.mark.slow
def test_a_frame_lost_long_before_a_gap_is_not_posed_by_a_leap_over_the_map_that_lost_it() -> None:
    """Of parked cars: the map beyond the gap is linked, and its way to the frame is a leap of a second."""
    _, _, off_m = past_a_gap("parked", 37, range(75, 92), first=30)
    assert off_m.max() < 0.1 * CAR_PERIOD_M


@pytest.mark.slow
def test_of_the_poses_beyond_a_gap_the_one_is_gone_by_that_the_camera_can_have_come_to() -> None:
    """The board is the same a third of a metre on, and the images show the wrong one first."""
    system, frames, off_m = past_a_gap("board", 1, range(75, 92))
    (linked,) = system.events.of_kind(EventKind.LINKED)
    assert linked.data["rivals"] > 0
    refused = [event.data["reason"] for event in system.events.of_kind(EventKind.LINK_REFUSED)]
    assert FailureReason.LEAP in refused
    assert len(frames) == 130 - 17
    assert off_m.max() < 0.1 * BOARD_PERIOD_M


@pytest.mark.slow
def test_where_the_camera_may_have_come_to_two_the_maps_stay_apart() -> None:
    """The hand sways by as much as the velocities would have to tell apart."""
    system, frames, off_m = past_a_gap("board", 2, range(75, 99))
    assert not system.events.of_kind(EventKind.LINKED)
    refused = [event.data["reason"] for event in system.events.of_kind(EventKind.LINK_REFUSED)]
    assert FailureReason.LOOK_ALIKE in refused
    assert frames.max() < 75
    assert off_m.max() < 0.1 * BOARD_PERIOD_M
    later = list(trajectories_of(system).unlinked.values())
    assert [int(component.index.min()) >= 99 for component in later] == [True]


@pytest.mark.slow
@pytest.mark.parametrize(("world", "period_m"), [("parked", CAR_PERIOD_M), ("board", BOARD_PERIOD_M)])
def test_after_two_seconds_nothing_is_posed_a_period_off(world: str, period_m: float) -> None:
    """Of thirty like prints in each image, all of which may be the right one, and of a row of like cars."""
    system, _, off_m = past_a_gap(world, 104, range(75, 135), first=30, n=170)
    assert off_m.max() < 0.1 * period_m
    assert len(system.atlas.submaps) > 1
