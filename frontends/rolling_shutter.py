"""Rolling shutter: rows are read one after the other, so that a turning camera sees each from another direction.

Where every pixel would have been found at the time of the middle row follows from how the camera turns, which matches
to the frame before tell, and from the readout time, which is the camera's own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import poselib

from dualslam.core.camera import Camera
from dualslam.core.config import CameraConfig
from dualslam.core.geometry import so3
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray, View
from frontends.resection import poselib_camera
from frontends.turning import turn_between
from frontends.two_view_hypotheses import CHI2_1

STEP_S = 0.005
READOUTS_S = STEP_S * np.arange(8)
"""Readout times that are tried: up to all of the time between frames at 30 Hz."""
TYPICAL_S, MIN_SHIFT_PX = 0.02, 3.0
"""A pair of views is asked where so long a readout would shift its first and last rows by so much: several times what
lens models get wrong, which could pass for it."""
LAG, SPACING = 3, 4
"""Frames between the two views of a pair, and between pairs: far enough for the turn to change."""
MIN_MATCHES = 60
MAX_GAP = 2.5
"""Of two times between frames, how much longer the later one may be for the turn to be carried on from one to the
other."""


def straighten(features: Features, camera: Camera, turn_rad: FloatArray) -> Features:
    """Move features to where they would be had all rows been read at the time of the middle one.

    Parameters
    ----------
    features : Features
        As found in an image that was read row by row.
    camera : Camera
    turn_rad : (3,)
        Rotation vector by which the camera turns while an image is read, in its own axes.
    """
    K = camera.K
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(features.uv_rect_px - c) / f, np.ones(len(features))])
    late = features.uv_px[:, 1] / camera.height - 0.5
    rays = np.einsum("nij,nj->ni", so3.exp(late[:, None] * turn_rad), rays)
    uv_rect_px = f * rays[:, :2] / rays[:, 2:] + c
    # The found pixels move alike, so that the same features can be rectified again by a better camera.
    return replace(features, uv_px=features.uv_px + uv_rect_px - features.uv_rect_px, uv_rect_px=uv_rect_px)


class TurnMeter:
    """How the camera turns at each frame, by matches to the frame before."""

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self._last: View | None = None
        self._rate_rad_s: FloatArray | None = None
        self._gap_s = 0.0

    def rate_rad_s(self, view: View, K: FloatArray) -> FloatArray:
        """Take the next view in; return its turn (3,), rad/s, in its own axes: zero where it cannot be told.

        Matches tell the turn half-way between two frames; half a frame more is carried on from the two last turns.
        """
        last, before, gap_s = self._last, self._rate_rad_s, self._gap_s
        self._last, self._rate_rad_s = view, None
        if last is None:
            return np.zeros(3)
        matches = self._frontend.match_wide(last.features, view.features)
        uv_a, uv_b = last.features.uv_rect_px[matches.index[:, 0]], view.features.uv_rect_px[matches.index[:, 1]]
        turn = turn_between(K, uv_a, uv_b)
        self._gap_s = view.timestamp_s - last.timestamp_s
        if turn is None or self._gap_s == 0:
            return np.zeros(3) if before is None else before
        self._rate_rad_s = rate = turn / self._gap_s
        if before is None or abs(self._gap_s) > MAX_GAP * abs(gap_s):
            return rate
        return np.asarray(rate + 0.5 * (rate - before), np.float64)


class ReadoutEstimator:
    """The readout time by which matches of turning views fit the epipolar geometry best: from pixels alone.

    Parameters
    ----------
    seed : int
    min_evidence : float
        See `CameraConfig.readout_evidence`.
    """

    def __init__(self, frontend: Frontend, seed: int, min_evidence: float) -> None:
        self._frontend = frontend
        self._seed = seed
        self._min_evidence = min_evidence
        self._recent: list[tuple[View, FloatArray]] = []
        self._chi2 = np.zeros(len(READOUTS_S))
        self._n_frames = 0

    def add(self, view: View, rate_rad_s: FloatArray, camera: Camera) -> float | None:
        """Take the next view and its turn in; return the readout time, s, once it is known not to be zero."""
        self._recent = [*self._recent[-LAG:], (view, rate_rad_s)]
        self._n_frames += 1
        if len(self._recent) <= LAG or self._n_frames % SPACING:
            return None
        (a, rate_a), (b, rate_b) = self._recent[0], self._recent[-1]
        rows_px = 0.5 * TYPICAL_S * camera.K[0, 0] * max(np.linalg.norm(rate_a), np.linalg.norm(rate_b))
        if rows_px < MIN_SHIFT_PX:
            return None
        matches = self._frontend.match_wide(a.features, b.features)
        if len(matches) < MIN_MATCHES:
            return None
        of_a, of_b = a.features.take(matches.index[:, 0]), b.features.take(matches.index[:, 1])
        chi2 = [self._misfit(of_a, rate_a * s, of_b, rate_b * s, camera) for s in READOUTS_S]
        self._chi2 += np.array(chi2) - min(chi2)
        best = int(np.argmin(self._chi2))
        known = self._chi2[0] - self._chi2[best] > self._min_evidence
        return _minimum(self._chi2, best) if known else None

    def _misfit(self, a: Features, turn_a: FloatArray, b: Features, turn_b: FloatArray, camera: Camera) -> float:
        """Return the truncated chi-square of the best relative pose of two straightened views."""
        uv_a, uv_b = straighten(a, camera, turn_a).uv_rect_px, straighten(b, camera, turn_b).uv_rect_px
        sigma_px = np.sqrt(0.5 * (a.sigma_px**2 + b.sigma_px**2))
        lens = poselib_camera(camera.K, (camera.width, camera.height))
        gate = 2.0 * float(np.median(sigma_px))
        options = {"max_epipolar_error": gate, "max_iterations": 200, "min_iterations": 50, "seed": self._seed}
        pose, _ = poselib.estimate_relative_pose(uv_a, uv_b, lens, lens, options, {})
        T_b_a = np.eye(4)
        T_b_a[:3] = pose.Rt
        error2 = sampson_error(fundamental_from_pose(camera.K, T_b_a), uv_a, uv_b)
        return float(np.minimum(error2 / sigma_px**2, CHI2_1).sum())


def _minimum(chi2: FloatArray, best: int) -> float:
    """Return the lowest point of the parabola through the best readout time and its neighbours."""
    if not 0 < best < len(chi2) - 1:
        return float(READOUTS_S[best])
    left, middle, right = chi2[best - 1 : best + 2]
    return float(READOUTS_S[best] + 0.5 * STEP_S * (left - right) / max(left - 2 * middle + right, 1e-9))


class RollingShutter:
    """The shutter of a run's camera: what is known of it, and the views as they would be without it.

    Parameters
    ----------
    frontend : Frontend
    config : CameraConfig
    seed : int
    """

    def __init__(self, frontend: Frontend, config: CameraConfig, seed: int) -> None:
        self._frontend = frontend
        self.readout_s = config.readout_s or 0.0
        asks = config.readout_s is None
        self._estimator = ReadoutEstimator(frontend, seed, config.readout_evidence) if asks else None
        self._meter = TurnMeter(frontend)

    def straightened(self, view: View, camera: Camera) -> View:
        """Take the frame's turn out of it. Frames come in the order of the sequence, each one once."""
        if not self.readout_s:
            return view
        turn_rad = self.readout_s * self._meter.rate_rad_s(view, camera.K)
        return replace(view, features=straighten(view.features, camera, turn_rad), turn_rad=turn_rad)

    def learns(self, view: View, camera: Camera) -> bool:
        """Whether this view, found while there is no map, tells the readout time for the first time.

        A map that lives needs no other pixels than those it is made of, and a camera whose maps live needs no other
        shutter: so nobody asks then.
        """
        if self._estimator is None:
            return False
        readout_s = self._estimator.add(view, self._meter.rate_rad_s(view, camera.K), camera)
        if readout_s is None:
            return False
        self.readout_s, self._estimator, self._meter = readout_s, None, TurnMeter(self._frontend)
        return True
