"""Rolling shutter: rows are read one after the other, so that a turning camera sees each from another direction.

Where every pixel would have been found at the time of the middle row follows from how the camera turns, which matches
to the frame before tell, and from the readout time, which is the camera's own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np
import poselib

from dualslam.config.settings import CameraConfig
from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry import so3
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Failure, Features, FloatArray, View
from dualslam.frontends.tracking.map_readout import ReadoutQuestion, ask_readout
from dualslam.frontends.tracking.resection import poselib_camera
from dualslam.frontends.tracking.turning import turn_between
from dualslam.map.submap import Submap

INFLATION = 4.0
"""How much larger errors are taken to be than they seem, as neighbouring pixels err alike."""
READOUT_EVIDENCE = (3.0 * INFLATION) ** 2
"""Chi-square by which a rolling shutter must explain frames better than a global one, or a global one better than 0.02
s, to be known: three sigmas of inflated errors."""

STEP_S = 0.005
READOUTS_S = STEP_S * np.arange(8)
"""Readout times that are tried: up to all of the time between frames at 30 Hz."""
TYPICAL = 4
"""Place of the readout time, 0.02 s, that must be ruled out for a shutter to count as global."""
MIN_SHIFT_PX = 3.0
"""A view turns fast where so long a readout would shift its first and last rows by so much: several times what lens
models get wrong. Only there can a readout be told from that, and only there does it matter."""
LAG, SPACING = 3, 3
"""Frames between the views of a pair, far enough for the turn to change; and between pairs, which do not overlap."""
SUSPICION = 1 / 9
"""Share of the evidence that makes a rolling shutter likely: one sigma of three."""
MAX_PAIRS = 60
"""Pairs after which a readout time is taken, however unsure: waiting costs more then."""
ENOUGH_PAIRS, ENOUGH_CURVATURE = 150, 50.0
"""Pairs after which the time that is known is good enough; or the second difference of chi-square at it, by steps: a
sigma of 0.004 s with errors four times what they seem. On the first 200 frames of a hand-held turn the times that
were first known lay between 0.012 and 0.035 s, by which frames were paired; the whole says 0.026."""
MIN_CHANGE_S = 0.002
"""A time that is off by less is not corrected once more: 0.1 s of frames cost as much as a frame."""
MIN_MATCHES = 60
TURN_FEATURES = 400
"""Features of a frame that tell its turn: 100 matches of two pixels each fix it to 0.2 px."""
KEPT_RATES = 3600
"""Frames whose turn is kept while the readout time may still change: two minutes at 30 Hz."""
MAX_GAP = 2.5
"""Of two times between frames, how much longer the later one may be for the turn to be carried on from one to the
other."""


def correct_shutter(
    features: Features, camera: Camera, turn_rad: FloatArray, read_v_px: FloatArray | None = None
) -> Features:
    """Move features to where they would be had all rows been read at the time of the middle one.

    Parameters
    ----------
    features : Features
        As found in an image that was read row by row.
    camera : Camera
    turn_rad : (3,)
        Rotation vector by which the camera turns while an image is read, in its own axes.
    read_v_px : (N,), optional
        Rows in which the features were read, where `features` does not tell.
    """
    read_v_px = features.uv_px[:, 1] if read_v_px is None else read_v_px
    uv_rect_px = _at_mid_row(features.uv_rect_px, read_v_px, camera, turn_rad)
    # The found pixels move alike, so that the same features can be rectified again by a better camera.
    return replace(features, uv_px=features.uv_px + uv_rect_px - features.uv_rect_px, uv_rect_px=uv_rect_px)


def _turned(rays: FloatArray, share: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Turn each ray (N, 3) by its share (N,) of a turn (3,), by Rodrigues' formula: N matrices take thrice as long."""
    angle_rad = float(np.linalg.norm(turn_rad))
    axis = turn_rad / max(angle_rad, 1e-12)
    across = rays @ so3.hat(axis).T
    by = share * angle_rad
    # 1 - cos as a square: small turns keep their digits.
    inwards = across @ so3.hat(axis).T
    return np.asarray(rays + np.sin(by)[:, None] * across + (2 * np.sin(0.5 * by) ** 2)[:, None] * inwards, np.float64)


def _at_mid_row(uv_rect_px: FloatArray, read_v_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return rectified pixels (N, 2), read in rows (N,), as they would be at the time of the middle row."""
    K = camera.K
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(uv_rect_px - c) / f, np.ones(len(uv_rect_px))])
    rays = _turned(rays, read_v_px / camera.height - 0.5, turn_rad)
    return np.asarray(f * rays[:, :2] / rays[:, 2:] + c, np.float64)


def straighten(uv_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where things that an image shows at pixels (N, 2) are in the features: as `correct_shutter` moves them."""
    uv_rect_px, _ = camera.rectify(uv_px)
    return uv_px + _at_mid_row(uv_rect_px, uv_px[:, 1], camera, turn_rad) - uv_rect_px


def find_as_read(uv_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where an image shows what features have at pixels (N, 2): the inverse of `straighten`."""
    uv_rect_px, _ = camera.rectify(uv_px)
    read_px = uv_px
    # Each was read in a row that is known once it is put back: a second time, it is.
    for _ in range(2):
        read_px = uv_px + _at_mid_row(uv_rect_px, read_px[:, 1], camera, -turn_rad) - uv_rect_px
    return read_px


def _largest(features: Features) -> Features:
    """Return the features that cover most of the image: from frame to frame they stay the same ones."""
    if len(features) <= TURN_FEATURES:
        return features
    return features.take(np.sort(np.argsort(-features.sigma_px, kind="stable")[:TURN_FEATURES]))


class TurnMeter:
    """How the camera turns from frame to frame, by matches.

    Attributes
    ----------
    between_rad_s : (3,) float64 or None
        Between the two last views; None where it could not be told.
    """

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self._last: View | None = None
        self._gap_s = 0.0
        self.between_rad_s: FloatArray | None = None

    def rate_rad_s(self, view: View, K: FloatArray) -> FloatArray:
        """Take the next view in; return its turn (3,), rad/s, in its own axes: zero where it cannot be told.

        Matches tell the turn half-way between two frames; half a frame more is carried on from the two last turns.
        """
        last, before, gap_s = self._last, self.between_rad_s, self._gap_s
        self._last, self.between_rad_s = view, None
        if last is None:
            return np.zeros(3)
        seen, sees = _largest(last.features), _largest(view.features)
        matches = self._frontend.match_wide(seen, sees)
        uv_a, uv_b = seen.uv_rect_px[matches.index[:, 0]], sees.uv_rect_px[matches.index[:, 1]]
        turn = turn_between(K, uv_a, uv_b)
        self._gap_s = view.timestamp_s - last.timestamp_s
        if turn is None or self._gap_s == 0:
            return np.zeros(3) if before is None else before
        self.between_rad_s = rate = turn / self._gap_s
        if before is None or abs(self._gap_s) > MAX_GAP * abs(gap_s):
            return rate
        return np.asarray(rate + self._gap_s / (gap_s + self._gap_s) * (rate - before), np.float64)


class ReadoutEstimator:
    """The readout time by which matches of turning views fit the epipolar geometry best: from pixels alone.

    Parameters
    ----------
    seed : int
    min_evidence : float
        See `READOUT_EVIDENCE`.

    Attributes
    ----------
    suspects : bool
        Whether a rolling shutter is likely, though its time is not known yet.
    is_done : bool
        Whether more frames would hardly change the time.
    """

    def __init__(self, frontend: Frontend, seed: int, min_evidence: float) -> None:
        self._frontend = frontend
        self._seed = seed
        self._min_evidence = min_evidence
        self._recent: list[tuple[View, FloatArray | None]] = []
        self._chi2 = np.zeros(len(READOUTS_S))
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
        if not (_is_fast(rate_a, camera) or _is_fast(rate_b, camera)):
            return None
        matches = self._frontend.match_wide(a.features, b.features)
        if len(matches) < MIN_MATCHES:
            return None
        of_a, of_b = a.features.take(matches.index[:, 0]), b.features.take(matches.index[:, 1])
        self._chi2 += self._misfits(of_a, rate_a, of_b, rate_b, camera)
        self._n_pairs += 1
        best = int(np.argmin(self._chi2))
        evidence = self._chi2[0 if best else TYPICAL] - self._chi2[best]
        self.suspects = best > 0 and evidence > SUSPICION * self._min_evidence
        # A lowest value at the rim of what is tried is no minimum yet.
        known = evidence > self._min_evidence and best < len(READOUTS_S) - 1
        self.is_done = known and (
            best == 0 or self._n_pairs >= ENOUGH_PAIRS or self._curvature(best) > ENOUGH_CURVATURE
        )
        self.is_done |= self._n_pairs >= ENOUGH_PAIRS
        if known:
            return _minimum(self._chi2, best)
        return _mean(self._chi2) if self._n_pairs >= MAX_PAIRS else None

    def _at(self, n: int, to_rad_s: FloatArray, from_rad_s: FloatArray) -> FloatArray:
        """Return the turn at a frame: between the turns to it and from it, which are those half-way between frames."""
        before_s, at_s, after_s = (self._recent[k][0].timestamp_s for k in (n - 1, n, n + 1))
        share = (at_s - before_s) / (after_s - before_s)
        return np.asarray((1 - share) * to_rad_s + share * from_rad_s, np.float64)

    def _curvature(self, best: int) -> float:
        left, middle, right = self._chi2[best - 1 : best + 2]
        return float(left - 2 * middle + right)

    def _misfits(self, a: Features, rate_a: FloatArray, b: Features, rate_b: FloatArray, camera: Camera) -> FloatArray:
        """Return the robust chi-square (T,) of the best relative pose of two views for each readout time.

        Poses come from RANSAC with the shortest and with the longest time, and are refined with each: RANSAC's own
        scatter would drown what the times differ by.
        """
        sigma_px = np.sqrt(0.5 * (a.sigma_px**2 + b.sigma_px**2))
        lens = poselib_camera(camera.K, (camera.width, camera.height))
        gate_px = CHI2_95[1] ** 0.5 * float(np.median(sigma_px))
        straight = [
            tuple(correct_shutter(x, camera, s * rate).uv_rect_px for x, rate in ((a, rate_a), (b, rate_b)))
            for s in READOUTS_S
        ]
        ransac = {"max_epipolar_error": gate_px, "max_iterations": 500, "min_iterations": 100, "seed": self._seed}
        first = [poselib.estimate_relative_pose(*straight[n], lens, lens, ransac, {})[0] for n in (0, -1)]
        refine = {"loss_type": "CAUCHY", "loss_scale": gate_px, "max_iterations": 25}
        misfits = []
        for uv_a, uv_b in straight:
            of_pose = []
            for start in first:
                pose, _ = poselib.refine_relative_pose(uv_a, uv_b, start, lens, lens, refine)
                T_b_a = np.eye(4)
                T_b_a[:3] = pose.Rt
                error2 = sampson_error(fundamental_from_pose(camera.K, T_b_a), uv_a, uv_b) / sigma_px**2
                of_pose.append(float((CHI2_95[1] * np.log1p(error2 / CHI2_95[1])).sum()))
            misfits.append(min(of_pose))
        return np.array(misfits)


def _is_fast(rate_rad_s: FloatArray, camera: Camera) -> bool:
    """Whether a typical readout would shift the first and last rows of such a view by more than lens errors."""
    return bool(0.5 * READOUTS_S[TYPICAL] * camera.K[0, 0] * np.linalg.norm(rate_rad_s) > MIN_SHIFT_PX)


def _minimum(chi2: FloatArray, best: int) -> float:
    """Return the lowest point of the parabola through the best readout time and its neighbours."""
    if not 0 < best < len(chi2) - 1:
        return float(READOUTS_S[best])
    left, middle, right = chi2[best - 1 : best + 2]
    return float(READOUTS_S[best] + 0.5 * STEP_S * (left - right) / max(left - 2 * middle + right, 1e-9))


def _mean(chi2: FloatArray) -> float:
    """Return the mean over all readout times that are tried, each as likely as it fits.

    Of a few turns the best one jumps between the middle and the rim (0.020 and 0.035 s on ``tum_fr1_rpy``, where the
    whole says 0.026).
    """
    weight = np.exp(-0.5 * (chi2 - chi2.min()) / INFLATION**2)
    return float(weight @ READOUTS_S / weight.sum())


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
        self.is_stated = config.readout_s is not None
        self._estimator = None if self.is_stated else ReadoutEstimator(frontend, seed, READOUT_EVIDENCE)
        self._meter = TurnMeter(frontend)
        self._was_s = 0.0  # by which the frames so far were corrected
        self._rates_rad_s: dict[int, FloatArray] = {}  # of the frames by whose turns the shutter is being found

    def shutter_corrected(self, view: View, camera: Camera) -> View:
        """Take the frame's turn out of it. Frames come in the order of the sequence, each one once."""
        if not self.readout_s:
            return view
        rate_rad_s = self._meter.rate_rad_s(view, camera.K)
        if self._estimator is not None:  # the readout time may still change
            self._note_rate(view, rate_rad_s)
        return self._corrected(view, camera, rate_rad_s)

    def all_corrected(self, views: Iterable[View], camera: Camera) -> list[View]:
        """Take the turns out of the frames that came before the shutter was found, or found anew, in their order.

        The turns that are known serve again; only the others are measured now.
        """
        meter = TurnMeter(self._frontend)
        corrected = []
        for view in views:
            if view.index in self._rates_rad_s:
                rate_rad_s = self._rates_rad_s[view.index]
            elif view.turn_rad is not None and self._was_s:
                rate_rad_s = view.turn_rad / self._was_s
            else:
                rate_rad_s = meter.rate_rad_s(view, camera.K)
            corrected.append(self._corrected(_as_read(view, camera), camera, rate_rad_s))
        return corrected

    def correction(self, indices: Collection[int], camera: Camera) -> Callable[[View], View] | None:
        """Return what takes the turns out of these frames one by one; None where some turn is not known yet."""
        rates = {i: self._rates_rad_s[i] for i in indices if i in self._rates_rad_s}
        readout_s = self.readout_s

        def corrected(view: View) -> View:
            turn_rad = readout_s * rates[view.index]
            raw = _as_read(view, camera)
            return replace(raw, features=correct_shutter(raw.features, camera, turn_rad), turn_rad=turn_rad)

        return corrected if all(i in rates for i in indices) else None

    def _note_rate(self, view: View, rate_rad_s: FloatArray) -> None:
        self._rates_rad_s[view.index] = rate_rad_s
        if len(self._rates_rad_s) > KEPT_RATES:
            del self._rates_rad_s[next(iter(self._rates_rad_s))]

    def _corrected(self, view: View, camera: Camera, rate_rad_s: FloatArray) -> View:
        turn_rad = self.readout_s * rate_rad_s
        return replace(view, features=correct_shutter(view.features, camera, turn_rad), turn_rad=turn_rad)

    def may_start(self, view: View, camera: Camera) -> bool:
        """Whether a map may start from this view, found while there is none; what it tells of the shutter is taken in.

        Of a camera that turns fast, with a shutter that is likely to roll, the rows' shifts would pass for parallax.
        A map that lives is asked itself (`ask`).
        """
        if self._estimator is None:
            return True
        if self.readout_s:
            self._improve(self._estimator, view, camera)
            return True
        self._note_rate(view, self._meter.rate_rad_s(view, camera.K))
        turn = self._meter.between_rad_s
        readout_s = self._estimator.add(view, turn, camera)
        if readout_s is None:
            return not self._estimator.suspects or turn is None or not _is_fast(turn, camera)
        self.readout_s = readout_s
        if self._estimator.is_done or not readout_s:
            self._estimator = None
        return True

    def ask(self, submap: Submap, rates_rad_s: Mapping[int, FloatArray], camera: Camera) -> ReadoutQuestion | Failure:
        """Ask a map for what of the readout is left in its keyframes, with how they turn (rad/s, in their own axes)."""
        return ask_readout(submap, rates_rad_s, camera.height)

    def moved(self, features: Features, camera: Camera, turn_rad: FloatArray) -> Features:
        """Return a keyframe's features without so much more of a turn while it was read."""
        return correct_shutter(features, camera, turn_rad)

    def take(
        self, readout_s: float, rates_rad_s: Mapping[int, FloatArray], latest: Iterable[View], K: FloatArray
    ) -> None:
        """Go on with the readout time that a map has told.

        `rates_rad_s`: how the camera turns at frames so far, for `all_corrected`; `latest`: the last ones, in order.
        """
        self._was_s, self.readout_s, self._estimator = self.readout_s, readout_s, None
        self._rates_rad_s = dict(rates_rad_s)
        if not self._was_s:  # else it has followed the frames
            for view in latest:
                self._meter.rate_rad_s(view, K)

    def _improve(self, estimator: ReadoutEstimator, view: View, camera: Camera) -> None:
        """Let a frame say more of a readout time that is known: by the first frames it may be off by half."""
        self._was_s = self.readout_s
        readout_s = estimator.add(_as_read(view, camera), self._meter.between_rad_s, camera)
        if readout_s and abs(readout_s - self.readout_s) > MIN_CHANGE_S:
            self.readout_s = readout_s
        if estimator.is_done:
            self._estimator = None


def _as_read(view: View, camera: Camera) -> View:
    """Return a view with its turn put back in."""
    if view.turn_rad is None:
        return view
    # Each feature was read in a row that is known once it is put back: a second time, it is.
    first = correct_shutter(view.features, camera, -view.turn_rad)
    features = correct_shutter(view.features, camera, -view.turn_rad, first.uv_px[:, 1])
    return replace(view, features=features, turn_rad=None)
