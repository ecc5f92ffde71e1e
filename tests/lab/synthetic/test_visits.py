"""A place on another day is the same place: what stands there for good, and what it looks like close by."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.errors import ConfigError
from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.circuit import make_circuit
from dualslam.lab.synthetic.visits import OtherWay, at_another_hour
from dualslam.run.sources import parse_world

SMALL = {"width": 160, "height": 120, "supersampling": 1.0}


def test_houses_stay_and_cars_come_and_go() -> None:
    scene, _ = make_circuit(3)
    later = at_another_hour(scene, 1)
    fixed = [[s.origin for s in each.surfaces if not s.parked] for each in (scene, later)]
    assert np.array_equal(*map(np.array, fixed))
    pictures = {s.texture for s in later.surfaces if not s.parked}
    assert pictures == {i for i, s in enumerate(scene.surfaces) if not s.parked}, "painted the same"
    cars = [sum(s.parked for s in each.surfaces) for each in (scene, later)]
    assert 0.2 * cars[0] < cars[1] < 0.8 * cars[0]
    assert not pictures & {s.texture for s in later.surfaces if s.parked}, "painted otherwise"
    light = np.array(
        [
            b.shade / a.shade
            for a, b in zip(*([s for s in e.surfaces if not s.parked] for e in (scene, later)), strict=True)
        ]
    )
    assert light.min() < 0.8 * light.max(), "the sun has moved"


def test_each_visit_is_another_and_the_same_again() -> None:
    frames = [make_sequence("circuit", 4, seed=2, visit=visit, **SMALL).frame(1).image for visit in (0, 1, 2, 1)]  # type: ignore[arg-type]
    assert np.array_equal(frames[1], frames[3])
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[1], frames[2])


def test_the_other_way_round_is_the_same_road() -> None:
    _, road = make_circuit(3)
    s = np.arange(0.0, 30.0, 3.0)
    other = OtherWay(road)
    assert np.allclose(other.centre(s), road.centre(road.length_m - s))
    assert np.allclose(np.cos(other.heading(s) - road.heading(-s)), -1)
    step = other.centre(s + 0.01) - other.centre(s)
    assert np.allclose(
        np.arctan2(step[:, 0], step[:, 1]), np.arctan2(np.sin(other.heading(s)), np.cos(other.heading(s))), atol=0.01
    )
    worlds = [make_sequence("circuit", 2, seed=3, backwards=b, **SMALL).ground_truth_T_world_cam[0] for b in (0, 1)]  # type: ignore[arg-type]
    assert np.linalg.norm(worlds[0][:3, 3] - worlds[1][:3, 3]) < 3.5, "the other lane of the same place"
    assert worlds[0][:3, 2] @ worlds[1][:3, 2] < -0.9, "the other way"


@pytest.mark.parametrize(
    ("scene", "option"), [("room", {"visit": 1}), ("street", {"backwards": 1}), ("circuit", {"visit": -1})]
)
def test_what_is_not_there_is_one_sentence(scene: str, option: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(option))):
        make_sequence(scene, 4, seed=0, **option)  # type: ignore[arg-type]


def test_a_source_names_its_visit() -> None:
    world = parse_world("synthetic:circuit,frames=5,seed=4,visit=2,backwards=1,width=64,height=48")
    assert (world.parameters["visit"], world.parameters["backwards"]) == (2, 1)
