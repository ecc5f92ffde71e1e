"""Past what repeats itself: no frame lands one period off, however it was lost and whoever poses it."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.config.settings import Config
from dualslam.lab.metrics.alignment import align_points
from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.traps import CAR_PERIOD_M
from dualslam.run.results import trajectories_of

GAP = range(75, 92)


@pytest.mark.slow
def test_a_frame_lost_long_before_a_gap_is_not_posed_by_a_leap_over_the_map_that_lost_it() -> None:
    """Of parked cars: the map beyond the gap is linked, and its way to the frame is a leap of a second."""
    sequence = make_sequence("parked", n_frames=130, seed=37, width=480, height=360, supersampling=1.0)
    system = build_system(Config.model_validate({"seed": 37}), sequence.camera)
    for frame in sequence:
        if frame.index not in GAP:
            system.step(frame)
    system.finish()
    main = trajectories_of(system).main
    p, q = main.T_world_cam[:, :3, 3], sequence.ground_truth_T_world_cam[main.index][:, :3, 3]
    s, R, t = align_points(p, q)
    assert np.linalg.norm(s * p @ R.T + t - q, axis=1).max() < 0.1 * CAR_PERIOD_M
