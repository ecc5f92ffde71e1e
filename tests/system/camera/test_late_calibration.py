"""A camera that is found while the map goes on: what has come since changes with it, and nothing is left behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.jobs import JobKind
from dualslam.core.types import FloatArray, Frame, View
from dualslam.map.lens import CalibrationAnswer, change_camera
from dualslam.run.results import trajectories_of
from dualslam.system.camera.background import merge_calibrated
from dualslam.system.system import System
from dualslam.testing.late_desk import LateDesk
from dualslam.testing.point_world import pose_errors
from tests.backend.test_self_calibration import TRUE, make_submap, wrong_camera
from tests.system.camera.test_lens import WRONG, CalibrationWorld

N_FRAMES = 60


def late_system(polls: int, recovery: bool = False, waits: bool = False) -> tuple[System, CalibrationWorld]:
    """`waits`: there is no clock, and a map that may end is waited for."""
    settings = {
        "calibration": {"first_keyframes": 12, "max_observations": 6000},
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
        "recovery": {"enabled": recovery},
        "tracking": {"max_lost_s": 0.25},
    }
    system, world = build_system(Config.model_validate(settings), wrong_camera(WRONG)), CalibrationWorld()
    system._calibrations._desk = LateDesk(system._state.parts.desk.executor, polls)
    system._state.pace.in_real_time = not waits
    system.pace.clock = lambda: 0.0  # how busy the machine is does not count
    return system, world


def run(polls: int, n_frames: int = N_FRAMES, blind: range = range(0), waits: bool = False) -> System:
    system, world = late_system(polls, waits=waits)
    calibration = system._state.parts.calibration

    def view_of(frame: Frame) -> object:
        view = world.view(frame, calibration)
        return replace(view, features=view.features.take(np.arange(0))) if frame.index in blind else view

    system._state.parts = replace(system._state.parts, view_of=view_of)  # type: ignore[arg-type]
    for i in range(n_frames):
        system.step(Frame(i, i / 30, None))
    system.finish()
    return system


def errors(system: System) -> tuple[FloatArray, FloatArray]:
    main, world = trajectories_of(system).main, CalibrationWorld()
    return pose_errors(main.T_world_cam, np.array([world.T_world_cam(i) for i in main.index.tolist()]))


@pytest.fixture(scope="module")
def in_time() -> System:
    return run(polls=0)


@pytest.mark.slow
@pytest.mark.parametrize("polls", [3, pytest.param(15, marks=pytest.mark.slow)])
def test_a_late_answer_is_as_good_as_one_in_time(in_time: System, polls: int) -> None:
    late = run(polls)
    asked, found = (system.events.of_kind(EventKind.CALIBRATED)[0] for system in (in_time, late))
    assert found.frame == asked.frame + polls
    assert found.data["log_focal"] == pytest.approx(asked.data["log_focal"], abs=1e-12)  # the same snapshot was asked
    (submap,) = late.atlas.submaps.values()
    camera = late._state.parts.calibration.camera
    np.testing.assert_array_equal(submap.K, camera.K)
    for keyframe in submap.keyframes.values():
        np.testing.assert_allclose(keyframe.features.uv_rect_px, camera.rectify(keyframe.features.uv_px)[0])
    assert len(late.poses) == len(in_time.poses)
    assert not late.events.of_kind(EventKind.FAILED, EventKind.GAP_RELOCALISED)
    for measured, expected in zip(errors(late), errors(in_time), strict=True):
        assert np.sqrt((measured**2).mean()) < 1.3 * np.sqrt((expected**2).mean()) + 1e-3


@pytest.mark.parametrize("polls", [pytest.param(0, marks=pytest.mark.slow), 3])
def test_what_frames_have_seen_changes_with_the_camera(in_time: System, polls: int) -> None:
    """Those from before the change, too, have the pixels that the map has now."""
    system = in_time if polls == 0 else run(polls)
    changed = system.events.of_kind(EventKind.CALIBRATED)[0].frame
    observations, camera = system._state.record.observations, system._state.parts.calibration.camera
    assert sum(i < changed for i in observations) > 10 < sum(i > changed for i in observations)
    for seen in observations.values():
        np.testing.assert_allclose(seen.uv_rect_now_px(), camera.rectify(seen.uv_px)[0], atol=1e-3)


@pytest.mark.slow
def test_an_answer_for_a_map_that_was_lost_meanwhile_changes_nothing(in_time: System) -> None:
    asked = in_time.events.of_kind(EventKind.CALIBRATED)[0].frame
    system = run(polls=40, n_frames=asked + 60, blind=range(asked + 5, asked + 30))
    assert system.events.of_kind(EventKind.FAILED)
    lost, *_ = system.atlas.submaps.values()
    kept = system.events.of_kind(EventKind.CALIBRATION_KEPT)[0]
    assert kept.submap == lost.id
    assert "live no more" in kept.data["reason"]
    np.testing.assert_array_equal(lost.K, wrong_camera(WRONG).K)
    # A map that begins afterwards may ask its own question, whose answer the end of the run waits for.
    assert all(found.submap != lost.id for found in system.events.of_kind(EventKind.CALIBRATED))


@pytest.mark.slow
def test_at_the_end_all_maps_take_the_camera_that_they_find_together(in_time: System) -> None:
    asked, *_, last = in_time.events.of_kind(EventKind.CALIBRATED)
    assert asked.submap == 0
    assert last.submap is None
    off = [abs(event.data["log_focal"] + np.log(WRONG)) for event in (asked, last)]
    assert off[1] < off[0] or off[1] < last.data["log_focal_sigma"]
    assert last.data["log_focal_sigma"] < 0.7 * asked.data["log_focal_sigma"]
    camera = in_time._state.parts.calibration.camera
    for submap in in_time.atlas.submaps.values():
        np.testing.assert_array_equal(submap.K, camera.K)


@pytest.mark.parametrize("is_lost", [False, True])
def test_without_a_clock_a_map_that_ends_has_the_answer_first(in_time: System, is_lost: bool) -> None:
    """It is to come after a hundred frames; the run, or the map, ends five after the question."""
    asked = in_time.events.of_kind(EventKind.CALIBRATED)[0].frame
    end = asked + 5
    system = run(100, end + 1, range(end, end + 1) if is_lost else range(0), waits=True)
    (found,) = system.events.of_kind(EventKind.CALIBRATED)
    assert found.frame == end
    (submap,) = system.atlas.submaps.values()
    np.testing.assert_array_equal(submap.K, system._state.parts.calibration.camera.K)


def test_a_next_start_has_the_pixels_of_a_camera_that_was_found_while_the_map_was_about_to_be_lost() -> None:
    """From the question on, all that is seen looks like nothing in the map; the answer comes after five such frames."""
    system, world = late_system(polls=5)
    calibration, unlike, begun = system._state.parts.calibration, np.random.default_rng(5), list[View]()

    def view_of(frame: Frame) -> View:
        view = world.view(frame, calibration)
        if not system._calibrations._desk.n_open(JobKind.CALIBRATION) and not system._state.lost:
            return view
        descriptors = unlike.integers(0, 256, view.features.descriptors.shape, np.uint8)
        return replace(view, features=replace(view.features, descriptors=descriptors))

    system._state.parts = replace(system._state.parts, view_of=view_of)
    system._starting.begin_anew = begun.extend  # type: ignore[assignment, method-assign]
    for i in range(N_FRAMES):
        system.step(Frame(i, i / 30, None))
        if begun:
            break
    (found,) = system.events.of_kind(EventKind.CALIBRATED)
    assert [view.index for view in begun] == list(range(begun[0].index, begun[-1].index + 1))
    assert begun[0].index < begun[-1].index == found.frame - 1
    for view in begun:
        np.testing.assert_allclose(view.features.uv_rect_px, calibration.camera.rectify(view.features.uv_px)[0])


@pytest.mark.slow
def test_a_map_is_asked_as_it_is_lost_and_the_next_begins_with_its_camera() -> None:
    """It is not its time to be asked."""
    system, world = late_system(0, recovery=True)
    calibration, blind = system._state.parts.calibration, range(40, 55)
    calibration.is_due = lambda *_: False  # type: ignore[method-assign]

    def view_of(frame: Frame) -> View:
        view = world.view(frame, calibration)
        return replace(view, features=view.features.take(np.arange(0))) if frame.index in blind else view

    system._state.parts = replace(system._state.parts, view_of=view_of)
    for i in range(N_FRAMES):
        system.step(Frame(i, i / 30, None))
        if i > blind[-1] and system.live is not None:
            break
    (found,) = system.events.of_kind(EventKind.CALIBRATED)
    assert found.frame == blind[0]
    camera = calibration.camera
    assert abs(np.log(camera.K[0, 0] / TRUE.fx)) < 0.25 * np.log(WRONG)
    for submap in system.atlas.submaps.values():
        np.testing.assert_array_equal(submap.K, camera.K)
        for keyframe in submap.keyframes.values():
            np.testing.assert_allclose(keyframe.features.uv_rect_px, camera.rectify(keyframe.features.uv_px)[0])
    assert system.live is not None
    assert not system.events.of_kind(EventKind.LINK_REFUSED)
    system.finish()
    assert len(trajectories_of(system).main.index) > N_FRAMES / 2


@pytest.mark.slow
def test_where_a_lost_map_waits_the_end_of_the_run_gives_both_the_camera_that_is_found() -> None:
    system, world = late_system(0, recovery=True)
    calibration, blind = system._state.parts.calibration, range(30, 45)
    for name in ("is_due", "is_due_at_loss"):
        setattr(calibration, name, lambda *_: False)

    def view_of(frame: Frame) -> View:
        view = world.view(frame, calibration)
        return replace(view, features=view.features.take(np.arange(0))) if frame.index in blind else view

    system._state.parts = replace(system._state.parts, view_of=view_of)
    system._recoveries.settle = lambda live: None  # type: ignore[method-assign]
    for i in range(N_FRAMES):
        system.step(Frame(i, i / 30, None))
    assert not system.events.of_kind(EventKind.CALIBRATED)
    assert system._recoveries.waiting
    system.finish()
    assert len(system.events.of_kind(EventKind.CALIBRATED)) == 1
    assert abs(np.log(calibration.camera.K[0, 0] / TRUE.fx)) < 0.25 * np.log(WRONG)
    for submap in system.atlas.submaps.values():
        np.testing.assert_array_equal(submap.K, calibration.camera.K)


def test_what_has_come_since_follows() -> None:
    """The newest three keyframes were not there when the submap was asked; the answer moves all, and doubles depths."""
    live = make_submap(TRUE, turning=True, n=12)
    live.gauge = (0, 8)
    base = live.copy()
    for k in (9, 10, 11):
        del base.keyframes[k], base.T_submap_kf[k], base.landmark_of[k]
    rows = np.flatnonzero(base.observations["kf"] >= 9)
    base.observations["alive"][rows] = False
    changed = base.copy()
    camera = wrong_camera(1.1)
    change_camera(changed, camera)
    changed.transform(2.0, se3.exp(np.array([0.0, 0.1, 0.0, 0.3, 0.0, 0.0])))
    merged = merge_calibrated(live, base, CalibrationAnswer(camera, np.eye(5), changed, {}, {}))
    expected = live.copy()
    expected.transform(2.0, se3.exp(np.array([0.0, 0.1, 0.0, 0.3, 0.0, 0.0])))
    for k in live.keyframes:
        np.testing.assert_allclose(merged.T_submap_kf[k], expected.T_submap_kf[k], atol=1e-9)
        features = merged.keyframes[k].features
        np.testing.assert_allclose(features.uv_rect_px, camera.rectify(features.uv_px)[0])
    alive = live.landmarks["alive"]
    np.testing.assert_allclose(merged.landmarks["xyz_mu"][alive], expected.landmarks["xyz_mu"][alive], atol=1e-9)
    np.testing.assert_array_equal(merged.K, camera.K)
    assert live.K[0, 0] == TRUE.K[0, 0]
