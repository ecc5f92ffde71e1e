"""Places that are alike look alike, and are not the same place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.path import pose
from dualslam.lab.synthetic.render import Renderer
from dualslam.lab.synthetic.twins import APART_M, CORRIDOR_M, ROOM_M, TWINS, make_corridors, make_posters

K = np.array([[130.0, 0.0, 79.5], [0.0, 130.0, 59.5], [0.0, 0.0, 1.0]])


def image(scene: Any, T_world_cam: FloatArray) -> FloatArray:
    return Renderer(scene, K, 160, 120, detail=0.5, supersampling=1.0).image(T_world_cam).astype(float)


def test_a_wall_of_one_corridor_is_that_of_the_other() -> None:
    scene, _ = make_corridors(5)
    own = pose(np.array([-0.3, -1.5, 0.4 * CORRIDOR_M[1]]), 1.4, -0.06, 0.0)
    first = pose(np.array([-APART_M / 2, 0.0, 0.0]), 0.0, 0.0, 0.0)
    second = pose(np.array([APART_M / 2, 0.0, CORRIDOR_M[1]]), np.pi, 0.0, 0.0)
    here, there, other = (
        image(scene, T) for T in (first @ own, second @ own, first @ pose(own[:3, 3], -1.4, -0.06, 0))
    )
    # The light falls from one side, so that levels differ; what is drawn does not.
    assert np.corrcoef(here.ravel(), there.ravel())[0, 1] > 0.9
    assert np.corrcoef(here.ravel(), other.ravel())[0, 1] < 0.5


def test_both_rooms_have_the_posters_and_their_own_furniture() -> None:
    scene, _ = make_posters(5)
    up, down = (
        [image(scene, pose(np.array([x, -1.6, 0.6]), 0.0, pitch, 0.0)) for x in (-ROOM_M[0] / 2, ROOM_M[0] / 2)]
        for pitch in (0.1, -0.5)
    )
    like, unlike = (np.corrcoef(a[:60].ravel(), b[:60].ravel())[0, 1] for a, b in (up, down))
    assert like > 0.8
    assert unlike < like - 0.3


@pytest.mark.parametrize("scene", sorted(TWINS))
def test_the_way_leads_through_free_space_from_one_to_the_other(scene: str) -> None:
    world = make_sequence(scene, n_frames=450, seed=7, width=160, height=120, supersampling=1.0)
    T = world.ground_truth_T_world_cam
    assert T[0, 0, 3] < -2
    assert T[-1, 0, 3] > 2
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).max() < 0.1
    for i in range(0, 450, 15):
        assert np.median(world.depth(i)) > 0.5
