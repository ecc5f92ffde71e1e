"""Motion test: whether a camera can have moved across a gap, or across the seam between two maps. It uses no pixels.

The mean of the velocities on either side, times the time between them, predicts the displacement. How far such
predictions are off is measured in the run itself, over the same time, wherever the camera was tracked without
interruption. So no unit is needed, and a hand is judged as a hand, a car as a car.

If a gap is longer than the history, the error grows as that of a velocity that changes at random. The camera may also
have stood still for the rest of the time. In the end the test allows everything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.trajectory import Path
from dualslam.core.geometry import sim3
from dualslam.core.noise_model import GATE_SIGMAS, LEAST, MISSING_INTERVALS
from dualslam.core.types import BoolArray, FloatArray, IntArray

WINDOW_S = 0.3
"""Seconds over which a velocity is measured on either side, or `WINDOW_FRAMES`, if these take longer."""
WINDOW_FRAMES = 4
USUAL = 0.95
"""Quantile of the prediction's errors that counts as usual."""
ALLOWED = 3.0
"""Times the usual error: a run of seconds has not shown all that its camera does."""
MIN_ASKED = 12
"""Places at which the same question could be asked."""
INDEPENDENT = 3.0
"""Times the gap that a history must be long to be asked about it: in less, all places are the same stretch."""
GROWTH = 1.5
"""Power of time by which the error grows beyond what could be asked: that of a velocity that walks at random. On real
sequences (hand, drone, car) the error grows with powers of 1.0 to 1.7 between 0.3 and 12 s."""
TAIL = 5
"""Frames at the end of a map that was lost: they may be wrong already."""


Slack = Callable[[int, int], float]
"""Uncertainty of a join at the seam between two frames, in the unit of the map."""


@dataclass(frozen=True, slots=True)
class Motion:
    """The displacement across a gap or a seam, against its prediction. Lengths are in the unit of the map."""

    off_mu: float
    """Distance between the displacement and its prediction; the nearest one, where the camera may have stood still."""
    usual_mu: float  # the usual error of such predictions over the same time
    n_asked: int  # places at which the usual error was measured
    n_sides: int = 2  # sides on which a velocity is known
    change_mu: float = 0.0
    """Error that the change of velocity across the gap explains. The change may have come at any moment between the
    middles of the two windows that measured the velocities."""
    across_mu: float = 0.0  # part of `off_mu` in directions into which that change displaces nothing
    slack_mu: float = 0.0  # what the join of two maps leaves open there

    @property
    def allowed_mu(self) -> float:
        """Return how far off the prediction may be: any way, where it could be asked at too few places."""
        if self.n_asked < MIN_ASKED:
            return math.inf
        usual_mu = ALLOWED * self.usual_mu
        explains = self.across_mu <= usual_mu + self.slack_mu
        return max(usual_mu, self.change_mu if explains else 0.0) + self.slack_mu

    @property
    def is_refused(self) -> bool:
        """Whether the camera cannot have moved so, as far as the run can tell."""
        return self.off_mu > self.allowed_mu


def measure_motion(path: Path, last_before: int, known: Path) -> Motion | None:
    """Compare the displacement behind a frame of a path with what its velocities predict.

    - `last_before`: row of the last frame before the gap, or before the seam.
    - `known`: the camera's path where the usual error is measured, in the unit of `path`.

    Returns Motion or None: none where neither side has a velocity.
    """
    return _measure(_Fits.of(path), last_before, _Fits.of(known))


def step_motions(path: Path, rows: IntArray, known: Path) -> Iterator[Motion]:
    """Measure the motion behind some frames of a path (`measure_motion`), where it can be."""
    fits, fits_known = _Fits.of(path), _Fits.of(known)
    measured = (_measure(fits, i, fits_known) for i in rows.tolist())
    return (motion for motion in measured if motion is not None)


def seam_motions(old: Path, new: Path, slack: Slack = lambda i, j: 0.0) -> Iterator[Motion]:
    """Measure the camera's motion wherever one of two maps follows on the other.

    The usual error is the old map's, or the new one's where the old one is too short. A refused seam is measured once
    more without the old map's last frames, which may be corrupted, and left out if only these contradict it.

    - `old`, `new`: of different frames, in the same coordinates.
    - `slack`: what the join leaves open between a frame of one map and one of the other, given by their indices.
    """
    known = next((fits for fits in map(_Fits.of, (old, new)) if fits.can_be_asked), None)
    if known is None:
        return
    for before, after in _seams(old, new):
        slack_mu = slack(int(before.index[-1]), int(after.index[0]))
        motion = _measure_seam(before, after, known, slack_mu)
        if motion is None:
            continue
        if motion.is_refused and before.index[-1] in old.index:
            sound = before.take(np.arange(len(before)) < len(before) - TAIL)
            without = _measure_seam(sound, after, known, slack_mu) if len(sound) else motion
            if without is not None and not without.is_refused:
                continue
        yield motion


def find_reached(path: Path, is_known: BoolArray, known: Path, sigma_mu: FloatArray) -> BoolArray:
    """Return the frames (N,) of a path whose steps the camera can have made.

    Steps from or to a frame that is not known are measured. Beside a jump the frame that hangs more loosely on the
    known ones is wrong. So are those that follow, up to a known frame or the next jump. The last known frames before a
    refused step may be corrupted, as in `seam_motions`.

    - `is_known` (N,): frames whose place is known.
    - `known`: the camera's path where the usual error is measured, in the unit of `path`.
    - `sigma_mu` (N,): standard deviation of each frame's position against the known ones, 0 for these.
    """
    fits, usual, rows = _Fits.of(path), _Fits.of(known), np.arange(len(path))

    def is_torn(i: int) -> bool:
        motion, tail = _measure(fits, i, usual), is_known & (rows <= i) & (rows > i - TAIL)
        if motion is None or not motion.is_refused or i < TAIL or not tail.any():
            return motion is not None and motion.is_refused
        without = _measure(_Fits.of(path.take(~tail)), i - int(tail.sum()), usual)
        return without is None or without.is_refused

    def excess(i: int) -> float:
        """How far off a step is from either side alone: a jump beside it is in the velocity of one side only."""
        sides = ((rows <= i + 1, i), (rows >= i, 0))
        motions = [_measure(_Fits.of(path.take(side)), at, usual) for side, at in sides]
        return min((m.off_mu / m.allowed_mu for m in motions if m is not None), default=math.inf)

    torn = [i for i in rows[:-1].tolist() if not (is_known[i] and is_known[i + 1]) and is_torn(i)]
    jumps, off = np.zeros(len(path) - 1, bool), np.array([excess(i) for i in torn])
    for run in np.split(np.arange(len(torn)), np.flatnonzero(np.diff(torn) > 1) + 1) if torn else ():
        jumps[np.array(torn)[run[(off[run] > 1.0) | (off[run] == off[run].max())]]] = True
    part = np.concatenate([[0], np.cumsum(jumps | (is_known[:-1] != is_known[1:]))])
    before = np.flatnonzero(jumps)
    return ~np.isin(part, part[np.where(sigma_mu[before] > sigma_mu[before + 1], before, before + 1)])


def join_slack(S_old_new: FloatArray, covariance: FloatArray, place: FloatArray) -> float:
    """Return how far the similarity that joins two maps may displace a place, in the unit of the old map.

    - `S_old_new` (4, 4).
    - `covariance` (7, 7): of xi in ``S_old_new @ exp(xi)``.
    - `place` (3,): in the old map.
    """
    J = S_old_new[:3, :3] @ sim3.displacement(sim3.act(sim3.inverse(S_old_new), place[None])[0])
    return GATE_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ J.T)[-1]))


def gaps_of(times_s: FloatArray) -> IntArray:
    """Return the rows behind which frames are missing."""
    apart_s = np.diff(times_s)
    return np.flatnonzero(apart_s > MISSING_INTERVALS * np.median(apart_s)) if len(apart_s) else np.zeros(0, np.int64)


def _seams(old: Path, new: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the paths before and after each seam, one of each map."""
    times = np.concatenate([old.times_s, new.times_s])
    of_new = np.arange(len(times)) >= len(old)
    order = times.argsort(kind="stable")
    times, of_new = times[order], of_new[order]
    for n in np.flatnonzero(np.diff(of_new.astype(int))).tolist():
        before, after = (new, old) if of_new[n] else (old, new)
        yield before.take(before.times_s <= times[n]), after.take(after.times_s >= times[n + 1])


def _measure_seam(before: Path, after: Path, known: _Fits, slack_mu: float) -> Motion | None:
    return _measure(_Fits.of(before.then(after)), len(before) - 1, known, slack_mu)


def _measure(fits: _Fits, last_before: int, known: _Fits, slack_mu: float = 0.0) -> Motion | None:
    i, j = last_before, last_before + 1
    has = bool(fits.before.known[i]), bool(fits.after.known[j])
    if not any(has):
        return None
    weights = has[0] / sum(has), has[1] / sum(has)
    apart_s = float(fits.times_s[j] - fits.times_s[i])
    velocities, may_halt = (fits.before.velocity[i], fits.after.velocity[j]), 1.0
    if all(has):
        difference, mean = (float(np.linalg.norm(velocities[0] + sign * velocities[1])) for sign in (-1.0, 1.0))
        may_halt = min(1.0, difference / max(mean, LEAST))
    usual, n_asked, asked_s = _usual_error(known, apart_s, *weights)
    # A camera that goes on at the speed that it had has hardly stood still: it may rather be at a similar place.
    off = fits.error_of_a_halt(i, j, *weights, may_halt * (apart_s - asked_s))
    change, across = _explained(off, *velocities, apart_s + fits.reach_s) if all(has) else (0.0, 0.0)
    return Motion(float(np.linalg.norm(off)), usual, n_asked, sum(has), change, across, slack_mu)


def _explained(off: FloatArray, before: FloatArray, after: FloatArray, over_s: float) -> tuple[float, float]:
    """Return how far a change of velocity displaces a camera at most, and the part of an error that it leaves."""
    change = after - before
    along = change / max(float(np.linalg.norm(change)), LEAST)
    speeds, mean = (float(np.linalg.norm(v)) for v in (before, after)), (before + after) / 2
    further = (sum(speeds) / 2 - float(np.linalg.norm(mean))) * over_s
    across = float(np.linalg.norm(off - (off @ along) * along))
    return float(np.linalg.norm(change)) / 2 * over_s, max(across - further, 0.0)


def _usual_error(known: _Fits, apart_s: float, of_before: float, of_after: float) -> tuple[float, int, float]:
    """Return the usual error of predictions over a time, at how many places it was measured, and over which time.

    The predictions are by the velocities before and after, with these weights. Frames that were found again by wide
    matching may have jumped: no stretch with one in it counts.
    """
    if len(known.times_s) < 2:
        return 0.0, 0, 0.0
    span_s = float(known.times_s[-1] - known.times_s[0])
    asked_s, n_asked = min(apart_s, span_s / INDEPENDENT), 0
    while asked_s > known.usual_s / 2:
        i, j = known.stretches(asked_s, of_before > 0, of_after > 0)
        n_asked = max(n_asked, len(i))
        if len(i) >= MIN_ASKED:
            usual = float(np.quantile(known.errors(i, j, of_before, of_after), USUAL))
            return usual * (apart_s / asked_s) ** GROWTH, len(i), asked_s
        asked_s *= 0.5
    return 0.0, n_asked, 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Straight lines through the frames on one side of each of N frames, itself included."""

    velocity: FloatArray
    place: FloatArray  # (N, 3): where they put the camera at the frame's time; its own place where no line is known
    known: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """The lines before and after each frame of a path. `jumped`: frames that were found by wide matching."""

    times_s: FloatArray
    usual_s: float
    reach_s: float
    jumped: BoolArray
    before: _Lines
    after: _Lines

    @classmethod
    def of(cls, path: Path) -> _Fits:
        t = path.times_s - path.times_s[0] if len(path) else path.times_s
        usual_s = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        reach_s = max(WINDOW_S, WINDOW_FRAMES * usual_s) + usual_s / 2
        rows = np.arange(len(t))
        first, end = np.searchsorted(t, t - reach_s, "right"), np.searchsorted(t, t + reach_s, "left")
        before, after = (_fit(t, path.centres, a, b, usual_s) for a, b in ((first, rows + 1), (rows, end)))
        return cls(t, usual_s, reach_s, path.refound, before, after)

    @property
    def can_be_asked(self) -> bool:
        """Whether the usual error can be measured over any time at all."""
        return len(self.stretches(self.usual_s, True, True)[0]) >= MIN_ASKED

    def errors(self, i: IntArray, j: IntArray, of_before: float, of_after: float) -> FloatArray:
        """Return how far the displacements from frames i to j are from their predictions."""
        velocity = of_before * self.before.velocity[i] + of_after * self.after.velocity[j]
        moved = self.after.place[j] - self.before.place[i]
        return np.asarray(np.linalg.norm(moved - velocity * (self.times_s[j] - self.times_s[i])[:, None], axis=1))

    def error_of_a_halt(self, i: int, j: int, of_before: float, of_after: float, halt_s: float) -> FloatArray:
        """Return the error (3,) of one pair of frames, where the camera may have stood still for up to `halt_s`."""
        apart_s = float(self.times_s[j] - self.times_s[i])
        velocity = of_before * self.before.velocity[i] + of_after * self.after.velocity[j]
        moved = self.after.place[j] - self.before.place[i]
        moving_s = float(moved @ velocity) / max(float(velocity @ velocity), LEAST)
        return np.asarray(moved - velocity * np.clip(moving_s, apart_s - halt_s, apart_s), np.float64)

    def stretches(self, apart_s: float, needs_before: bool, needs_after: bool) -> tuple[IntArray, IntArray]:
        """Return the pairs of frames so far apart in time over which the camera was tracked without a jump."""
        t = self.times_s
        j = np.searchsorted(t, t + apart_s - self.usual_s / 2)
        i = np.flatnonzero(j < len(t))
        j = j[i]
        jumps = np.concatenate([[0], np.cumsum(self.jumped)])
        first, end = np.searchsorted(t, t[i] - self.reach_s, "right"), np.searchsorted(t, t[j] + self.reach_s)
        good = jumps[first] == jumps[end]
        good &= self.before.known[i] if needs_before else True
        good &= self.after.known[j] if needs_after else True
        return i[good], j[good]


def _fit(t: FloatArray, centres: FloatArray, first: IntArray, end: IntArray, usual_s: float) -> _Lines:
    """Fit a line to the rows `first` to `end` for each frame: known where there are enough, and none is missing."""
    terms = np.column_stack([np.ones(len(t)), t, t**2, centres, t[:, None] * centres])
    sums = np.vstack([np.zeros(terms.shape[1]), np.cumsum(terms, axis=0)])
    n, s_t, s_tt, s_p, s_tp = np.split(sums[end] - sums[first], [1, 2, 3, 6], axis=1)
    missing = np.concatenate([[0, 0], np.cumsum(np.diff(t) > MISSING_INTERVALS * usual_s)])[: len(t) + 1]
    known = (n[:, 0] >= WINDOW_FRAMES) & (missing[end] == missing[np.minimum(first + 1, len(t))])
    spread = np.where(known[:, None], n * s_tt - s_t**2, 1.0)
    velocity = np.where(known[:, None], (n * s_tp - s_t * s_p) / spread, 0.0)
    place = np.where(known[:, None], (s_p + velocity * (n * t[:, None] - s_t)) / np.maximum(n, 1), centres)
    return _Lines(velocity, place, known)
