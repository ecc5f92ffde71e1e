"""A camera that reads row by row while it turns: found out from pixels alone, and taken out of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.settings import CameraConfig
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray, Frame, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.tracking.pair_readout import READOUT_EVIDENCE, READOUTS_S, ReadoutEstimator, _mean
from dualslam.frontends.tracking.rolling_shutter import RollingShutter, TurnMeter
from dualslam.frontends.tracking.turning import correct_shutter, turn_between
from dualslam.system.system import System
from dualslam.testing.point_world import (
    CAMERA,
    RATE_HZ,
    SIZE_PX,
    PointWorld,
    cloud,
    make_features,
    path,
    pose_errors,
    system_in,
)
from tests.seeds import first_of

READOUT_S = 0.025


def shaken(n: int) -> FloatArray:
    """A hand that looks about fast, 60 degrees a second and more, and hardly moves."""
    s = np.arange(n) / RATE_HZ
    R = so3.exp(np.column_stack([0.2 * np.sin(5 * s), 0.3 * np.sin(4 * s + 1), 0.15 * np.sin(6 * s + 2)]))
    return se3.from_parts(R, 0.05 * np.column_stack([np.sin(3 * s), np.sin(2.5 * s), np.sin(2 * s)]))


def turn_rate(T_world_cam: FloatArray, i: int) -> FloatArray:
    """True turn about frame i, rad/s."""
    R = T_world_cam[:, :3, :3]
    return 0.5 * RATE_HZ * so3.log(R[i - 1].T @ R[i + 1])


def read_row_by_row(world: PointWorld, i: int, readout_s: float) -> View:
    """What a rolling shutter finds: each point where its own row sees it."""
    view = world.view(i)
    if not 0 < i < len(world.T_world_cam) - 1 or not readout_s:
        return view
    turn_rad = readout_s * turn_rate(world.T_world_cam, i)
    features, uv = view.features, view.features.uv_px
    rays = np.column_stack([(uv - CAMERA.K[:2, 2]) / np.diag(CAMERA.K)[:2], np.ones(len(uv))])
    bent = uv
    for _ in range(5):  # the row in which a point is found depends on where it is found
        late = bent[:, 1] / CAMERA.height - 0.5
        bent = CAMERA.project(np.einsum("nji,nj->ni", so3.exp(late[:, None] * turn_rad), rays))
    inside = ((bent > 0) & (bent < SIZE_PX)).all(axis=1)
    return replace(view, features=replace(features, uv_px=bent, uv_rect_px=bent).take(inside))


def asked(world: PointWorld, readout_s: float) -> tuple[RollingShutter, list[bool]]:
    """The shutter after all frames, and from which of them a map might have started."""
    shutter = RollingShutter(OrbFrontend(), CameraConfig(), 0)
    started: list[bool] = []
    for i in range(len(world.T_world_cam)):
        view = read_row_by_row(world, i, readout_s)
        started.append(shutter.may_start(view, CAMERA))
    return shutter, started


@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_readout_is_found_from_pixels(seed: int) -> None:
    world = PointWorld(cloud(seed=seed), shaken(120), seed=seed)
    shutter, started = asked(world, READOUT_S)
    assert shutter.readout_s == pytest.approx(READOUT_S, abs=0.005)
    assert not all(started[:20])
    assert all(started[-20:])


@pytest.mark.parametrize("seed", first_of([2, 0]))
def test_a_short_readout_that_is_hardly_told_from_none_keeps_no_map_waiting(seed: int) -> None:
    """It lies between two of the times that are tried, which fit alike, and all others are ruled out."""
    shutter, started = asked(PointWorld(cloud(seed=seed), shaken(60), seed=seed), 0.003)
    assert shutter.readout_s == pytest.approx(0.003, abs=0.001)
    assert all(started[-20:])


@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_images_turned_upside_down_are_read_from_their_last_row_on(seed: int) -> None:
    world = PointWorld(cloud(seed=seed), shaken(120), seed=seed)
    shutter = RollingShutter(OrbFrontend(), CameraConfig(), 0)
    for i in range(120):
        shutter.may_start(shutter.shutter_corrected(read_row_by_row(world, i, -READOUT_S), CAMERA), CAMERA)
    assert shutter.readout_s == pytest.approx(-READOUT_S, abs=0.005)


def turned_left(view: View) -> View:
    """Return what a film shows whose images were turned by a quarter, as those of a telephone held upright."""
    uv_px = np.column_stack([view.features.uv_px[:, 1], SIZE_PX[0] - view.features.uv_px[:, 0]])
    return replace(view, features=replace(view.features, uv_px=uv_px, uv_rect_px=uv_px))


@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_an_upright_image_is_read_column_by_column(seed: int) -> None:
    world = PointWorld(cloud(seed=seed), shaken(120), seed=seed)
    width, height = SIZE_PX
    (fx, fy), (cx, cy) = np.diag(CAMERA.K)[:2], CAMERA.K[:2, 2]
    camera = PinholeCamera(height, width, fy, fx, cy, width - cx)
    shutter = RollingShutter(OrbFrontend(), CameraConfig(), 0)
    views = [turned_left(read_row_by_row(world, i, READOUT_S)) for i in range(120)]
    for view in views:
        shutter.may_start(shutter.shutter_corrected(view, camera), camera)
    assert shutter.readout_s == pytest.approx(READOUT_S, abs=0.005)
    straight = shutter.all_corrected(views[40:60], camera)[5].features.uv_rect_px
    true = turned_left(read_row_by_row(world, 45, 0.0)).features.uv_rect_px
    apart = np.linalg.norm(straight[:, None] - true[None], axis=2).min(axis=1)
    assert np.median(apart) < 1.0


@pytest.mark.parametrize("dropped", [(), (7, 8), (20, 41, 42, 43, 77), tuple(range(5, 160, 11))], ids=str)
def test_readout_gets_better_while_no_map_starts_whichever_frames_are_missing(dropped: tuple[int, ...]) -> None:
    world = PointWorld(cloud(seed=2), shaken(180), seed=2)
    shutter = RollingShutter(OrbFrontend(), CameraConfig(), 0)
    found: list[float] = []
    for i in set(range(180)) - set(dropped):
        shutter.may_start(shutter.shutter_corrected(read_row_by_row(world, i, READOUT_S), CAMERA), CAMERA)
        if shutter.readout_s and shutter.readout_s not in found:
            found.append(shutter.readout_s)
    assert found[-1] == pytest.approx(READOUT_S, abs=0.003)
    assert abs(found[-1] - READOUT_S) <= abs(found[0] - READOUT_S) + 0.001


def test_frames_that_were_corrected_are_corrected_anew() -> None:
    """By twice the readout from what was read, not from what was corrected."""
    world = PointWorld(cloud(seed=1), shaken(30), seed=1)
    views = [read_row_by_row(world, i, READOUT_S) for i in range(30)]
    shutter = RollingShutter(OrbFrontend(), CameraConfig(readout_s=READOUT_S / 2), 0)
    half = [shutter.shutter_corrected(view, CAMERA) for view in views]
    shutter._was_s, shutter.readout_s = READOUT_S / 2, READOUT_S
    anew = shutter.all_corrected(half, CAMERA)
    direct = RollingShutter(OrbFrontend(), CameraConfig(readout_s=READOUT_S), 0)
    for view, again in zip(views, anew, strict=True):
        expected = direct.shutter_corrected(view, CAMERA)
        assert np.allclose(again.features.uv_px, expected.features.uv_px, atol=0.01)


def test_frames_are_corrected_one_by_one_as_all_together() -> None:
    """In any order, and by whichever time they were corrected before."""
    world = PointWorld(cloud(seed=1), shaken(30), seed=1)
    views = [read_row_by_row(world, i, READOUT_S) for i in range(9)]
    shutter = RollingShutter(OrbFrontend(), CameraConfig(), 0)
    for view in views[:-1]:
        shutter.may_start(view, CAMERA)
    assert shutter.readout_s == 0  # not known yet
    shutter.readout_s = READOUT_S / 2
    assert shutter.correction([view.index for view in views], CAMERA) is None  # of the last one no turn is known
    by_half = shutter.correction([view.index for view in views[:-1]], CAMERA)
    assert by_half is not None
    half = [by_half(view) for view in views[:-1]]
    shutter.readout_s = READOUT_S
    correct = shutter.correction([view.index for view in views[:-1]], CAMERA)
    assert correct is not None
    together = shutter.all_corrected(views[:-1], CAMERA)
    for mixed, expected in zip(reversed([*views[:4], *half[4:]]), reversed(together), strict=True):
        assert np.allclose(correct(mixed).features.uv_px, expected.features.uv_px, atol=0.01)
        assert np.allclose(correct(mixed).turn_rad, expected.turn_rad)


@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_a_global_shutter_is_left_alone(seed: int) -> None:
    world = PointWorld(cloud(seed=seed), shaken(120), seed=seed)
    shutter, started = asked(world, 0.0)
    assert shutter.readout_s == 0
    assert all(started[-20:])


def test_a_slow_camera_is_not_kept_waiting() -> None:
    world = PointWorld(cloud(), path(30, np.array([0.1, 0, 0]), np.array([0, 0.01, 0])))
    _, started = asked(world, READOUT_S)
    assert all(started)


def test_straightened_pixels_are_those_of_a_global_shutter() -> None:
    world = PointWorld(cloud(), shaken(12), noise_px=0.0)
    for i in (3, 7):
        found = read_row_by_row(world, i, READOUT_S).features
        exact = world.view(i).features
        row = {word.tobytes(): n for n, word in enumerate(exact.descriptors)}
        same = [row[word.tobytes()] for word in found.descriptors]
        straight = correct_shutter(found, CAMERA, READOUT_S * turn_rate(world.T_world_cam, i))
        off_before = np.linalg.norm(found.uv_px - exact.uv_px[same], axis=1)
        off = np.linalg.norm(straight.uv_rect_px - exact.uv_px[same], axis=1)
        assert off_before.max() > 5
        assert off.max() < 1e-3
        assert np.allclose(straight.uv_px, straight.uv_rect_px)


def test_the_turn_is_that_of_the_frame() -> None:
    world = PointWorld(cloud(), shaken(40))
    meter = TurnMeter(OrbFrontend())
    off = []
    for i, view in enumerate(world.views()[:-1]):
        rate = meter.rate_rad_s(view, CAMERA.K)
        if i >= 2:
            off.append(np.linalg.norm(rate - turn_rate(world.T_world_cam, i)))
    fastest = max(np.linalg.norm(turn_rate(world.T_world_cam, i)) for i in range(1, 39))
    assert fastest > 1.0
    assert np.median(off) < 0.1 * fastest


def stamped(world: PointWorld, steps: list[int]) -> list[View]:
    """The views in their order, each with the time of the step that is named."""
    return [replace(world.view(i), timestamp_s=step / RATE_HZ) for i, step in enumerate(steps)]


def test_a_frame_that_is_stamped_as_an_earlier_one_tells_no_turn() -> None:
    """The others do, and what it lasted until the next one bounds what is told there."""
    world = PointWorld(cloud(), path(12, np.array([0.02, 0, 0]), np.array([0, 0.03, 0])))
    meter, true = TurnMeter(OrbFrontend()), turn_rate(world.T_world_cam, 1)
    for i, view in enumerate(stamped(world, [0, 1, 2, 3, 4, 5, 4, 7, 7, 9, 8, 11])):
        rate = meter.rate_rad_s(view, CAMERA.K)
        assert (meter.between_rad_s is None) == (i in (0, 6, 8, 10))
        if i:
            assert 0.3 < rate @ true / (true @ true) < 1.2


def test_stamps_that_come_again_do_not_stop_the_search_for_a_readout() -> None:
    world = PointWorld(cloud(), path(6, np.array([0.02, 0, 0]), np.array([0, 0.08, 0])))
    true, chi2 = turn_rate(world.T_world_cam, 1), []
    for steps in ([0, 1, 2, 3, 4, 5], [0, 1, 0, 3, 4, 3]):  # of a steady turn it does not matter
        estimator = ReadoutEstimator(OrbFrontend(), 0, READOUT_EVIDENCE)
        for view in stamped(world, steps):
            estimator.add(view, true, CAMERA)
        chi2.append(estimator._chi2)
    assert chi2[0].any()
    np.testing.assert_allclose(chi2[1], chi2[0])


def test_a_view_knows_what_was_taken_out_of_it() -> None:
    world = PointWorld(cloud(), shaken(6))
    still = RollingShutter(OrbFrontend(), CameraConfig(readout_s=0.0), 0)
    assert still.shutter_corrected(world.view(0), CAMERA) is not None
    assert still.shutter_corrected(world.view(1), CAMERA).turn_rad is None
    assert still.may_start(world.view(2), CAMERA)
    rolling = RollingShutter(OrbFrontend(), CameraConfig(readout_s=READOUT_S), 0)
    views = [rolling.shutter_corrected(world.view(i), CAMERA) for i in range(5)]
    turn_rad = views[-1].turn_rad
    assert turn_rad is not None
    again = correct_shutter(world.view(4).features, CAMERA, turn_rad)
    assert np.array_equal(again.uv_rect_px, views[-1].features.uv_rect_px)


def test_turn_between_frames_survives_wrong_matches() -> None:
    rng = np.random.default_rng(0)
    turn = np.array([0.05, -0.2, 0.1])
    uv_a = rng.uniform([150, 120], [490, 360], (200, 2))
    rays = np.column_stack([(uv_a - CAMERA.K[:2, 2]) / np.diag(CAMERA.K)[:2], np.ones(200)])
    uv_b = CAMERA.project(rays @ so3.exp(turn)) + rng.normal(0, 0.5, (200, 2))
    uv_b[:60] = rng.uniform([0, 0], SIZE_PX, (60, 2))
    found = turn_between(CAMERA.K, uv_a, uv_b)
    assert found is not None
    assert np.linalg.norm(found - turn) < 0.002
    assert turn_between(CAMERA.K, uv_a[:10], uv_b[:10]) is None


def test_no_pixels_no_turn() -> None:
    empty = make_features(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64), np.empty((0, 32), np.uint8))
    meter = TurnMeter(OrbFrontend())
    for i in range(3):
        assert np.array_equal(meter.rate_rad_s(View(i, i / RATE_HZ, empty), CAMERA.K), np.zeros(3))


N_TURNING = 100


def run_over_a_turn(**camera: object) -> tuple[System, FloatArray]:
    """A rolling shutter that only turns for a hundred frames, and then moves."""
    turning, moving = shaken(N_TURNING), path(25, np.array([0.12, 0, 0]), np.array([0, 0.004, 0]))
    turning[:, :3, 3] = 0
    return run_over(np.concatenate([turning, turning[-1] @ moving]), **camera)


def run_over(T_world_cam: FloatArray, **camera: object) -> tuple[System, FloatArray]:
    world = PointWorld(cloud(), T_world_cam)
    system = system_in(world, camera={"model_sigma_px": 0.0, **camera})
    shutter = system._state.parts.shutter

    def view_of(frame: Frame) -> View:
        return shutter.shutter_corrected(read_row_by_row(world, frame.index, READOUT_S), CAMERA)

    system._state.parts = replace(system._state.parts, view_of=view_of)
    for frame in world.frames():
        system.step(frame)
    return system, world.T_world_cam


def first(system: System, kind: EventKind) -> Event:
    return next(event for event in system.events if event.event is kind)


@pytest.mark.slow
def test_a_turn_alone_starts_no_map() -> None:
    """With a shutter that is taken for a global one the shifts of the rows pass for parallax."""
    system, T_true = run_over_a_turn()
    found, started = first(system, EventKind.SHUTTER_FOUND), first(system, EventKind.INITIALISED)
    assert found.data["readout_s"] == pytest.approx(READOUT_S, abs=0.005)
    assert found.frame < N_TURNING <= started.frame
    assert all(view.turn_rad is not None for view in system.buffer)
    submap = system.atlas.submaps[0]
    posed = sorted(submap.keyframes)
    _, rotation = pose_errors(submap.keyframe_poses(posed), T_true[posed])
    row_shift = READOUT_S * max(np.linalg.norm(turn_rate(T_true, i)) for i in range(1, N_TURNING - 1))
    assert rotation.max() < 0.5 * row_shift
    taken_for_global, _ = run_over_a_turn(readout_s=0.0)
    assert first(taken_for_global, EventKind.INITIALISED).frame < N_TURNING


@pytest.mark.slow
def test_frames_from_before_the_shutter_was_known_start_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is known from frame 60 on, and the camera stands from frame 40 on."""
    T = shaken(80)
    T[:, :3, 3] *= 6
    T[40:] = T[40]

    def may_start(shutter: RollingShutter, view: View, _: object) -> bool:
        shutter.readout_s = READOUT_S if view.index >= 60 else 0.0
        return view.index >= 60

    monkeypatch.setattr(RollingShutter, "may_start", may_start)
    system, T_true = run_over(T)
    assert first(system, EventKind.INITIALISED).frame <= 40 < first(system, EventKind.SHUTTER_FOUND).frame
    submap = system.atlas.submaps[0]
    posed = sorted(submap.keyframes)
    _, rotation = pose_errors(submap.keyframe_poses(posed), T_true[posed])
    assert rotation.max() < np.radians(1)


def test_between_two_readout_times_that_fit_alike_lies_the_mean() -> None:
    """The better of both is chance, and the rim of what is tried is no minimum."""
    chi2 = 40.0 * np.array([9.0, 5.0, 3.0, 2.0, 0.1, 0.3, 0.2, 0.0])
    assert READOUTS_S[4] < _mean(chi2) < READOUTS_S[-1]
    chi2[-1] = 400.0
    chi2[5:] = 400.0
    assert _mean(chi2) == pytest.approx(READOUTS_S[4], abs=1e-3)
