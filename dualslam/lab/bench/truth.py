"""A run against ground truth: posed frames, trajectory error, broken stretches, false joins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.core.config.corruption import CAMERA_KINDS, CLOCK_KINDS, INTERNAL_KINDS, Corruption, CorruptionKind
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.io.run_folder import FrameRow
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate
from dualslam.lab.audits.join_audit import MAX_FRAMES, JoinOutcome, audit_join
from dualslam.lab.audits.silent_breaks import MIN_SPREAD_M, MIN_STRETCH_POSES, STEP_S, STRETCH_S, judge_stretches
from dualslam.lab.bench.record import Breakage, Join, JoinCause, Reason
from dualslam.lab.metrics.trajectory_metrics import MIN_POSES

JUMP = 3.0
"""The truth jumps where its speed is this many times the median about it, and the estimate's is less than half of that:
a depth camera's tracking, or a motion capture system, has jumped, and the images show no such motion."""
_ABOUT = 7
"""Frames on either side whose median speed is the usual one."""
_HIDES = frozenset(CorruptionKind) - INTERNAL_KINDS - CAMERA_KINDS - CLOCK_KINDS - {CorruptionKind.FEW_FEATURES}


@dataclass(frozen=True, slots=True, eq=False)
class TrueFrames:
    """The frames of a clip and what is known of them.

    Attributes
    ----------
    index : (N,) int64
        Of the frames that arrive, in the source.
    times_s : (N,) float64
        True times, whatever the clock said.
    T_world_cam : (N, 4, 4) float64
        True pose of the image that is shown: a frozen camera shows an older one. NaN where there is no truth.
    clear : (N,) bool
        Whether no passing disturbance is on the image, so that the frame can be posed.
    disturbed : tuple of (int, int)
        First frame of each passing disturbance, and the first one after it.
    """

    index: IntArray
    times_s: FloatArray
    T_world_cam: FloatArray
    clear: BoolArray
    disturbed: tuple[tuple[int, int], ...] = ()

    @property
    def truth(self) -> Trajectory:
        """The true poses of the frames that have one, on the true clock."""
        known = np.isfinite(self.T_world_cam[:, 0, 3])
        return Trajectory(self.times_s[known], self.T_world_cam[known], self.index[known])

    def on_true_clock(self, main: Trajectory) -> Trajectory:
        """Return a map's poses, ascending, each at the true time of its frame."""
        order = np.argsort(main.index, kind="stable")
        index = main.index[order]
        return Trajectory(self.times_s[np.searchsorted(self.index, index)], main.T_world_cam[order], index)

    @property
    def is_still(self) -> bool:
        """Whether the camera never leaves its place: there is nothing that a map could be made of."""
        known = self.T_world_cam[np.isfinite(self.T_world_cam[:, 0, 3]), :3, 3]
        return len(known) > 0 and float(np.ptp(known, axis=0).max()) < MIN_SPREAD_M / 5


def true_frames(
    index: IntArray, times_s: FloatArray, truth: Trajectory, corruptions: Sequence[Corruption]
) -> TrueFrames:
    """Return what is known of the frames of a source, those left out that do not arrive.

    Parameters
    ----------
    index : (M,) int64
        Of all frames that the clip reads, ascending.
    times_s : (M,) float64
        Their times, undisturbed.
    truth : Trajectory
    corruptions : sequence of Corruption
    """
    row, near = associate(truth.timestamps_s, times_s, MAX_DT_S)
    T = np.where(near[:, None, None], truth.T_world_cam[row], np.nan)
    arrive = np.array([_arrives(i, corruptions) for i in index.tolist()], bool)
    index, times_s, T = index[arrive], times_s[arrive], T[arrive]
    hiding = [c for c in corruptions if c.kind in _HIDES and (c.length is not None or c.kind is CorruptionKind.FREEZE)]
    frozen = [c for c in corruptions if c.kind is CorruptionKind.FREEZE]
    shown, last = np.arange(len(index)), -1
    for n, i in enumerate(index.tolist()):
        if last >= 0 and any(c.covers(i) for c in frozen):
            shown[n] = last
        last = int(shown[n])
    clear = np.array([not any(c.covers(i) for c in hiding) for i in index.tolist()], bool)
    passing = [c for c in hiding if c.length is not None and c.kind is not CorruptionKind.STRIDE]
    spans = tuple((c.start, c.start + c.length) for c in passing if c.length is not None)
    return TrueFrames(index, times_s, T[shown], clear, spans)


def _arrives(index: int, corruptions: Iterable[Corruption]) -> bool:
    active = [c for c in corruptions if c.covers(index)]
    return not any(
        c.kind is CorruptionKind.DROP or (c.kind is CorruptionKind.STRIDE and (index - c.start) % round(c.level) != 0)
        for c in active
    )


def compare(
    frames: TrueFrames,
    main: Trajectory,
    submap: IntArray,
    initialised_at: int | None,
    breakages: Iterable[Breakage] = (),
    repeats_m: float | None = None,
    truth_breaks: Iterable[Sequence[int]] = (),
) -> dict[str, Any]:
    """Return the fields of a `TrialRecord` that the truth gives.

    Parameters
    ----------
    frames : TrueFrames
    main : Trajectory
        The main map, with the frames' indices.
    submap : (K,) int64
        The submap in which each of its frames is posed.
    initialised_at : int or None
        Position among the frames at which the first map began.
    breakages : iterable of Breakage
        Losses; each is asked about its join.
    repeats_m : float, optional
        Period of a world that repeats.
    truth_breaks : iterable of (int, int)
        First and last frames of the source where the truth is known to be wrong: what touches them is not held against
        the run.
    """
    order = np.argsort(main.index, kind="stable")
    posed = main.index[order]
    at = np.searchsorted(frames.index, posed)
    later = frames.index[initialised_at:] if initialised_at is not None else frames.index[:0]
    clear = later[frames.clear[len(frames.index) - len(later) :]]
    fields: dict[str, Any] = {
        "n_clear": len(clear),
        "n_clear_posed": int(np.isin(clear, posed).sum()),
        "is_still": frames.is_still,
    }
    known = np.isfinite(frames.T_world_cam[at, 0, 3])
    index, times_s, T_true = posed[known], frames.times_s[at][known], frames.T_world_cam[at][known]
    T_est = main.T_world_cam[order][known]
    if len(index) < MIN_POSES or frames.is_still:
        return fields
    untrue = are_untrue(index, truth_breaks)
    p, q = T_est[:, :3, 3], T_true[:, :3, 3]
    fields |= _stretches(times_s - frames.times_s[0], p, q, frames.times_s, untrue)
    tolerance_m = None if repeats_m is None else repeats_m / 2.0
    fields["joins"] = tuple(
        Join(first, str(found.outcome), found.offset_m, found.scale_ratio, found.turn_deg, cause)
        for first, after, cause in _places(frames, index, submap[order][known], breakages)
        for found in [audit_join(index, T_est, T_true, first, after, tolerance_m)]
        if cause is not JoinCause.SEAM or found.outcome is not JoinOutcome.NOT_JOINED
        if found.outcome is not JoinOutcome.WRONG or not _touches(index, untrue, first, after)
    )
    return fields


def are_untrue(index: IntArray, truth_breaks: Iterable[Sequence[int]]) -> BoolArray:
    """Return which frames (N,) have a true pose that is known to be wrong; `truth_breaks`: their first and last."""
    untrue = np.zeros(len(index), bool)
    for first, last in truth_breaks:
        untrue |= (first <= index) & (index <= last)
    return untrue


def _touches(index: IntArray, untrue: BoolArray, first: int, after: int) -> bool:
    """Return whether any frame that a join is judged by has a true pose that is known to be wrong."""
    before, later = untrue[index < first][-MAX_FRAMES:], untrue[index >= after][:MAX_FRAMES]
    return bool(before.any() or later.any())


def _places(
    frames: TrueFrames, index: IntArray, submap: IntArray, breakages: Iterable[Breakage]
) -> list[tuple[int, int, JoinCause]]:
    """Return the places to audit: first frame, first frame after it, and why."""
    found = [(first, after, JoinCause.DISTURBANCE) for first, after in frames.disturbed]
    found += [(b.frame, b.frame + (b.restart_frames or 1), JoinCause.LOSS) for b in breakages]
    for n in (np.flatnonzero(np.diff(submap)) + 1).tolist():
        first = int(index[n])
        if not any(a <= first <= b for a, b, _ in found):
            found.append((first, first, JoinCause.SEAM))
    return found


def _stretches(
    at_s: FloatArray, p: FloatArray, q: FloatArray, frame_times_s: FloatArray, untrue: BoolArray
) -> dict[str, Any]:
    dt_s = float(np.median(np.diff(frame_times_s)))
    stretches = judge_stretches(at_s, p, q, dt_s)
    if stretches is None:
        return {"judged": 0}
    length, step = max(MIN_STRETCH_POSES, round(STRETCH_S / dt_s)), max(1, round(STEP_S / dt_s))
    jumps = np.append(_truth_jumps(at_s, p, q), False)
    firsts = [k * step for k in range(len(stretches.first_s))]
    excepted = np.array([jumps[k : k + length - 1].any() or untrue[k : k + length].any() for k in firsts], bool)
    broken = stretches.broken & ~excepted
    return {
        "judged": int(stretches.judged.sum()),
        "broken": int(broken.sum()),
        "excepted": int((stretches.broken & excepted).sum()),
        "first_broken_s": float(stretches.first_s[np.argmax(broken)]) if broken.any() else None,
    }


def _truth_jumps(at_s: FloatArray, p: FloatArray, q: FloatArray) -> BoolArray:
    """(N-1,) whether the truth jumps between a pose and the next one while the estimate does not."""
    dt_s = np.maximum(np.diff(at_s), 1e-9)
    true, own = (_over_usual(np.linalg.norm(np.diff(x, axis=0), axis=1) / dt_s) for x in (q, p))
    return np.asarray((true > JUMP) & (own < true / 2.0))


def _over_usual(speed: FloatArray) -> FloatArray:
    padded = np.pad(speed, _ABOUT, mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _ABOUT + 1), axis=1)
    return np.asarray(speed / np.maximum(usual, 1e-12))


def submaps_of(rows: Iterable[FrameRow], index: IntArray) -> IntArray:
    """Return the submap of each frame (K,)."""
    by_index = {row.index: row.submap for row in rows}
    return np.array([by_index[i] if by_index.get(i) is not None else -1 for i in index.tolist()], np.int64)


def read_verdict(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return level, reasons and scores that a run's summary claims; nothing of a run that gives no verdict."""
    verdict = summary.get("verdict")
    if verdict is None:
        return {}
    reasons = tuple(Reason(str(r["code"]), r.get("first_frame"), r.get("last_frame")) for r in verdict["reasons"])
    return {"level": str(verdict["level"]), "reasons": reasons, "scores": verdict.get("scores", {})}
