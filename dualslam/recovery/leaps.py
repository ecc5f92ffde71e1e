"""Whether a camera can have moved as a leap over missing frames says: by its velocity before and after, without pixels.

On either side the velocity is known, in the map itself. Between them the camera has moved by about their mean times the
time that has passed; by how much it may differ from that, the run itself tells: the same question is asked wherever
nothing is missing and each frame's pose follows from those before it. So no unit is needed, and a hand is judged as a
hand, a car as a car.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray
from dualslam.map.record import FrameStamp, Record
from dualslam.map.submap import Submap

WINDOW_S = 0.3
"""In which a velocity is measured, on either side; or `WINDOW_FRAMES`, where these take longer."""
WINDOW_FRAMES = 4
MAX_LEAP_S = 2.0
"""Beyond, what the velocities allow is no less than what a wrong pose would need."""
MISSING = 2.5
"""Times the usual interval after which frames are missing."""
ALLOWED = 3.0
"""Times the usual difference: a run of seconds has not shown all that its camera does."""
USUAL = 0.95
"""Quantile, over the places before the leap where nothing is missing."""
MIN_ASKED = 12
"""Places at which the same question could be asked."""
HISTORY_S = 10.0


@dataclass(frozen=True, slots=True)
class Leap:
    """A leap over missing frames: how far the camera came from where its velocities lead, and what is usual.

    Attributes
    ----------
    off_mu, usual_mu : float
        In the unit of the map.
    n_asked : int
        Places at which nothing was missing.
    """

    off_mu: float
    usual_mu: float
    n_asked: int

    @property
    def is_refused(self) -> bool:
        """Whether the camera cannot have moved so, as far as the run can tell."""
        return self.n_asked >= MIN_ASKED and self.off_mu > ALLOWED * self.usual_mu

    @property
    def numbers(self) -> dict[str, float]:
        """For the event log."""
        return {"leap_off": self.off_mu, "leap_usual": self.usual_mu, "leap_asked": float(self.n_asked)}


@dataclass(frozen=True, slots=True)
class Break:
    """Where a map has leapt: its first posed frame beyond, and why the camera cannot have moved so."""

    first: int
    failure: Failure


def measure_leap(
    times_s: FloatArray, centres: FloatArray, last_before: int, refound: BoolArray | None = None
) -> Leap | None:
    """Compare a leap with the same stretch of time where nothing is missing.

    Parameters
    ----------
    times_s : (N,)
        Of posed frames, ascending.
    centres : (N, 3)
        Of the camera, in one map.
    last_before : int
        Row of the last frame before the gap.
    refound : (N,) bool or None
        Frames that were found by wide matching, and not by those before them.

    Returns
    -------
    Leap or None
        None where one side is too short, or so long a leap says nothing.
    """
    if len(times_s) < 2 * WINDOW_FRAMES:
        return None
    leap_s, usual_s = float(times_s[last_before + 1] - times_s[last_before]), float(np.median(np.diff(times_s)))
    if not MISSING * usual_s < leap_s:
        return None
    before = slice(last_before + 1)  # beyond the leap the map may be wrong
    refound = None if refound is None else refound[before]
    return leap_by_other(times_s, centres, last_before, times_s[before], centres[before], refound)


def usual_difference(
    times_s: FloatArray, centres: FloatArray, leap_s: float, refound: BoolArray | None = None
) -> tuple[float, int]:
    """Return the usual distance between where velocities lead in a time and where the camera was, and of how many.

    What a frame that was found again has jumped by is none of the camera's: a stretch with one in it is not asked.

    Parameters
    ----------
    times_s : (N,)
        Of posed frames, ascending.
    centres : (N, 3)
    leap_s : float
    refound : (N,) bool or None
        As for `measure_leap`.
    """
    if len(times_s) < 2 * WINDOW_FRAMES:
        return 0.0, 0
    usual_s = float(np.median(np.diff(times_s)))
    window_s = max(WINDOW_S, WINDOW_FRAMES * usual_s)
    reach_s = window_s + 0.5 * usual_s
    times_refound = times_s[:0] if refound is None else times_s[refound]
    asked = []
    for i in range(len(times_s)):
        j = int(np.searchsorted(times_s, times_s[i] + leap_s - 0.5 * usual_s))
        if j == len(times_s):
            break
        if not ((times_refound > times_s[i] - reach_s) & (times_refound < times_s[j] + reach_s)).any():
            asked.append(_off(times_s, centres, i, j, window_s, usual_s))
    known = [value for value in asked if value is not None]
    return (float(np.quantile(known, USUAL)) if known else 0.0), len(known)


def refuse_leaps(
    times_s: FloatArray,
    centres: FloatArray,
    times_known_s: FloatArray,
    centres_known: FloatArray,
    refound_known: BoolArray | None = None,
) -> Failure | None:
    """Return why a walk's leaps are not to be believed, by what another map of the same run shows of its camera.

    Parameters
    ----------
    times_s : (N,), centres : (N, 3)
        Of the frames of the walk and those that it set out from, by ascending time.
    times_known_s : (M,), centres_known : (M, 3)
        Of the other map's, in the unit of the walk's.
    refound_known : (M,) bool or None
        Of these, the frames that were found by wide matching.
    """
    if len(times_s) < 2 * WINDOW_FRAMES:
        return None
    for i in gaps_of(times_s).tolist():
        leap = leap_by_other(times_s, centres, i, times_known_s, centres_known, refound_known)
        if leap is not None and leap.is_refused:
            return leap_refusal(leap)
    return None


def gaps_of(times_s: FloatArray) -> IntArray:
    """Return the last rows before frames are missing."""
    apart_s = np.diff(times_s)
    return np.flatnonzero(apart_s > MISSING * np.median(apart_s)) if len(apart_s) else np.zeros(0, np.int64)


def leap_by_other(
    times_s: FloatArray,
    centres: FloatArray,
    last_before: int,
    times_known_s: FloatArray,
    centres_known: FloatArray,
    refound_known: BoolArray | None = None,
) -> Leap | None:
    """Measure a leap as `measure_leap` does, by what another map shows of the camera (`refuse_leaps`)."""
    leap_s, usual_s = float(times_s[last_before + 1] - times_s[last_before]), float(np.median(np.diff(times_s)))
    if leap_s > MAX_LEAP_S:
        return None
    window_s = max(WINDOW_S, WINDOW_FRAMES * usual_s)
    off = _off(times_s, centres, last_before, last_before + 1, window_s, usual_s)
    return None if off is None else Leap(off, *usual_difference(times_known_s, centres_known, leap_s, refound_known))


def leap_refusal(leap: Leap) -> Failure:
    """Return why a leap is not to be believed."""
    times = leap.off_mu / max(leap.usual_mu, 1e-12)
    detail = f"a leap {times:.0f} times further off than velocities lead elsewhere"
    return Failure(FailureReason.LEAP, detail, leap.numbers)


def _off(times_s: FloatArray, centres: FloatArray, i: int, j: int, window_s: float, usual_s: float) -> float | None:
    """Return how far frame j is from where the velocities up to frame i and from j on lead; None without velocities."""
    before = np.flatnonzero((times_s <= times_s[i]) & (times_s > times_s[i] - window_s - 0.5 * usual_s))
    after = np.flatnonzero((times_s >= times_s[j]) & (times_s < times_s[j] + window_s + 0.5 * usual_s))
    if len(before) < WINDOW_FRAMES or len(after) < WINDOW_FRAMES or _has_gap(times_s, before, usual_s):
        return None
    if _has_gap(times_s, after, usual_s):
        return None
    v_before, p_before = _line(times_s[before] - times_s[i], centres[before])
    v_after, p_after = _line(times_s[after] - times_s[j], centres[after])
    expected = 0.5 * (v_before + v_after) * (times_s[j] - times_s[i])
    return float(np.linalg.norm(p_after - p_before - expected))


def _line(t_s: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return velocity (3,) and place (3,) at time zero of the straight line through some places."""
    slope, place = np.linalg.lstsq(np.column_stack([t_s, np.ones(len(t_s))]), centres, rcond=None)[0]
    return slope, place


def _has_gap(times_s: FloatArray, rows: IntArray, usual_s: float) -> bool:
    return bool((np.diff(times_s[rows]) > MISSING * usual_s).any())


class LeapWatch:
    """Asks, a moment after tracking has found its place again beyond a gap, whether the camera can have moved so."""

    def __init__(self) -> None:
        self._first_beyond: FrameStamp | None = None  # the gap that is looked at

    def begin(self, at: FrameStamp) -> None:
        """Look at the gap before a frame that was posed after a loss."""
        self._first_beyond = at

    def end(self) -> None:
        """Forget the gap."""
        self._first_beyond = None

    def judge(self, at: FrameStamp, wide: bool, record: Record, submap: Submap) -> Break | None:
        """Note a posed frame, and return where the map has leapt as no camera moves, once that can be told.

        Parameters
        ----------
        at : FrameStamp
        wide : bool
            Whether it was found beyond a gap.
        record : Record
        submap : Submap
            In which it was posed.
        """
        if wide and self._first_beyond is None:
            self._first_beyond = at
        first = self._first_beyond
        if first is None:
            return None
        poses = [
            pose
            for pose in record.own_poses()
            if pose.submap_id == submap.id and abs(pose.timestamp_s - at.timestamp_s) <= HISTORY_S
        ]
        poses.sort(key=lambda pose: pose.index)
        place = next((n for n, pose in enumerate(poses) if pose.index >= first.index), len(poses))
        times = np.array([pose.timestamp_s for pose in poses])
        if place == 0:
            self.end()  # nothing of the moment before: too long ago, or in another run
        if place == 0 or place >= len(poses):
            return None
        usual_s = float(np.median(np.diff(times)))
        if abs(at.timestamp_s - first.timestamp_s) < max(WINDOW_S, WINDOW_FRAMES * abs(usual_s)):
            return None
        self.end()
        centres = np.array([submap.resolve_anchor(p.keyframe_id, p.T_kf_cam)[:3, 3] for p in poses])
        times *= np.sign(usual_s or 1.0)
        # Reverse tracking may have posed frames before the first one: the leap is before these.
        missing = np.flatnonzero(np.diff(times[: place + 1]) > MISSING * abs(usual_s))
        if not len(missing):
            return None
        last_before = int(missing[-1])
        refound = record.are_refound(pose.index for pose in poses)
        leap = measure_leap(times, centres, last_before, refound)
        if leap is None or not leap.is_refused:
            return None
        return Break(poses[last_before + 1].index, leap_refusal(leap))
