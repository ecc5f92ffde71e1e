"""Worlds that are come back to are come back to, and the terrace only looks like it."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.circuit import MODULE_M, make_circuit, make_eight

SMALL = {"width": 160, "height": 120, "supersampling": 1.0}


@pytest.mark.parametrize(("scene", "lap"), [("circuit", (250, 420)), ("eight", (480, 800))])
def test_a_lap_ends_where_it_began(scene: str, lap: tuple[int, int]) -> None:
    world = make_sequence(scene, n_frames=lap[1], seed=2, **SMALL)
    T = world.ground_truth_T_world_cam
    near = np.linalg.norm(T[lap[0] :, :3, 3] - T[0, :3, 3], axis=1)
    alike = np.einsum("nij,ij->n", T[lap[0] :, :3, :3], T[0, :3, :3]) > 2.98
    assert (near < 0.8)[alike].any()


@pytest.mark.parametrize("make", [make_circuit, make_eight])
def test_nothing_stands_in_the_camera_s_way(make: object) -> None:
    scene, road = make(4)  # type: ignore[operator]
    line = road.centre(np.arange(0, road.length_m, 1.0))
    upright = [s for s in scene.surfaces if not s.infinite and abs(s.side_t[1]) > 0.5]
    assert len(upright) > 100
    for surface in upright:
        foot = (surface.origin + 0.5 * surface.side_s)[[0, 2]]
        assert np.linalg.norm(line - foot, axis=1).min() > 2.0


def test_the_terrace_looks_the_same_a_module_on() -> None:
    n = round(MODULE_M)
    world = make_sequence("terrace", n_frames=2 * n + 4, seed=1, **SMALL)
    here, there, between = (world.frame(i).image[:55].astype(float) for i in (2, 2 + n, 2 + n // 2))
    assert np.abs(here - there).mean() < 0.5 * np.abs(here - between).mean()
