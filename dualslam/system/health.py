"""Is this map still consistent with what the camera sees? A verdict for every tracked frame, with its reason.

Some reasons fail a frame. Weaker ones, the early signs, fail nothing: they mark the stretch before a failure in which
the map may be corrupted already, so that linking does not trust it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.arrays import quantile
from dualslam.core.chi_square import CHI2_90, CHI2_9999
from dualslam.core.config.settings import HealthConfig
from dualslam.core.estimates import KeyframeReport
from dualslam.core.geometry import se3
from dualslam.core.noise_model import GATE_SIGMAS, MAJORITY
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, FloatArray, Track

JUMP_CHI2 = CHI2_9999[se3.DOF]
"""Early sign: squared Mahalanobis distance of a pose from the motion model's, above its level there: chi-square, 6
degrees of freedom, 99.99 % (what drivers and hands do has heavier tails than a Gaussian). The covariance is that of the
pose plus the motion model's own error in the last frames."""
MAX_KEYFRAME_CHI2 = 2.0
"""Early sign: chi-square of the graph's newest factors over its degrees of freedom, relative to that level. They hold
outliers that no one has sorted out yet, and no quantile is known for them."""
LEVEL_FRAMES = 60
"""Healthy frames on which the level of the chi-square and the error of the motion model are measured."""
SIGN_WEIGHT = 4
"""Healthy frames that outweigh one with a sign: the stretch in which the signs outweigh, up to the loss, is suspected
to be corrupted. Signs on up to one healthy frame in five then add up to nothing."""

MEMORY_FRAMES = 300
"""Verdicts that are kept: no suspected stretch reaches back farther than the frame buffer."""
TAIL, TAIL_SIGMAS = 0.9, math.sqrt(CHI2_90[1])
"""A quantile, and where it lies for the size of a Gaussian (in sigmas)."""
MIN_INNOVATIONS = 8
"""Frames before which the motion model's error is not known."""


@dataclass(frozen=True, slots=True)
class FrameHealth:
    """The verdict on one frame: whether the map explains it, and what speaks against that."""

    index: int
    signs: tuple[FailureReason, ...]
    """Empty for a healthy frame. Signs alone fail nothing: they mark the stretch that may be corrupted."""
    failed: bool
    numbers: dict[str, float]
    """Inlier ratio, chi-square over its degrees of freedom, squared Mahalanobis distance from the motion model."""


class HealthMonitor:
    """Judges the frames of one submap one after the other, each against what the frames before it were like.

    The motion model's error and the level of the chi-square, which contains the camera model's error, are those of the
    last seconds.
    """

    def __init__(self, config: HealthConfig) -> None:
        self._config = config
        self._frames: deque[FrameHealth] = deque(maxlen=MEMORY_FRAMES)
        self._chi2: deque[float] = deque(maxlen=LEVEL_FRAMES)
        self._jump: deque[float] = deque(maxlen=LEVEL_FRAMES)
        self._innovation: deque[FloatArray] = deque(maxlen=LEVEL_FRAMES)

    def judge(self, track: Track | Failure, index: int) -> Track | Failure:
        """Return the track if the map explains it, else why not, and remember either (`index`: the frame's)."""
        verdict = judge_track(track, self._config)
        if isinstance(track, Failure):
            self._frames.append(FrameHealth(index, (track.reason,), True, track.numbers))
            return verdict
        jump2, innovation = self._jump2(track)
        numbers = {"inlier_ratio": track.n_inliers / max(track.n_matches, 1), "chi2": track.chi2, "jump2": jump2}
        signs = self._signs(track, jump2)
        if isinstance(verdict, Failure):
            self._frames.append(FrameHealth(index, (verdict.reason, *signs), True, numbers))
            return verdict
        self._frames.append(FrameHealth(index, signs, False, numbers))
        # Frames with signs too: a median is not moved by few, and what has become the rule is learnt.
        self._chi2.append(track.chi2)
        if not track.wide:
            self._innovation.append(innovation)
            self._jump.append(jump2)
        return verdict

    def note_keyframe(self, report: KeyframeReport | Failure) -> None:
        """Hold what the graph made of the newest frame against it: its newest factors' chi-square, a solver failure."""
        if not self._frames:
            return
        newest, signs = self._frames[-1], []
        if isinstance(report, Failure):
            numbers = {**newest.numbers, **report.numbers}
            self._frames[-1] = replace(newest, signs=(*newest.signs, report.reason), failed=True, numbers=numbers)
            return
        chi2 = report.posed.chi2_newest
        if chi2 > MAX_KEYFRAME_CHI2 * _level(self._chi2, 1.0):
            signs.append(FailureReason.CHI_SQUARE)
        if report.solver_failed:
            signs.append(FailureReason.SOLVER)
        numbers = {**newest.numbers, "chi2_keyframe": chi2}
        self._frames[-1] = replace(newest, signs=(*newest.signs, *signs), numbers=numbers)

    @property
    def newest(self) -> FrameHealth | None:
        """The verdict on the newest frame."""
        return self._frames[-1] if self._frames else None

    def suspected(self) -> list[FrameHealth]:
        """Return the frames of the stretch that may be corrupted, oldest first: from the onset to the newest frame.

        A cumulative sum (Page's CUSUM): a frame with signs adds, a healthy one takes away, and the stretch began where
        the sum last left zero. It is empty where the sum is zero now.
        """
        began, total = len(self._frames), 0
        for i, frame in enumerate(self._frames):
            if total == 0:
                began = i
            total = total + SIGN_WEIGHT if frame.signs else max(total - 1, 0)
        return list(self._frames)[began:] if total else []

    # --- signs

    def _signs(self, track: Track, jump2: float) -> tuple[FailureReason, ...]:
        config = self._config
        signs = []
        if track.n_inliers < 2 * config.min_inliers:
            signs.append(FailureReason.TOO_FEW_INLIERS)
        if track.n_inliers < MAJORITY * track.n_matches:
            signs.append(FailureReason.LOW_INLIER_RATIO)
        if jump2 > JUMP_CHI2 * _level(self._jump, CHI2_90[se3.DOF], TAIL):
            signs.append(FailureReason.MOTION_JUMP)
        dof = max(2 * track.n_inliers - 6, 1)
        if track.chi2 > _level(self._chi2, 1.0) * (1 + GATE_SIGMAS * math.sqrt(2 / dof)):
            signs.append(FailureReason.CHI_SQUARE)
        return tuple(signs)

    def _jump2(self, track: Track) -> tuple[float, FloatArray]:
        """Return the squared Mahalanobis distance of a pose from the prediction, and the difference itself (6,).

        Its covariance is that of the pose and that of the motion model, as the last frames show it; 0 without those.
        """
        difference = se3.log(track.T_cam_submap @ se3.inverse(track.T_predicted))
        if len(self._innovation) < MIN_INNOVATIONS or track.wide:
            return 0.0, difference
        # What drivers and hands do has heavier tails than a Gaussian: its sigma is taken from where they begin.
        sigma = quantile(np.abs(self._innovation), TAIL) / TAIL_SIGMAS
        covariance = track.covariance + np.diag(sigma**2)
        return float(difference @ np.linalg.solve(covariance, difference)), difference


def _level(recent: Collection[float], expected: float, share: float = 0.5) -> float:
    """Return how many times larger a quantile of recent chi-squares is than expected, at least 1."""
    return max(1.0, float(quantile(np.array(recent), share)) / expected) if recent else 1.0


def count_signs(frames: Iterable[FrameHealth]) -> dict[str, int]:
    """Return how many of the frames show each sign, for the event log."""
    return dict(Counter(str(sign) for frame in frames for sign in frame.signs))
