"""Rolling shutter: lines are read one after the other, so that a turning camera sees each from another direction.

Pixels are corrected to the time of the middle line. That needs the rate of turn, from matches to the frame before, and
the camera's readout time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import CameraConfig
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MISSING_INTERVALS
from dualslam.core.types import Failure, Features, FloatArray, View
from dualslam.frontends.tracking.map_readout import ReadoutQuestion, ask_readout
from dualslam.frontends.tracking.pair_readout import READOUT_EVIDENCE, ReadoutEstimator, is_fast
from dualslam.frontends.tracking.turning import correct_shutter, turn_between
from dualslam.map.submap import Submap

MIN_CHANGE_S = 0.002
"""A time that is off by less is not corrected once more: 0.1 s of frames cost as much as a frame."""
TURN_FEATURES = 400
"""Features of a frame that tell its turn: 100 matches of two pixels each fix it to 0.2 px."""
KEPT_RATES = 3600
"""Frames whose turn is kept while the readout time may still change: two minutes at 30 Hz."""


def _largest(features: Features) -> Features:
    """Return the features that cover most of the image: from frame to frame they stay the same ones."""
    if len(features) <= TURN_FEATURES:
        return features
    return features.take(np.sort(np.argsort(-features.sigma_px, kind="stable")[:TURN_FEATURES]))


class TurnMeter:
    """How the camera turns, by matches; `between_rad_s` (3,) or None: between the two last views."""

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self._last: tuple[float, Features] | None = None  # stamp of the last view, and its largest features
        self._gap_s = 0.0
        self.between_rad_s: FloatArray | None = None

    def rate_rad_s(self, view: View, K: FloatArray) -> FloatArray:
        """Take the next view in; return its turn (3,), rad/s, in its own axes: zero if unknown. Matches give the turn
        half-way between two frames; half a frame more is extrapolated from the two last turns.
        """
        last, before, gap_s = self._last, self.between_rad_s, self._gap_s
        sees = _largest(view.features)
        self._last, self.between_rad_s = (view.timestamp_s, sees), None
        if last is None:
            return np.zeros(3)
        last_s, seen = last
        matches = self._frontend.match_wide(seen, sees)
        uv_a, uv_b = seen.uv_rect_px[matches.index[:, 0]], sees.uv_rect_px[matches.index[:, 1]]
        turn = turn_between(K, uv_a, uv_b)
        self._gap_s = view.timestamp_s - last_s
        goes_back = before is not None and self._gap_s * gap_s < 0  # its stamp says nothing of how fast that was
        if turn is None or self._gap_s == 0 or goes_back:
            return np.zeros(3) if before is None else before
        self.between_rad_s = rate = turn / self._gap_s
        if before is None or abs(self._gap_s) > MISSING_INTERVALS * abs(gap_s):
            return rate
        return np.asarray(rate + self._gap_s / (gap_s + self._gap_s) * (rate - before), np.float64)


class RollingShutter:
    """The shutter of a run's camera: what is known of it, and the views as they would be without it."""

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
        """Take the turns out of the frames that came before the shutter was found, or found anew, in their order."""
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

        Of a camera that turns fast, with a shutter that is likely to roll, the lines' shifts would pass for parallax.
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
            return not self._estimator.suspects or turn is None or not is_fast(turn, camera)
        self.readout_s = readout_s
        if self._estimator.is_done or not readout_s:
            self._estimator = None
        return True

    def ask(self, submap: Submap, rates_rad_s: Mapping[int, FloatArray], camera: Camera) -> ReadoutQuestion | Failure:
        """Ask a map for what of the readout is left in its keyframes, with how they turn (rad/s, in their own axes)."""
        return ask_readout(submap, rates_rad_s, camera.size_px)

    def moved(self, features: Features, camera: Camera, turn_rad: FloatArray) -> Features:
        """Return a keyframe's features without so much more of a turn while it was read."""
        return correct_shutter(features, camera, turn_rad)

    def take(
        self, readout_s: float, rates_rad_s: Mapping[int, FloatArray], latest: Iterable[View], K: FloatArray
    ) -> None:
        """Continue with the readout time estimated from a map.

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
    # Each feature was read in a line that is known once it is put back: a second time, it is.
    first = correct_shutter(view.features, camera, -view.turn_rad)
    features = correct_shutter(view.features, camera, -view.turn_rad, first.uv_px)
    return replace(view, features=features, turn_rad=None)
