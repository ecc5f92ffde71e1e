"""Why a run ends without a map: one plain sentence, from what refused its starts, or from faults of its images."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import FailureReason, FloatArray
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
MOSAIC = "the images look like a raw colour mosaic (Bayer), as a sensor gives it: convert them to colour or grey first"
DARK = "the images are too dark: hardly anything in them is above the noise of the sensor"
FLICKER = "the brightness jumps from frame to frame (flicker, or an exposure that alternates): fix the exposure"
MOSAIC_RATIO = 1.15
"""Mean difference of adjacent pixels over that of pixels two apart. Of a scene it is below 1, of noise 1."""
DARK_GREY = 32
"""Grey level that 99 of 100 pixels of a dark image do not reach: an eighth of the range."""
FLICKER_STOPS = 1.0
"""Between an image and the next; an automatic exposure takes several frames for as much."""
MOST = 0.5
"""Share of the images, or of their pairs, that must show it."""
MIN_SIDE_PX = 32
"""Of an image that is looked at for a mosaic."""
STEP = 4
"""Rows and columns of the pixels whose brightness is looked at."""


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


class ImageFaults:
    """Looks at the images of the frames before there is a map."""

    def __init__(self) -> None:
        self._n = 0
        self._n_mosaic = 0
        self._n_dark = 0
        self._brightness: list[float] = []

    def note(self, image: NDArray[np.uint8]) -> None:
        """Take in the next image, (H, W) or (H, W, 3)."""
        grey = image if image.ndim == 2 else image[..., 1]
        few = grey[::STEP, ::STEP]
        self._n += 1
        self._n_dark += float(np.quantile(few, 0.99)) < DARK_GREY
        self._n_mosaic += _is_mosaic(grey)
        self._brightness.append(float(few.mean()))

    def sentence(self) -> str | None:
        """Return what most images show, without a full stop; None where it is nothing of these."""
        if not self._n:
            return None
        stops: FloatArray = np.abs(np.diff(np.log2(np.maximum(self._brightness, 1.0))))
        for words, share in (
            (MOSAIC, self._n_mosaic / self._n),
            (DARK, self._n_dark / self._n),
            (FLICKER, float((stops > FLICKER_STOPS).mean()) if len(stops) else 0.0),
        ):
            if share > MOST:
                return words
        return None


def _is_mosaic(grey: NDArray[np.uint8]) -> bool:
    """Return whether pixels resemble those two apart more than their neighbours, along rows and along columns."""
    height, width = grey.shape
    if min(height, width) < MIN_SIDE_PX:
        return False
    middle = grey[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4].astype(np.int16)
    for pixels in (middle, middle.T):
        near, far = (float(np.abs(pixels[:, n:] - pixels[:, :-n]).mean()) for n in (1, 2))
        if near <= MOSAIC_RATIO * far:
            return False
    return True
