"""What drift, other places and another unit make of a place that pixels have proved: on maps of exact poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FailureReason, FloatArray, FrameStatus
from dualslam.map.frame_records import FrameRow
from dualslam.places.plausibility import agree, contradict, plausible
from dualslam.places.verification import PlaceMatch
from dualslam.testing.graph_scene import guessed_submap, make_scene
from tests.linking.test_motion import way

N = 12
STEP = 0.12


def two_units(unit: float) -> tuple[Record, FloatArray]:
    """Map 0, map 1 that is the same in another frame and unit, linked; and the similarity from 1 to 0."""
    record = Record()
    T = se3.exp([0.4, -0.1, 0.2, 5.0, 1.0, -2.0])
    for m in (0, 1):
        submap = guessed_submap(make_scene(N, step=STEP), pose_noise=0.0, point_noise=0.0)
        submap.id = m
        if m == 1:
            submap.transform(unit, T)
        record.atlas.add(submap)
    S_0_1 = sim3.inverse(sim3.from_parts(unit, T[:3, :3], T[:3, 3]))
    record.atlas.link(Link(0, 1, S_0_1, 1e-6 * np.eye(7), LinkKind.RECOVERY, tuple(range(N))))
    return record, S_0_1


def aside(S_place_query: FloatArray, by: float) -> FloatArray:
    """Displace where a place is found, in its map's unit, to the side."""
    moved = S_place_query.copy()
    moved[:3, 3] += [by, 0, 0]
    return moved


def match(place: tuple[int, int], query: tuple[int, int], S_place_query: FloatArray) -> PlaceMatch:
    return PlaceMatch(place, query, S_place_query, np.eye(7), np.zeros((0, 2), np.int64), (), (), 90, 80)


@pytest.mark.parametrize("unit", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("place_in", [0, 1])
def test_drift_is_told_as_a_share_of_the_way_whatever_the_units(unit: float, place_in: int) -> None:
    record, S_0_1 = two_units(unit)
    centres = np.array([record.atlas.submaps[place_in].T_submap_kf[k][:3, 3] for k in range(N)])
    way = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())  # in the unit of the place's map
    S = S_0_1 if place_in == 0 else sim3.inverse(S_0_1)
    near = match((place_in, 0), (1 - place_in, N - 1), aside(S, 0.08 * way))
    assert plausible(record, near) is near
    assert near.numbers["drift"] == pytest.approx(0.08, rel=1e-6)
    assert near.numbers["drift_rot_deg"] == pytest.approx(0.0, abs=1e-4)
    assert near.numbers["drift_log_scale"] == pytest.approx(0.0, abs=1e-9)
    refused = plausible(record, match((place_in, 0), (1 - place_in, N - 1), aside(S, 0.12 * way)))
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.CONTRADICTION
    assert refused.numbers["drift"] == pytest.approx(0.12, rel=1e-6)


def test_a_place_that_is_found_in_another_unit_has_drifted_by_that() -> None:
    record, S_0_1 = two_units(2.0)
    bent = S_0_1.copy()
    bent[:3, :3] *= 4.0
    refused = plausible(record, match((0, 0), (1, N - 1), bent))
    assert isinstance(refused, Failure)
    assert refused.numbers["drift_log_scale"] == pytest.approx(np.log(4.0))


@pytest.mark.parametrize("unit", [0.3, 1.0, 4.0])
@pytest.mark.parametrize(("depths", "expected"), [(0.0, False), (0.7, False), (1.5, True)])
def test_two_places_contradict_each_other_by_depths_of_what_the_first_shows(
    unit: float, depths: float, expected: bool
) -> None:
    record, S_0_1 = two_units(unit)
    first = record.atlas.submaps[0]
    ids = first.landmark_of[0]
    depth = float(np.median(first.depths(ids[ids >= 0], se3.inverse(first.T_submap_kf[0]))))
    by = depths * depth * unit  # in the unit of map 1
    one = match((1, 0), (0, N - 1), aside(sim3.inverse(S_0_1), by))
    other = match((0, 0), (0, N - 1), np.eye(4))
    assert contradict(record.atlas, one, other) is expected
    assert contradict(record.atlas, other, one) is expected


def test_matches_agree_where_they_put_the_keyframe_at_one_place_of_one_map() -> None:
    record, S_0_1 = two_units(1.0)
    here = match((0, 0), (1, N - 1), S_0_1)
    assert agree(record.atlas, here, match((0, 1), (1, N - 1), aside(S_0_1, 0.001)))
    assert not agree(record.atlas, here, match((0, 1), (1, N - 1), aside(S_0_1, 1.0)))
    assert not agree(record.atlas, here, match((1, 0), (1, N - 1), S_0_1)), "of another map"


@pytest.mark.parametrize("unit", [0.3, 1.0, 4.0])
@pytest.mark.parametrize(("floors", "refused"), [(0.0, False), (1.0, True)])
def test_two_maps_whose_frames_follow_on_each_other_are_joined_where_the_camera_can_have_moved_so(
    unit: float, floors: float, refused: bool
) -> None:
    """Down a staircase: from frame 60 on, the second map shows what the first one has shown a floor above."""
    record, S_0_1 = two_units(unit)
    record.atlas.links.clear()
    times_s, centres = way(120, 5, sway_m=0.01)
    for i, (time_s, centre) in enumerate(zip(times_s, centres, strict=True)):
        T_0_cam, m = se3.from_parts(np.eye(3), centre), int(i >= 60)
        T_m_cam = sim3.act_on_pose(sim3.inverse(S_0_1) if m else np.eye(4), T_0_cam)
        T_kf_cam = se3.inverse(record.atlas.submaps[m].T_submap_kf[0]) @ T_m_cam
        record.poses[i] = FramePose(i, float(time_s), m, 0, T_kf_cam)
        record.rows[i] = FrameRow(i, float(time_s), FrameStatus.TRACKED, m)
    seen = replace(match((0, 8), (1, 11), aside(S_0_1, 2.0 * floors)), covariance=1e-6 * np.eye(7))
    assert isinstance(plausible(record, seen), Failure) is refused
