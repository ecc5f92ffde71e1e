"""How good a trajectory is: first how much of the sequence it covers, then how far it is from the truth.

An error is never given without its coverage: a run that gives up early can have a small one.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray, IntArray
from dualslam.io.run_folder import FRAMES, SUMMARY, TRAJECTORY, unlinked_submaps
from dualslam.io.run_reading import read_frames, read_summary
from dualslam.io.trajectory_files import MAX_BEGIN_GAP_S, MAX_DT_S, Trajectory, associate, nearest_in_time, read_tum
from dualslam.lab.audits.silent_breaks import find_silent_breaks
from dualslam.lab.metrics.alignment import align_points

log = logging.getLogger(__name__)

Alignment = Literal["sim3", "se3"]

MIN_POSES = 10
"""Fewer poses with ground truth than this are counted, but not scored."""
SAME_FRAME_S = 1e-3
"""Between two readings of one frame's time: clocks are written to a millisecond at least."""
MIN_SAME = 0.5
"""Share of a run's frames that have a time in its sequence: all, but for frames whose clock was disturbed."""
RPE_INTERVAL_S = 1.0
# Pairs in which the true camera moved less than this share of the median motion have no meaningful error in percent.
_MIN_MOTION = 0.05


class EvaluationSequence(Protocol):
    """Interface of a sequence: its name, the times of its frames, and the true poses."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def frame_timestamps(self) -> FloatArray:
        """(N,) seconds, in either order."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses, on the same clock."""
        ...


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    """Completeness and error of one trajectory. Errors are None where too few poses have ground truth.

    Attributes
    ----------
    frames, posed : int
        Frames of the sequence, and those that have a pose.
    off_clock : int
        Poses that belong to no frame of the sequence.
    coverage_pct : float
    compared : int
        Poses with ground truth near in time.
    ate_rmse_m, ate_max_m : float or None
        Absolute trajectory error after one alignment over all compared poses.
    ate_pct_of_path : float or None
        The same (RMSE), of the length of the true path.
    path_m, spread_m : float or None
        Length of the true path over the compared poses. RMS distance of the true positions from their mean: the error
        of a camera that never moved.
    scale : float or None
        Scale that the alignment found, estimate to truth (1 for SE(3)).
    scale_drift : float or None
        Scale of the last third over that of the first.
    rpe_1s_rot_deg_median, rpe_1s_trans_pct_median : float or None
        Relative pose error over 1 s; translation of the distance moved.
    judged, broken, broken_pct, first_broken_s
        As in `dualslam.lab.audits.silent_breaks.SilentBreaks`.
    """

    frames: int
    posed: int
    off_clock: int
    coverage_pct: float
    compared: int
    ate_rmse_m: float | None = None
    ate_max_m: float | None = None
    ate_pct_of_path: float | None = None
    path_m: float | None = None
    spread_m: float | None = None
    scale: float | None = None
    scale_drift: float | None = None
    rpe_1s_rot_deg_median: float | None = None
    rpe_1s_trans_pct_median: float | None = None
    judged: int | None = None
    broken: int | None = None
    broken_pct: float | None = None
    first_broken_s: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the fields that are known."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def score_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    frame_times_s: FloatArray,
    *,
    alignment: Alignment = "sim3",
    max_dt_s: float = MAX_DT_S,
) -> TrajectoryScore:
    """Score an estimated trajectory against the truth.

    Parameters
    ----------
    estimate, truth : Trajectory
        Camera to world, ascending in time; the two worlds are aligned here.
    frame_times_s : (N,) float64
        Times of all frames of the sequence, N >= 2, in any order: what coverage is measured against.
    alignment : {"sim3", "se3"}
        Whether the alignment may scale; a monocular trajectory has no scale of its own.
    max_dt_s : float

    Raises
    ------
    InputError
        If the frames are on another clock than the truth, are fewer than two, or have no times of their own.
    """
    times = np.sort(np.asarray(frame_times_s, float))
    if len(times) < 2 or len(truth) == 0:
        raise InputError("A trajectory is scored against two frames or more, and at least one true pose.")
    if abs(truth.timestamps_s[0] - times[0]) > MAX_BEGIN_GAP_S:
        raise InputError("The frames and the ground truth are on different clocks; give both in the same seconds.")
    frame_dt_s = float(np.median(np.diff(times)))
    if not frame_dt_s > 0:
        raise InputError("Half of the frames or more have the time of the one before; give each frame its own.")
    frame, on_frame = associate(times, estimate.timestamps_s, 0.5 * frame_dt_s)
    posed = len(np.unique(frame[on_frame]))
    row, near = associate(truth.timestamps_s, estimate.timestamps_s, max_dt_s)
    used = on_frame & near
    counts: dict[str, Any] = {
        "frames": len(times),
        "posed": posed,
        "off_clock": int((~on_frame).sum()),
        "coverage_pct": 100.0 * posed / len(times),
        "compared": int(used.sum()),
    }
    if used.sum() < MIN_POSES:
        return TrajectoryScore(**counts)
    est = Trajectory(estimate.timestamps_s[used], estimate.T_world_cam[used])
    ref = Trajectory(truth.timestamps_s[row[used]], truth.T_world_cam[row[used]])
    scale, absolute = absolute_error(est, ref, alignment)
    relative = relative_error(est, ref, scale, frame_dt_s)
    breaks = find_silent_breaks(est.timestamps_s - times[0], _positions(est), _positions(ref), frame_dt_s)
    found = {} if breaks is None else asdict(breaks)
    return TrajectoryScore(**counts, **absolute, scale_drift=scale_drift(est, ref), **relative, **found)


def absolute_error(est: Trajectory, ref: Trajectory, alignment: Alignment) -> tuple[float, dict[str, Any]]:
    """Return the alignment's scale and the fields of the absolute error, of paired trajectories."""
    p, q = _positions(est), _positions(ref)
    scale, R, t = align_points(p, q, with_scale=alignment == "sim3")
    error = np.linalg.norm(q - (scale * p @ R.T + t), axis=1)
    rmse = float(np.sqrt((error**2).mean()))
    path = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    return scale, {
        "ate_rmse_m": rmse,
        "ate_max_m": float(error.max()),
        "ate_pct_of_path": 100 * rmse / max(path, 1e-9),
        "path_m": path,
        "spread_m": float(np.sqrt(((q - q.mean(axis=0)) ** 2).sum(axis=1).mean())),
        "scale": scale,
    }


def scale_drift(est: Trajectory, ref: Trajectory) -> float | None:
    """Return the scale of the last third of paired trajectories over that of the first (1: no drift)."""
    p, q = _positions(est), _positions(ref)
    third = len(p) // 3
    if third < MIN_POSES:
        return None
    first, last = align_points(p[:third], q[:third])[0], align_points(p[-third:], q[-third:])[0]
    return last / first if first > 0 else None


def relative_error(
    est: Trajectory, ref: Trajectory, scale: float, frame_dt_s: float, interval_s: float = RPE_INTERVAL_S
) -> dict[str, Any]:
    """Return the fields of the relative pose error of paired trajectories over `interval_s`, where it can be had."""
    times = est.timestamps_s
    later = nearest_in_time(times, times + interval_s)
    i = np.flatnonzero(np.abs(times[later] - times - interval_s) <= frame_dt_s)
    j = later[i]
    if len(i) == 0:
        return {}
    (R_est, t_est), (R_ref, t_ref) = (_relative(each.T_world_cam, i, j) for each in (est, ref))
    trace = np.einsum("nij,nij->n", R_ref, R_est)
    angle_deg = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    fields: dict[str, Any] = {"rpe_1s_rot_deg_median": float(np.median(angle_deg))}
    moved = np.linalg.norm(t_ref, axis=1)
    typical = np.median(moved)
    enough = (moved > _MIN_MOTION * typical) & (typical > 0)
    if enough.any():
        off = np.linalg.norm(scale * t_est - t_ref, axis=1)
        fields["rpe_1s_trans_pct_median"] = float(np.median(100 * off[enough] / moved[enough]))
    return fields


def end_to_start(trajectory: Trajectory) -> dict[str, float]:
    """Return how far the last pose is from the first, for a camera that came back: an error that needs no truth.

    Returns
    -------
    dict
        ``end_to_start_pct``: of the length of the way; ``end_to_start_deg``: between the two directions.

    Raises
    ------
    InputError
        If the camera has hardly a way.
    """
    ordered = trajectory.in_time_order()
    xyz = _positions(ordered)
    length = float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()) if len(xyz) > 1 else 0.0
    if not length > 0:
        raise InputError("there is no way from which to come back: fewer than two frames have a pose.")
    R = ordered.T_world_cam[0, :3, :3].T @ ordered.T_world_cam[-1, :3, :3]
    turn = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    return {
        "end_to_start_pct": 100 * float(np.linalg.norm(xyz[-1] - xyz[0])) / length,
        "end_to_start_deg": float(turn),
    }


def evaluate_run(
    run: str | Path,
    sequence: EvaluationSequence,
    *,
    alignment: Alignment = "sim3",
    max_dt_s: float = MAX_DT_S,
    keyframe_times_s: FloatArray | None = None,
) -> dict[str, Any]:
    """Score a run folder: the main map's trajectory, and each unlinked submap with an alignment of its own.

    With `keyframe_times_s` the main map's poses at these times are scored by themselves, too, as published tables do.

    Returns
    -------
    dict
        The fields of `TrajectoryScore` of the main map, and ``submaps``: a list of the same with ``submap``, its id;
        ``keyframes``: the same of keyframes alone, where these are given.

    Raises
    ------
    InputError
        If the run has no trajectory, was made of another sequence, or has no pose at the time of any frame. If the
        sequence has no ground truth. If a trajectory given by itself is empty, or either is something else.
    """
    if not isinstance(run, str | Path):
        raise InputError(f"the run is a {type(run).__name__}; give the path of its folder or of its trajectory.")
    if not hasattr(sequence, "ground_truth"):
        raise InputError(f"the sequence is a {type(sequence).__name__}; open_source opens one.")
    truth = sequence.ground_truth
    if truth is None:
        raise InputError(f"{sequence.name} has no ground truth; a run is evaluated against one.")
    _refuse_other_sequence(Path(run), sequence)
    is_run = Path(run).is_dir()
    path = Path(run) / TRAJECTORY if is_run else Path(run)

    def scored(file: Path) -> dict[str, Any]:
        estimate = read_tum(file, allow_empty=is_run)  # a run that could not pose a frame has a coverage all the same
        return score_trajectory(
            estimate, truth, sequence.frame_timestamps, alignment=alignment, max_dt_s=max_dt_s
        ).as_dict()

    score = {
        **scored(path),
        "submaps": [{"submap": m, **scored(file)} for m, file in unlinked_submaps(path.parent).items()],
    }
    if keyframe_times_s is not None:
        whole = read_tum(path, allow_empty=is_run)
        _, chosen = associate(keyframe_times_s, whole.timestamps_s, SAME_FRAME_S)
        kept = Trajectory(whole.timestamps_s[chosen], whole.T_world_cam[chosen])
        score["keyframes"] = score_trajectory(
            kept, truth, sequence.frame_timestamps, alignment=alignment, max_dt_s=max_dt_s
        ).as_dict()
    parts = [score, *score["submaps"]]
    if any(part["off_clock"] for part in parts) and not any(part["posed"] for part in parts):
        raise InputError(f"{run}: no pose is at the time of any frame of {sequence.name}; is it of another sequence?")
    return score


def _refuse_other_sequence(run: Path, sequence: EvaluationSequence) -> None:
    """Refuse a sequence whose frames have other times than the run's; warn where it has another name alone."""
    if not (run / SUMMARY).is_file():
        return
    made_of = read_summary(run).get("sequence", sequence.name)
    rows = read_frames(run / FRAMES) if (run / FRAMES).is_file() else []
    own = np.array([row.timestamp_s for row in rows])
    _, known = associate(np.sort(sequence.frame_timestamps), own, SAME_FRAME_S)
    if rows and known.mean() < MIN_SAME:
        raise InputError(
            f"{run} was made of {made_of}, or of other frames of it: {sequence.name} has frames at other times; "
            f"to score it all the same, give {run / TRAJECTORY}."
        )
    if made_of != sequence.name:
        log.warning("%s was made of %s, and is scored against %s", run, made_of, sequence.name)


def _positions(trajectory: Trajectory) -> FloatArray:
    return trajectory.T_world_cam[:, :3, 3]


def _relative(T_world_cam: FloatArray, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return ``R_i_j`` (N, 3, 3) and ``t_i_j`` (N, 3): exactly zero where nothing moves, which `inv(T) @ T` is not."""
    R_i = T_world_cam[i, :3, :3].transpose(0, 2, 1)
    t_i_j = np.einsum("nij,nj->ni", R_i, T_world_cam[j, :3, 3] - T_world_cam[i, :3, 3])
    return R_i @ T_world_cam[j, :3, :3], t_i_j
