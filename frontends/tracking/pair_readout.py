"""The readout time of a rolling shutter by pairs of turning views: what can be had of it before there is a map."""

from __future__ import annotations

import numpy as np
import poselib

from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry import se3
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import GATE_SIGMAS, INFLATION, PAIR_MATCHES, TINY
from dualslam.core.types import Features, FloatArray, View
from dualslam.frontends.tracking.resection import poselib_camera
from dualslam.frontends.tracking.turning import at_middle

READOUT_EVIDENCE = (GATE_SIGMAS * INFLATION) ** 2
"""Chi-square by which a rolling shutter must explain frames better than a global one, or a global one better than 0.02
s, to be known: three sigmas of inflated errors."""

STEP_S = 0.005
READOUTS_S = STEP_S * np.arange(8)
"""Readout times that are tried: up to all of the time between frames at 30 Hz."""
TYPICAL = 4
"""Place of the readout time, 0.02 s, that must be ruled out for a shutter to count as global."""
MIN_SHIFT_PX = 3.0
"""A view turns fast where so long a readout would shift its first and last lines by so much: several times what lens
models get wrong. Only there can a readout be separated from these, and only there does it matter."""
LAG, SPACING = 3, 3
"""Frames between the views of a pair, far enough for the turn to change; and between pairs, which do not overlap."""
SUSPICION = 1 / GATE_SIGMAS**2
"""Share of the evidence that makes a rolling shutter likely: one sigma of those of a gate."""
MAX_PAIRS = 60
"""Pairs after which a readout time is taken, however unsure: waiting costs more then."""
ENOUGH_PAIRS, ENOUGH_CURVATURE = 150, 50.0
"""Pairs after which the time that is known is good enough; or the second difference of chi-square at it, by steps: a
sigma of 0.004 s with errors four times what they seem. On the first 200 frames of a hand-held turn the first estimates
lay between 0.012 and 0.035 s, depending on the pairs. All pairs together give 0.026."""
STEP_TOLERANCE = 1e-4
"""At which a refinement ends, radians: a twentieth of a pixel. Chi-squares, of hundreds, are 0.02 off at most."""


class ReadoutEstimator:
    """The readout time by which matches of turning views fit the epipolar geometry best: from pixels alone.

    `min_evidence`: see `READOUT_EVIDENCE`.

    - `suspects`: whether a rolling shutter is likely, though its time is not known yet.
    - `is_done`: whether more frames would hardly change the time.
    """

    def __init__(self, frontend: Frontend, seed: int, min_evidence: float) -> None:
        self._frontend = frontend
        self._seed = seed
        self._min_evidence = min_evidence
        self._recent: list[tuple[View, FloatArray | None]] = []
        self._direction = 1.0  # -1: lines are read from the last to the first
        self._chi2, self._chi2_turned = np.zeros(len(READOUTS_S)), 0.0
        self._n_pairs = 0
        self.suspects = self.is_done = False
        self._n_frames = 0

    def add(self, view: View, before_rad_s: FloatArray | None, camera: Camera) -> float | None:
        """Take the next view in as it was read, with the turn since the one before; return the readout time, s.

        None until it is known, and with frames that say nothing of it.
        """
        self._recent = [*self._recent[-LAG - 2 :], (view, before_rad_s)]
        self._n_frames += 1
        if len(self._recent) < LAG + 3 or self._n_frames % SPACING:
            return None
        (a, to_a), (_, from_a), (b, to_b), (_, from_b) = (self._recent[n] for n in (1, 2, -2, -1))
        if to_a is None or from_a is None or to_b is None or from_b is None:
            return None
        rate_a, rate_b = (self._at(n, to, since) for n, to, since in ((1, to_a, from_a), (-2, to_b, from_b)))
        if not (is_fast(rate_a, camera) or is_fast(rate_b, camera)):
            return None
        matches = self._frontend.match_wide(a.features, b.features)
        if len(matches) < PAIR_MATCHES:
            return None
        of_a, of_b = a.features.take(matches.index[:, 0]), b.features.take(matches.index[:, 1])
        misfits, turned = self._misfits(of_a, rate_a, of_b, rate_b, camera)
        self._chi2 += misfits
        self._chi2_turned += turned
        self._n_pairs += 1
        if self._chi2.min() - self._chi2_turned > SUSPICION * self._min_evidence:
            # Images that were turned upside down: begin anew, from the last line to the first.
            self._direction *= -1.0
            self._chi2, self._chi2_turned, self._n_pairs = np.zeros(len(READOUTS_S)), 0.0, 0
            return None
        best = int(np.argmin(self._chi2))
        evidence = self._chi2[0 if best else TYPICAL] - self._chi2[best]
        self.suspects = best > 0 and evidence > SUSPICION * self._min_evidence
        # A lowest value at the rim of what is tried is no minimum yet.
        known = evidence > self._min_evidence or (self.suspects and self._is_narrow(best))
        known &= best < len(READOUTS_S) - 1
        self.is_done = known and (
            best == 0 or self._n_pairs >= ENOUGH_PAIRS or self._curvature(best) > ENOUGH_CURVATURE
        )
        self.is_done |= self._n_pairs >= ENOUGH_PAIRS
        if known:
            return self._direction * _minimum(self._chi2, best)
        return self._direction * _mean(self._chi2) if self._n_pairs >= MAX_PAIRS else None

    def _at(self, n: int, to_rad_s: FloatArray, from_rad_s: FloatArray) -> FloatArray:
        """Return the turn at a frame: between the turns to it and from it, which are those half-way between frames."""
        before_s, at_s, after_s = (self._recent[k][0].timestamp_s for k in (n - 1, n, n + 1))
        share = np.clip((at_s - before_s) / (after_s - before_s), 0.0, 1.0) if after_s != before_s else 0.5
        return np.asarray((1 - share) * to_rad_s + share * from_rad_s, np.float64)

    def _is_narrow(self, best: int) -> bool:
        """Whether all times but the best one and its neighbours are ruled out: a short one hardly differs from none."""
        others = np.delete(self._chi2, slice(best - 1, best + 2))
        return bool(others.min() - self._chi2[best] > self._min_evidence)

    def _curvature(self, best: int) -> float:
        left, middle, right = self._chi2[best - 1 : best + 2]
        return float(left - 2 * middle + right)

    def _misfits(
        self, a: Features, rate_a: FloatArray, b: Features, rate_b: FloatArray, camera: Camera
    ) -> tuple[FloatArray, float]:
        """Return the robust chi-square of the best relative pose of two views for each readout time (T,). The second
        result is for a typical time with the lines read the other way round.

        RANSAC gives the poses for the shortest and the longest time. From there each pose is refined from that of the
        neighbouring time, upwards and downwards: RANSAC's own scatter would hide the differences between times.
        """
        sigma_px = np.sqrt((a.sigma_px**2 + b.sigma_px**2) / 2)
        lens = poselib_camera(camera.K, camera.size_px)
        gate_px = CHI2_95[1] ** 0.5 * float(np.median(sigma_px))
        readouts_s = self._direction * np.append(READOUTS_S, -READOUTS_S[TYPICAL])
        views = ((a, rate_a), (b, rate_b))
        moved = [at_middle(x.uv_rect_px, x.uv_px, camera, *(s * rate for s in readouts_s)) for x, rate in views]
        straight = list(zip(*moved, strict=True))
        converged = {"step_tol": STEP_TOLERANCE}
        ransac = {"max_epipolar_error": gate_px, "max_iterations": 500, "min_iterations": 50, "seed": self._seed}
        refine = {"loss_type": "CAUCHY", "loss_scale": gate_px, "max_iterations": 25, **converged}
        times = range(len(READOUTS_S))
        misfits = np.full(len(straight), np.inf)
        for way in (times, (*reversed(times), -1)):
            pose = poselib.estimate_relative_pose(*straight[way[0]], lens, lens, ransac, converged)[0]
            for n in way:
                pose = poselib.refine_relative_pose(*straight[n], pose, lens, lens, refine)[0]
                T_b_a = se3.from_parts(pose.R, pose.t)
                error2 = sampson_error(fundamental_from_pose(camera.K, T_b_a), *straight[n]) / sigma_px**2
                misfits[n] = min(misfits[n], float((CHI2_95[1] * np.log1p(error2 / CHI2_95[1])).sum()))
        return misfits[:-1], float(misfits[-1])


def is_fast(rate_rad_s: FloatArray, camera: Camera) -> bool:
    """Whether a typical readout would shift the first and last lines of such a view by more than lens errors."""
    return bool(READOUTS_S[TYPICAL] / 2 * camera.K[0, 0] * np.linalg.norm(rate_rad_s) > MIN_SHIFT_PX)


def _minimum(chi2: FloatArray, best: int) -> float:
    """Return the lowest point of the parabola through the best readout time and its neighbours."""
    if not 0 < best < len(chi2) - 1:
        return float(READOUTS_S[best])
    left, middle, right = chi2[best - 1 : best + 2]
    return float(READOUTS_S[best] + STEP_S / 2 * (left - right) / max(left - 2 * middle + right, TINY))


def _mean(chi2: FloatArray) -> float:
    """Return the mean over all readout times that are tried, each as likely as it fits: the best of few turns jumps."""
    weight = np.exp(-0.5 * (chi2 - chi2.min()) / INFLATION**2)
    return float(weight @ READOUTS_S / weight.sum())
