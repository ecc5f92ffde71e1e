"""The readout time of a rolling shutter by a map's own observations, on points whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from dualslam.core.estimates import KeyframeReport, ReadoutEstimate
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.jobs import Ended
from dualslam.core.noise_model import GATE_SIGMAS, INFLATION
from dualslam.core.types import Failure, Features, FloatArray, Frame, IntArray, Keyframe, Track, View
from dualslam.frontends.tracking.map_readout import MIN_KEYFRAMES, ReadoutQuestion, answer_readout, ask_readout
from dualslam.frontends.tracking.rolling_shutter import TurnMeter
from dualslam.frontends.tracking.turning import correct_shutter, find_as_read, straighten
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.map.submap import Submap
from dualslam.system.camera import shutter_watch
from dualslam.system.system import System
from dualslam.testing.point_world import CAMERA, RATE_HZ, PointWorld, cloud, pose_errors, system_in
from tests.frontends.tracking.test_rolling_shutter import read_row_by_row, turn_rate
from tests.seeds import first_of

READOUT_S = 0.025
N = 60


def walk(n: int) -> FloatArray:
    """A camera that moves aside and looks about fast, up to 70 degrees a second."""
    s = np.arange(n) / RATE_HZ
    R = so3.exp(np.column_stack([0.15 * np.sin(3 * s), 0.35 * np.sin(3.5 * s), 0.1 * np.sin(4 * s)]))
    return se3.from_parts(R, np.column_stack([1.5 * np.sin(0.8 * s), 0.3 * np.sin(2 * s), 0.3 * np.sin(1.7 * s)]))


def points_of(world: PointWorld, features: Features) -> IntArray:
    """Return which point of the world each feature is, by its descriptor."""
    bits = np.bitwise_count(features.descriptors[:, None] ^ world.descriptors[None]).sum(2)
    return np.asarray(bits.argmin(1), np.int64)


def made_map(readout_s: float, seed: int = 0) -> tuple[Submap, dict[int, FloatArray]]:
    """A map of every third frame with true poses and points, seen row by row; and the turn at each keyframe."""
    world = PointWorld(cloud(400, seed=seed), walk(N), seed=seed)
    submap = Submap(0, CAMERA.K, world.descriptors[0])
    ids = np.arange(1, N - 1, 3)
    for i in ids.tolist():
        view = read_row_by_row(world, i, readout_s)
        submap.add_keyframe(Keyframe(i, view.timestamp_s, view.features), world.T_world_cam[i])
    submap.add_landmarks(world.xyz, world.descriptors, np.ones(len(world.xyz)), 1)
    for i in ids.tolist():
        point = points_of(world, submap.keyframes[i].features)
        _, feature = np.unique(point, return_index=True)
        submap.add_observations(i, feature, point[feature])
    return submap, {i: turn_rate(world.T_world_cam, i) for i in ids.tolist()}


def told(submap: Submap, rates: dict[int, FloatArray]) -> ReadoutEstimate:
    question = ask_readout(submap, rates, CAMERA.size_px)
    assert isinstance(question, ReadoutQuestion)
    before = question.T_cam_submap.copy()
    answer = answer_readout(question)
    assert np.array_equal(before, question.T_cam_submap)
    return answer


@pytest.mark.parametrize("readout_s", [0.004, READOUT_S])
@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_a_map_tells_the_readout_time(readout_s: float, seed: int) -> None:
    submap, rates = made_map(readout_s, seed)
    before = {k: T.copy() for k, T in submap.T_submap_kf.items()}
    answer = told(submap, rates)
    assert answer.more_s == pytest.approx(readout_s, abs=0.05 * readout_s + 0.0003)
    assert answer.more_s > GATE_SIGMAS * INFLATION * answer.sigma_s
    assert all(np.array_equal(before[k], T) for k, T in submap.T_submap_kf.items())


@pytest.mark.parametrize("seed", first_of([0, 1, 2]))
def test_a_global_shutter_is_told_as_such(seed: int) -> None:
    answer = told(*made_map(0.0, seed))
    assert abs(answer.more_s) < 0.0003
    assert abs(answer.more_s) < GATE_SIGMAS * INFLATION * answer.sigma_s


def test_a_keyframe_that_shares_nothing_is_no_obstacle() -> None:
    submap, rates = made_map(READOUT_S)
    alone = sorted(submap.keyframes)[7]
    submap.observations["alive"][submap.observations["kf"] == alone] = False
    assert told(submap, rates).more_s == pytest.approx(READOUT_S, abs=0.002)


def test_a_camera_that_does_not_turn_at_all_tells_nothing() -> None:
    submap, rates = made_map(0.0)
    assert not shutter_watch._is_sure(told(submap, {k: np.zeros(3) for k in rates}))


def test_an_unsure_answer_changes_nothing() -> None:
    """Where a camera hardly turns, other errors pass for a readout."""
    assert shutter_watch._is_sure(ReadoutEstimate(0.02, 0.0009, 30, 5000))
    assert shutter_watch._is_sure(ReadoutEstimate(-0.02, 0.0009, 30, 5000))
    assert not shutter_watch._is_sure(ReadoutEstimate(0.01, 0.0009, 30, 5000))
    assert not shutter_watch._is_sure(ReadoutEstimate(-0.03, 0.002, 30, 5000))


def test_an_answer_that_came_late_counts_for_the_map_that_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first map was lost before its answer was looked at; the next one asks nevertheless, and meets both."""
    system, taken = system_in(PointWorld(cloud(), walk(2)), camera={"readout_s": None}), []
    watch, ended, maps = system._shutter_watch, [], []
    desk = SimpleNamespace(
        n_open=lambda kind, of: sum(each == of for each in maps),
        submit=lambda kind, work, of: (ended.append(Ended(work, len(ended))), maps.append(of)),
        poll=lambda kind: [],
    )
    monkeypatch.setattr(watch, "_desk", desk)
    monkeypatch.setattr(watch, "_shutter", SimpleNamespace(is_stated=False, readout_s=0.0, ask=lambda *_: object()))
    monkeypatch.setattr(watch, "_take_answer", lambda result, *_: taken.append(result))
    for m in range(2):
        submap = made_map(0.0)[0]
        submap.id = m
        desk.poll = (lambda kind: []) if m == 0 else (lambda kind: ended)
        live = cast(VisualOdometry, SimpleNamespace(submap=submap))
        watch.ask_if_due(live)
        watch.collect(live, Frame(0, 0.0, None), ())
    assert taken == [1]


@pytest.mark.parametrize("was_s", [0.015, 0.035])
def test_what_is_left_is_told_of_a_map_that_was_corrected(was_s: float) -> None:
    submap, rates = made_map(READOUT_S)
    for k, keyframe in submap.keyframes.items():
        features = correct_shutter(keyframe.features, CAMERA, was_s * rates[k])
        submap.keyframes[k] = replace(keyframe, features=features)
    assert told(submap, rates).more_s == pytest.approx(READOUT_S - was_s, abs=0.0015)


def test_a_few_keyframes_tell_nothing() -> None:
    submap, rates = made_map(READOUT_S)
    few = dict(list(rates.items())[: MIN_KEYFRAMES - 1])
    assert not ask_readout(submap, few, CAMERA.size_px)


def test_pixels_are_put_back_to_where_they_were_read() -> None:
    rng = np.random.default_rng(0)
    uv = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (200, 2))
    turn_rad = np.array([0.02, -0.05, 0.03])
    straight = straighten(uv, CAMERA, turn_rad)  # rectified as well: there is no lens
    assert np.linalg.norm(straight - uv, axis=1).max() > 5
    assert np.linalg.norm(find_as_read(straight, straight, CAMERA, turn_rad) - uv, axis=1).max() < 0.1


def run_of(world: PointWorld, true_readout_s: float, **camera: object) -> System:
    """Run the system on a world that is read row by row."""
    system = system_in(world, camera={"model_sigma_px": 0.0, **camera})
    shutter = system._state.parts.shutter

    def view_of(frame: Frame) -> View:
        return shutter.shutter_corrected(read_row_by_row(world, frame.index, true_readout_s), CAMERA)

    system._state.parts = replace(system._state.parts, view_of=view_of)
    for frame in world.frames():
        system.step(frame)
    return system


def looking_about(n: int) -> FloatArray:
    """A camera that moves aside and looks about: slowly, until there is a map, and then up to 50 degrees a second."""
    s = np.arange(n) / RATE_HZ
    looks = np.clip((np.arange(n) - 10) / 20, 0.1, 1.0)[:, None]
    R = so3.exp(looks * np.column_stack([0.08 * np.sin(3 * s), 0.25 * np.sin(3 * s), 0.08 * np.sin(4 * s)]))
    return se3.from_parts(R, np.column_stack([s, 0.3 * np.sin(2 * s), 0.3 * np.sin(1.7 * s)]))


@pytest.mark.slow
def test_a_map_finds_its_shutter_and_is_put_right() -> None:
    """The first answer errs towards the shutter that the map was made with: what contradicted it is refused.

    Over readouts of 10 to 20 ms it is 0.63 to 0.70 of the truth.
    """
    true_readout_s, T = 0.015, looking_about(120)
    world = PointWorld(cloud(length_m=7.0), T)
    system, taken_for_global = run_of(world, true_readout_s), run_of(world, true_readout_s, readout_s=0.0)
    found = [event for event in system.events if event.event is EventKind.SHUTTER_FOUND]
    assert found[0].submap == 0
    assert 0.5 * true_readout_s < found[-1].data["readout_s"] < 1.2 * true_readout_s
    errors = []
    for each in (system, taken_for_global):
        submap = each.atlas.submaps[0]
        ids = sorted(submap.keyframes)
        errors.append([float(np.sqrt(np.mean(error**2))) for error in pose_errors(submap.keyframe_poses(ids), T[ids])])
    (position, rotation), (position_global, rotation_global) = errors
    assert position < 0.7 * position_global
    assert rotation < rotation_global  # over three worlds 0.4 to 0.9 of it
    assert all(view.turn_rad is not None for view in system.buffer)
    assert not [event for event in taken_for_global.events if event.event is EventKind.SHUTTER_FOUND]


@pytest.mark.slow
def test_keyframes_have_the_turn_that_their_poses_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever matches have told before there was a pose."""
    T = looking_about(60)
    world = PointWorld(cloud(length_m=4.0), T)
    monkeypatch.setattr(TurnMeter, "rate_rad_s", lambda self, view, K: np.array([0.3, -0.3, 0.3]))
    turns: dict[int, FloatArray] = {}
    inserted = VisualFrontEnd.insert_keyframe

    def noting(
        self: VisualFrontEnd, track: Track, in_haste: bool = False, pose_is_given: bool = False
    ) -> KeyframeReport | Failure:
        assert track.view.turn_rad is not None
        turns[track.view.index] = track.view.turn_rad
        return inserted(self, track, in_haste, pose_is_given)

    monkeypatch.setattr(VisualFrontEnd, "insert_keyframe", noting)
    run_of(world, 0.004, readout_s=0.004)
    off = [np.linalg.norm(turn / 0.004 - _turn_to(T, i)) for i, turn in turns.items()]
    assert len(off) >= 3
    assert np.median(off) < 0.1


def _turn_to(T_world_cam: FloatArray, i: int) -> FloatArray:
    """True turn from the frame before, rad/s."""
    return RATE_HZ * so3.log(T_world_cam[i - 1, :3, :3].T @ T_world_cam[i, :3, :3])


@pytest.mark.slow
def test_a_global_shutter_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where pixels agree, few keyframes are needed: the map is asked early."""
    monkeypatch.setattr(shutter_watch, "FIRST_KEYFRAMES", MIN_KEYFRAMES)
    system = run_of(PointWorld(cloud(length_m=7.0), looking_about(120)), 0.0)
    assert len(system.atlas.submaps[0].keyframes) > MIN_KEYFRAMES
    assert not [event for event in system.events if event.event is EventKind.SHUTTER_FOUND]
