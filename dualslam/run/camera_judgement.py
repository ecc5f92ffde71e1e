"""The verdict on the camera of a finished run: what its images say against the calibration that was given."""

from __future__ import annotations

import numpy as np

from dualslam.core.camera.calibrated_size import find_calibrated_size
from dualslam.core.camera.mapped import own_camera
from dualslam.core.estimates import MAX_PATH_CHANGE, MAX_PRIOR_SIGMAS
from dualslam.core.events import Event, EventKind
from dualslam.system.audit.verdict import Level, ReasonCode
from dualslam.system.system import System

MAX_FOCAL_SIGMA = 0.03
"""Standard deviation of the logarithm of the focal length."""
MIN_FOCAL_CHANGE, MAX_FOCAL_SIGMAS = 0.1, 4.0
"""Of the logarithm of the focal length against the one that the map was made with until then: two sigmas of what a
data sheet is off, and known to be more. Its own sigma is that of one submap: of 44 answers on 7-Scenes 1 % are 3.7
sigmas from their median.
"""
_FOCAL, _FOCAL_SIGMA, _PATH_CHANGE = "log_focal", "log_focal_sigma", "path_change"


def judge_camera(system: System) -> tuple[tuple[ReasonCode, Level, str] | None, dict[str, float]]:
    """Return the reason that the camera is against a run, if it is one, with its text; and scores by the codes.

    A wrong camera that was corrected in time, or changes the path little, is no reason.
    """
    answers, sigma = _answers(system), system.log_focal_sigma
    scores = {str(ReasonCode.CAMERA): event.data[_PATH_CHANGE] for event in answers[-1:]}
    scores |= {} if sigma is None else {str(ReasonCode.FOCAL): sigma}
    given = own_camera(system.camera)
    if (size := find_calibrated_size(given)) is not None:
        text = (
            f"By its principal point the calibration is for images of {size[0]} x {size[1]} pixels. These have "
            f"{given.width} x {given.height}. Scale the calibration to them."
        )
        return (ReasonCode.CAMERA, Level.DOUBTFUL, text), scores
    if (found := _by_answers(answers)) is not None:
        return (ReasonCode.CAMERA, *found), scores
    if sigma is None or sigma < MAX_FOCAL_SIGMA:
        return None, scores
    text = (
        f"The focal length is known to {100 * sigma:.1f} % only. "
        "Give a calibration with --camera, or record more sideways motion."
    )
    return (ReasonCode.FOCAL, Level.USABLE, text), scores


def _answers(system: System) -> list[Event]:
    """Return what maps have said of the camera that is sure, or beyond chance."""
    told = system.events.of_kind(EventKind.CALIBRATED, EventKind.CALIBRATION_KEPT)
    return [
        e for e in told if _FOCAL in e.data and (e.data[_FOCAL_SIGMA] < MAX_FOCAL_SIGMA or e.data[_PATH_CHANGE] > 0)
    ]


def _by_answers(answers: list[Event]) -> tuple[Level, str] | None:
    """Judge the last answer, by the camera in use until then."""
    if not answers:
        return None
    in_use = [e.data[_FOCAL] for e in answers[:-1] if e.event is EventKind.CALIBRATED]
    last, data = answers[-1], answers[-1].data
    log_focal, path_change = data[_FOCAL], data[_PATH_CHANGE]
    change = log_focal - (in_use[-1] if in_use else 0.0)
    is_far = abs(change) > MIN_FOCAL_CHANGE + MAX_FOCAL_SIGMAS * data[_FOCAL_SIGMA]
    shown = "another lens than the calibration says: its distortion or its centre"
    if is_far:
        longer = "longer" if log_focal > 0 else "shorter"
        shown = f"a focal length {100 * abs(np.expm1(log_focal)):.0f} % {longer} than the calibration says"
    check = "Check that the calibration is of this camera, lens and image size."
    if last.event is EventKind.CALIBRATED:
        if not is_far and data["prior_sigmas"] <= MAX_PRIOR_SIGMAS:
            return None
        again = "The map was made with that. Run again with --camera and this run's camera.yaml, or check"
        return Level.USABLE, f"The images show {shown}. {again} the calibration."
    if path_change**2 < MAX_PATH_CHANGE**2 / 2.0:
        return None
    is_wrong = path_change > MAX_PATH_CHANGE or data["prior_sigmas"] > MAX_PRIOR_SIGMAS
    level = Level.DOUBTFUL if is_wrong else Level.USABLE
    return level, f"The images show {shown}. With it the path would change by {100 * path_change:.1f} %. {check}"
