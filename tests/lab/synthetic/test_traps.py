"""The worlds in which maps go wrong unseen are what they are called."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.traps import (
    BOARD_PERIOD_M,
    BOARD_SPEED_M_S,
    CAR_PERIOD_M,
    CAR_SPEED_M_S,
    HOVER_S,
    TRAPS,
)
from tests.seeds import first_of

SMALL = {"width": 160, "height": 120, "supersampling": 1.0}


@pytest.mark.parametrize("scene", first_of(sorted(TRAPS)))
def test_each_is_the_same_for_the_same_seed(scene: str) -> None:
    first, again = (make_sequence(scene, n_frames=40, seed=3, **SMALL) for _ in range(2))
    assert np.array_equal(first.frame(20).image, again.frame(20).image)
    assert np.array_equal(first.ground_truth_T_world_cam, again.ground_truth_T_world_cam)


@pytest.mark.parametrize(
    ("scene", "period_s"), [("board", BOARD_PERIOD_M / BOARD_SPEED_M_S), ("parked", CAR_PERIOD_M / CAR_SPEED_M_S)]
)
def test_what_repeats_looks_the_same_a_period_on(scene: str, period_s: float) -> None:
    world = make_sequence(scene, n_frames=80, seed=1, **SMALL)
    n = round(period_s * world.rate_hz)
    T, period_m = world.ground_truth_T_world_cam, BOARD_PERIOD_M if scene == "board" else CAR_PERIOD_M
    assert np.linalg.norm(T[10 + n, :3, 3] - T[10, :3, 3]) > 0.8 * period_m
    ahead = np.repeat(T[10][None], 2, axis=0)
    ahead[:, 0, 3] += [period_m, 0.5 * period_m]  # the same camera, moved by a period exactly
    here, there, between = (world._renderer.image(T_world_cam).astype(float) for T_world_cam in (T[10], *ahead))
    assert np.abs(here - there).mean() < 0.5 * np.abs(here - between).mean()


def test_the_bench_is_a_sixth_of_a_metre_off_and_leaves_the_view() -> None:
    world = make_sequence("takeoff", n_frames=130, seed=2, **SMALL)
    near = [float(np.quantile(world.depth(i)[np.isfinite(world.depth(i))], 0.05)) for i in (0, 129)]
    assert near[0] < 0.5 < 1.0 < near[1]


def test_a_standstill_is_one_and_a_hover_moves_by_millimetres() -> None:
    still = make_sequence("standstill", n_frames=60, seed=2, **SMALL).ground_truth_T_world_cam
    hover = make_sequence("hover", n_frames=240, seed=2, **SMALL).ground_truth_T_world_cam
    assert np.linalg.norm(still[8, :3, 3] - still[0, :3, 3]) < 0.02
    assert np.linalg.norm(still[-1, :3, 3] - still[0, :3, 3]) > 5.0
    n = int(HOVER_S * 30)
    assert 0.001 < np.linalg.norm(hover[:n, :3, 3] - hover[0, :3, 3], axis=1).max() < 0.05
    assert np.linalg.norm(hover[-1, :3, 3] - hover[0, :3, 3]) > 0.2
