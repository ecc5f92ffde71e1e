"""Clips about a loss, for any system: written as folders, scored by the trajectory that a system gives."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import PinholeCamera, RadTanCamera
from dualslam.core.errors import InputError, OutputError
from dualslam.core.interfaces import Sequence
from dualslam.io.atomic import write_text
from dualslam.io.trajectory_files import Trajectory, associate, read_tum, write_tum
from dualslam.lab.audits.join_audit import JoinAudit, audit_join
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.truth import TrueFrames, true_frames
from dualslam.lab.disturbances import Corruption, corrupted

CLIP, TRUTH, TIMES, CAMERA = "clip.json", "groundtruth_tum.txt", "times.txt", "calib.txt"


class _Recorded(Sequence, Protocol):
    source_indices: np.ndarray
    frame_timestamps: np.ndarray
    ground_truth: Trajectory | None


@dataclass(frozen=True, slots=True)
class ClipLoss:
    """Where a clip is disturbed, and what counts as joined falsely.

    Attributes
    ----------
    first_s, after_s : float
        Time of the first disturbed frame, and of the first one after it.
    tolerance_m : float or None
        Largest offset of a right join; None: as `audit_join`.
    """

    first_s: float
    after_s: float
    tolerance_m: float | None


def write_clip(trial: Trial, sequence: _Recorded, out: Path) -> ClipLoss:
    """Write the disturbed clip of a trial: images, times, calibration, truth, and where the loss is.

    Parameters
    ----------
    trial : Trial
    sequence : Sequence
        The trial's frames, undisturbed, with ground truth.
    out : Path

    Raises
    ------
    InputError
        Where the trial has no passing disturbance, the sequence no truth, or its camera a model with no such file.
    OutputError
    """
    corruptions = [Corruption.model_validate(c) for c in trial.config["corruptions"]]
    if sequence.ground_truth is None:
        raise InputError(f"{sequence.name} has no ground truth; a clip is scored against one.")
    frames = true_frames(sequence.source_indices, sequence.frame_timestamps, sequence.ground_truth, corruptions)
    if not frames.disturbed:
        raise InputError(f"{trial.key} has no passing disturbance; there is nothing to join.")
    disturbed = corrupted(sequence, corruptions)
    (out / "images").mkdir(parents=True, exist_ok=True)
    for frame in disturbed:
        path = out / "images" / f"{frame.index:06d}.png"
        if frame.image is None or not cv2.imwrite(str(path), frame.image):
            raise OutputError(f"{path} cannot be written.")
    write_text(out / TIMES, "".join(f"{t:.9f}\n" for t in frames.times_s.tolist()))
    write_text(out / CAMERA, _camera_line(disturbed.camera))
    write_tum(out / TRUTH, frames.truth)
    loss = _loss(frames, None if trial.repeats_m is None else trial.repeats_m / 2.0)
    write_text(out / CLIP, json.dumps({"trial": trial.key, **_as_dict(loss)}, indent=2) + "\n")
    return loss


def score_clip(clip: Path, trajectory: Path) -> JoinAudit:
    """Judge how a system has joined the parts of a clip before and after its disturbance.

    Parameters
    ----------
    clip : Path
        A folder that `write_clip` has written.
    trajectory : Path
        TUM file of the system's largest map, camera to world, one line a posed frame.

    Raises
    ------
    InputError
        Where one of them cannot be read.
    """
    if not (clip / CLIP).is_file():
        raise InputError(f"{clip} has no {CLIP}; name a folder that the export has written.")
    said = json.loads((clip / CLIP).read_text(encoding="utf-8"))
    truth = read_tum(clip / TRUTH)
    estimate = read_tum(trajectory, allow_empty=True)
    if not len(estimate):
        return audit_join(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), 0, 0)
    row, near = associate(
        truth.timestamps_s, estimate.timestamps_s, 0.5 * float(np.median(np.diff(truth.timestamps_s)))
    )
    row, T_est = row[near], estimate.T_world_cam[near]
    first, after = np.searchsorted(truth.timestamps_s, [said["first_s"] - 1e-6, said["after_s"] - 1e-6]).tolist()
    return audit_join(row, T_est, truth.T_world_cam[row], first, after, said["tolerance_m"])


def _loss(frames: TrueFrames, tolerance_m: float | None) -> ClipLoss:
    first, after = frames.disturbed[0]
    at = np.searchsorted(frames.index, [first, after])
    first_s, after_s = frames.times_s[np.minimum(at, len(frames.index) - 1)].tolist()
    return ClipLoss(first_s, after_s, tolerance_m)


def _as_dict(loss: ClipLoss) -> dict[str, float | None]:
    return {"first_s": loss.first_s, "after_s": loss.after_s, "tolerance_m": loss.tolerance_m}


def _camera_line(camera: Camera) -> str:
    """Return ``fx fy cx cy [k1 k2 p1 p2 k3] width height``."""
    if not isinstance(camera, PinholeCamera | RadTanCamera):
        raise InputError(f"a camera of model {camera.model} has no line in calib.txt; use another sequence.")
    lens = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3) if isinstance(camera, RadTanCamera) else ()
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *lens, camera.width, camera.height)
    return " ".join(f"{n:.10g}" for n in numbers) + "\n"
