"""The verdict on the camera of a run."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.events import EventKind
from dualslam.run.camera_judgement import judge_camera
from dualslam.system.audit.verdict import Level, ReasonCode
from tests.cli.fakes import FakeSystem

KEPT, TAKEN = EventKind.CALIBRATION_KEPT, EventKind.CALIBRATED


def system_that_answered(*answers: tuple[EventKind, float, float, float]) -> FakeSystem:
    """Return a system with answers about its camera: kind, log focal, its sigma, change of the path."""
    system = FakeSystem({0: np.eye(4)})
    for n, (kind, log_focal, sigma, path_change) in enumerate(answers):
        data = {"log_focal": log_focal, "log_focal_sigma": sigma, "path_change": path_change}
        system.events.add(kind, 60 + n, 2.0 + n, 0, prior_sigmas=abs(log_focal) / 0.05, **data)
    return system


def level_of(system: FakeSystem) -> Level:
    found, _ = judge_camera(system)  # type: ignore[arg-type]
    assert found is None or found[0] is ReasonCode.CAMERA
    return Level.GOOD if found is None else found[1]


@pytest.mark.parametrize(
    ("log_focal", "path_change", "level"),
    [
        (-0.06, 0.006, Level.GOOD),
        (-0.24, 0.003, Level.GOOD),  # a road: far off, but the path hardly changes
        (-0.2, 0.015, Level.USABLE),
        (-0.4, 0.015, Level.DOUBTFUL),  # too far from what was given to be that camera
        (0.04, 0.061, Level.DOUBTFUL),
    ],
)
def test_a_camera_counts_by_what_it_does_to_the_path(log_focal: float, path_change: float, level: Level) -> None:
    system = system_that_answered((KEPT, -0.2, 0.01, 0.5), (KEPT, log_focal, 0.008, path_change))
    assert level_of(system) is level
    assert judge_camera(system)[1]["camera"] == path_change  # type: ignore[arg-type]


def test_another_lens_that_was_taken_over_leaves_a_run_usable() -> None:
    """Its focal length is as given, its distortion is not."""
    system = FakeSystem({0: np.eye(4)})
    answer = {"log_focal": 0.03, "log_focal_sigma": 0.005, "k1": -0.28, "path_change": 0.0, "prior_sigmas": 9.4}
    system.events.add(TAKEN, 60, 2.0, None, **answer)
    assert level_of(system) is Level.USABLE


@pytest.mark.parametrize(
    ("later", "level"),
    [
        ([], Level.USABLE),
        ([(KEPT, -0.21, 0.01, 0.0)], Level.GOOD),
        ([(TAKEN, -0.24, 0.005, 0.005)], Level.GOOD),
        ([(KEPT, 0.0, 0.05, 0.0)], Level.USABLE),  # neither sure nor beyond chance: no answer
        ([(KEPT, 0.02, 0.01, 0.05)], Level.DOUBTFUL),
    ],
)
def test_a_large_correction_that_was_taken_over_is_to_be_confirmed(
    later: list[tuple[EventKind, float, float, float]], level: Level
) -> None:
    assert level_of(system_that_answered((TAKEN, -0.2, 0.004, 0.03), *later)) is level


def test_a_small_correction_that_was_taken_over_is_no_reason() -> None:
    assert level_of(system_that_answered((TAKEN, -0.08, 0.004, 0.03))) is Level.GOOD


def test_the_text_says_what_the_images_show() -> None:
    found, _ = judge_camera(system_that_answered((KEPT, -0.2, 0.004, 0.03)))  # type: ignore[arg-type]
    assert found is not None
    assert "18 % shorter" in found[2]
    found, _ = judge_camera(system_that_answered((KEPT, 0.04, 0.007, 0.061)))  # type: ignore[arg-type]
    assert found is not None
    assert "another lens" in found[2]


def test_a_focal_length_that_is_hardly_known_makes_a_run_usable() -> None:
    system = system_that_answered()
    assert judge_camera(system)[0] is None  # type: ignore[arg-type]
    system.log_focal_sigma = 0.06  # type: ignore[assignment]
    found, _ = judge_camera(system)  # type: ignore[arg-type]
    assert found is not None
    assert found[:2] == (ReasonCode.FOCAL, Level.USABLE)


def scaled(camera: Camera, factor: float) -> PinholeCamera:
    """Return the intrinsics of images of another size, said to be of this one."""
    of = camera.scaled(factor)
    return PinholeCamera(camera.width, camera.height, of.fx, of.fy, of.cx, of.cy)


@pytest.mark.parametrize("factor", [0.5, 2.0 / 3.0, 1.25, 1.5])
def test_a_calibration_of_images_of_another_size_makes_a_run_doubtful(factor: float) -> None:
    system = system_that_answered()
    system.camera = scaled(PinholeCamera(640, 480, 517.0, 516.0, 318.6, 255.3), factor)
    found, _ = judge_camera(system)  # type: ignore[arg-type]
    assert found is not None
    assert (found[0], found[1]) == (ReasonCode.CAMERA, Level.DOUBTFUL)


@pytest.mark.parametrize(
    ("cx", "cy"),
    [(319.5, 239.5), (318.6, 255.3), (260.0, 239.5), (319.5, 120.0), (159.5, 239.5), (0.0, 239.5)],
)
def test_a_cropped_image_is_not_taken_for_one_of_another_size(cx: float, cy: float) -> None:
    system = system_that_answered()
    system.camera = PinholeCamera(640, 480, 517.0, 516.0, cx, cy)
    assert judge_camera(system)[0] is None  # type: ignore[arg-type]
