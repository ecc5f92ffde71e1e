"""Why a run ends without a map: one plain sentence, from what refused its starts."""

from __future__ import annotations

from collections import Counter

import numpy as np

from dualslam.core.types import FailureReason
from dualslam.map.frame_records import FrameResult

SHORT = 10
"""Images, and fewer, are a third of a second of most recordings: whatever refused them, there was no time to move."""
STILL_PX = 1.0
"""Median shift of an image below which nothing moves: matches of a camera on a tripod differ by their noise, well below
a pixel. One that turns in a hand leaves a pixel within a frame or two."""
STILL_QUANTILE = 0.9
"""Of the shifts, which must be that small: a knock at the tripod is no motion."""

LITTLE_PARALLAX = (
    "the camera turns but hardly moves from its place: a map needs a way sideways or forward past what is near"
)
NOTHING_MOVES = "nothing moves: the images show the same all the time"
REFUSED = "each start that was found was refused as doubtful: fast turns, things that move, or a wrong calibration"
WORDS = {
    FailureReason.UNREADABLE: "the images cannot be read",
    FailureReason.NO_TEXTURE: "the images are black, blurred or without texture: they show too few points",
    FailureReason.TOO_FEW_MATCHES: "the images have too little in common with those before them: too fast, or blurred",
    FailureReason.TOO_FEW_INLIERS: (
        "what the images have in common fits no motion of one camera: things that move, or a wrong calibration"
    ),
    FailureReason.CAMERA_STANDS: "the camera stands still, and something moves before it",
    FailureReason.AMBIGUOUS_MODEL: "two motions explain the images alike: it moves little, or sees a plane alone",
    FailureReason.DOUBTFUL_INITIALISATION: REFUSED,
    FailureReason.CHI_SQUARE: REFUSED,
    FailureReason.SOLVER: REFUSED,
}


class StartRefusals:
    """Counts, frame by frame, why none started a map."""

    def __init__(self) -> None:
        self._n_images = 0
        self._counts: Counter[FailureReason] = Counter()
        self._shifts_px: list[float] = []

    def note(self, result: FrameResult) -> None:
        """Take in what became of a frame."""
        failure = result.failure
        self._n_images += failure is None or failure.reason is not FailureReason.UNREADABLE
        if failure is None or failure.reason is FailureReason.BUSY:
            return
        self._counts[failure.reason] += 1
        if "shift_px" in failure.numbers:
            self._shifts_px.append(failure.numbers["shift_px"])

    def sentence(self) -> str | None:
        """Return the reason that most frames gave, in words and without a full stop; None where none gave any."""
        if not self._counts:
            return None
        reason, n = self._counts.most_common(1)[0]
        if 0 < self._n_images <= SHORT and reason is not FailureReason.NO_TEXTURE:
            return f"too short: {self._n_images} {'image' if self._n_images == 1 else 'images'}"
        if reason is FailureReason.LOW_PARALLAX:
            stands = self._shifts_px and float(np.quantile(self._shifts_px, STILL_QUANTILE)) < STILL_PX
            words = NOTHING_MOVES if stands else LITTLE_PARALLAX
        else:
            words = WORDS.get(reason, f"no start was possible ({reason})")
        total = self._counts.total()
        return words if n == total else f"{words} ({n} of {total} frames)"
