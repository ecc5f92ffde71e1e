"""Pixels that stand still in the image while the rest moves: a bonnet, a cab, black bars, a logo, dirt on the lens.

Pairs of images some tenths of a second apart say of each pixel whether its surroundings have stayed. Let lambda be the
smaller eigenvalue of their structure tensor. A movement by r pixels changes them by lambda r^2 at least, in the mean
square and beside the noise. They stay where the change is below that of `STILL_PX`, and move where it is above all that
`MOVED_PX` can make. Untextured surroundings say nothing.

Each pixel collects its votes, of pairs in which part of the image moves. Bars are black and untextured: they are found
as bands along a side, or as corners, that stay black.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import BoolArray
from dualslam.frontends.features.images import ROUNDING_VARIANCE, estimate_noise

U8Image = NDArray[np.uint8]
F32Image = NDArray[np.float32]

MAX_WIDTH_PX = 400
"""Width of the reduced images that are compared. A pair costs 1 ms."""
PERIOD_S, SETTLED_PERIOD_S, SETTLED_AFTER = 0.2, 0.5, 30
"""Seconds between the images that are looked at: at first, and after so many of them."""
MAX_SKIPPED = 30
"""Frames after which one is looked at whatever the clock says."""
LAGS = (1, 3, 8)
"""Images between the two of a pair. The long one is for what is far away ahead: it grows slowly."""
WINDOW_PX = 5
"""Side of the surroundings of a pixel, reduced pixels."""
STILL_PX, MOVED_PX = 0.25, 0.5
"""Movements that count as none, and as one, reduced pixels: below the first, and above the second."""
MIN_NOISE = 0.5
"""Variance of the difference of two reduced images: rounding and compression make that much."""
NOISE_EVERY = 10
"""Images that are looked at from one estimate of the noise to the next."""
MOVING_SHARE = 0.1
"""Of the pixels with an opinion the share that moves at least where the camera does: the others' votes then count."""
MOVED_WEIGHT = 3
"""Votes for standing still that one for moving outweighs: what stands still does so in all pairs."""
FORGOTTEN = 0.25
"""Votes that a pixel which was found loses in a pair that does not confirm it."""
FOUND_VOTES, KEPT_VOTES, MAX_VOTES, MIN_VOTES = 12, 1, 24, -60
"""Votes by which a pixel is found, and then kept; the limits let it change. Seven images give twelve votes. A pixel
that has moved for long needs five times as many: most often the camera has halted, and others drive by."""
SUSPECT_SHARE, SUSPECT_S = 0.01, 3.0
"""Share of the image that may be on its way to being found, and for how long this is waited for."""
CAMERA_STANDS_SHARE = 0.6
"""Of the pixels with an opinion: where more stand still, it is the camera that stands, and something else moves."""
BRIEF_VOTES, MAX_BRIEF, BESIDE_PX = 4, 8, 12
"""Votes from one image to the next that add a pixel within so many reduced pixels of those found; their limit. Digits
that change every second stand still in four of five such pairs; the scene stands in none."""
BLACK_LEVEL, BLACK_CHANGE = 20, 2
"""Grey levels up to which a pixel of a bar is black, and by which it may change: those of codecs."""
BAND_IMAGES, CORNER_IMAGES = 8, 30
"""Images in which a band along a whole side, or a corner of another shape, stays black: shadows do so for longer."""
REDRAWN_SHARE = 0.02
"""Of the pixels found, as many as must change for the outline to be drawn anew."""
MIN_SHARE = 0.001
"""Of the image: smaller spots are left alone."""
NEAR_PX = 8
"""From a pixel that was found to others that are as constant and are hidden with it, reduced pixels: bare surfaces."""
CLOSED_PX = 6
"""Gaps up to twice as wide are filled, reduced pixels: the changing digits of a clock, bare parts of a cab."""
OUTLINE_IMAGES = 10
"""Of the images looked at that are kept in full size, to find the outline to the pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """A reduced image and the eigenvalues of its structure tensor, (h, w) each."""

    grey: F32Image
    low: F32Image
    high: F32Image


class StillPixels:
    """Looks at one frame after the other, and tells which pixels show no scene.

    `size_px` (width, height).

    - `hidden` (H, W) bool or None: pixels that stand still; None while none are found. A new array whenever it changes.
    - `camera_stands`: whether most of the image stands still, and something moves through it.
    """

    def __init__(self, size_px: tuple[int, int]) -> None:
        width, height = size_px
        self.hidden: BoolArray | None = None
        self.camera_stands = False
        self._factor = -(-width // MAX_WIDTH_PX)
        shape = (max(height // self._factor, 1), max(width // self._factor, 1))
        self._shape_px = (height, width)
        self._votes = np.zeros(shape, np.float32)
        self._brief = np.zeros(shape, np.float32)  # votes from one image to the next
        self._found = np.zeros(shape, np.bool_)
        self._black = np.zeros(shape, np.int32)  # images in a row
        self._drawn = np.zeros(shape, np.bool_)  # the seeds of `hidden`
        self._stood = np.zeros(shape, np.bool_)  # the pixels found when the camera was seen to stand
        self._reduced: deque[_Reduced] = deque(maxlen=max(LAGS))
        self._images: deque[U8Image] = deque(maxlen=OUTLINE_IMAGES)
        self._noise = MIN_NOISE  # variance of the difference of two reduced images
        self._n_looked = self._n_skipped = 0
        self._looked_s: float | None = None
        self._suspected_s: float | None = None

    def look(self, timestamp_s: float, grey: U8Image, masked: BoolArray | None = None) -> bool:
        """Take a frame's image (H, W) in; return whether `hidden` has changed.

        `masked`: pixels that are known to show no scene, and have no vote.
        """
        if not self._is_due(timestamp_s):
            return False
        self._looked_s = timestamp_s
        if self._n_looked % NOISE_EVERY == 0:
            variance = (estimate_noise(grey) / self._factor) ** 2 + ROUNDING_VARIANCE
            self._noise = max(2 * variance, MIN_NOISE)
        self._n_looked += 1
        now = self._reduce(grey)
        usable = np.ones(now.grey.shape, np.bool_) if masked is None else ~self._small(masked)
        moves = False
        for lag in LAGS:
            if len(self._reduced) >= lag:
                moves |= self._vote(lag, now, usable)
        np.clip(self._brief, -MAX_BRIEF, MAX_BRIEF, out=self._brief)
        np.clip(self._votes, MIN_VOTES, MAX_VOTES, out=self._votes)
        if moves and self._reduced:
            was = self._reduced[-1].grey
            black = (np.maximum(now.grey, was) <= BLACK_LEVEL) & (np.abs(now.grey - was) <= BLACK_CHANGE)
            self._black = np.where(black, self._black + 1, 0)
        self._reduced.append(now)
        self._images.append(grey.copy())
        self._found = self._votes >= np.where(self._found, KEPT_VOTES, FOUND_VOTES)
        changed = self._draw(usable)
        self._note_suspicion(timestamp_s)
        return changed

    @property
    def is_suspicious(self) -> bool:
        """Whether more of the image seems to stand still than is found yet: a start of a map would better wait."""
        if self._suspected_s is None or self._looked_s is None:
            return False
        return abs(self._looked_s - self._suspected_s) <= SUSPECT_S

    # --- votes

    def _is_due(self, timestamp_s: float) -> bool:
        period_s = PERIOD_S if self._n_looked < SETTLED_AFTER else SETTLED_PERIOD_S
        since_s = np.inf if self._looked_s is None else abs(timestamp_s - self._looked_s)
        self._n_skipped += 1
        if since_s < 0.9 * period_s and self._n_skipped < MAX_SKIPPED:
            return False
        self._n_skipped = 0
        return True

    def _reduce(self, grey: U8Image) -> _Reduced:
        image = self._resized(grey).astype(np.float32)
        across, down = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
        uu, vv, uv = (_mean(each) for each in (across * across, down * down, across * down))
        middle, reach = (uu + vv) / 2, np.asarray(cv2.magnitude((uu - vv) / 2, uv), np.float32)
        low, high = (np.asarray(each, np.float32) for each in (middle - reach, middle + reach))
        return _Reduced(image, low, high)

    def _vote(self, lag: int, now: _Reduced, usable: BoolArray) -> bool:
        """Let a pair of images vote; return whether enough of the image moves for the still ones to count."""
        was = self._reduced[-lag]
        difference = now.grey - was.grey
        mean = _mean(difference)
        change = _mean(difference * difference) - mean * mean  # the light may have changed
        noise = self._noise
        least = np.minimum(was.low, now.low) * np.float32(STILL_PX**2)
        textured = usable & (least > noise / 2)
        stands = textured & (change < least + noise / 2)
        moved = np.maximum(was.high, now.high) * np.float32(MOVED_PX**2)
        moves = usable & (change > 2 * noise) & (change > moved)
        n_moving, n_still = int(np.count_nonzero(moves)), int(np.count_nonzero(stands))
        counts = n_moving > MOVING_SHARE * (n_moving + n_still)
        if counts:
            self._votes[stands] += 1
            self._votes[self._found & ~stands] -= FORGOTTEN
        self._votes[moves] -= MOVED_WEIGHT
        if lag == LAGS[0]:
            self._brief += (stands & counts).astype(np.float32) - moves
        return counts

    def _note_suspicion(self, timestamp_s: float) -> None:
        suspects = ((self._votes > 0) & ~self._found) | _bands(self._black > 0)
        if self.hidden is not None:
            suspects &= ~self._small(self.hidden)
        n_suspects = np.count_nonzero(suspects)
        if n_suspects <= SUSPECT_SHARE * self._votes.size:
            self._suspected_s = None
        elif self._suspected_s is None:
            self._suspected_s = timestamp_s

    # --- the outline

    def _draw(self, usable: BoolArray) -> bool:
        """Draw `hidden` anew where its seeds have changed; return whether it has changed, too."""
        if self.camera_stands and not self._camera_moves():
            return False
        found, dark, was = self._with_changing(self._found) & usable, self._dark(), self.hidden
        seeds = found | dark
        n_changed, n_drawn = np.count_nonzero(seeds != self._drawn), np.count_nonzero(self._drawn)
        if n_changed <= max(REDRAWN_SHARE * n_drawn, MIN_SHARE / 4 * seeds.size) and seeds.any() == self._drawn.any():
            return False
        self._drawn = seeds
        still, black = (self._outline(each) if each.any() else self._large(each) for each in (found, dark))
        others = ~black & self._large(usable)
        n_still, n_moving = np.count_nonzero(found), np.count_nonzero((self._votes < 0) & usable)
        self.camera_stands = bool(
            n_still > CAMERA_STANDS_SHARE * (n_still + n_moving)
            or np.count_nonzero(still & others) > CAMERA_STANDS_SHARE * np.count_nonzero(others)
        )
        if self.camera_stands:
            self._stood = found
        hidden = black if self.camera_stands else still | black
        self.hidden = hidden if hidden.any() else None
        if was is None or self.hidden is None:
            return was is not self.hidden
        return bool((was != self.hidden).any())

    def _with_changing(self, found: BoolArray) -> BoolArray:
        """Add what stands still from one image to the next beside pixels that were found: the digits of a clock."""
        if not found.any():
            return found
        beside = cv2.dilate(found.astype(np.uint8), _box(BESIDE_PX)) > 0
        return np.asarray(found | (beside & (self._brief >= BRIEF_VOTES)))

    def _camera_moves(self) -> bool:
        """Whether a camera that stood moves again: most of what stood still has moved; all votes are forgotten then."""
        n_left = np.count_nonzero(self._found & self._stood)
        if n_left > np.count_nonzero(self._stood) / 2:
            return False
        self._votes = np.minimum(self._votes, 0)
        self._found = np.zeros_like(self._found)
        return True

    def _dark(self) -> BoolArray:
        """Bands along whole sides that stay black, and, after longer, black regions in a corner."""
        dark = _bands(self._black >= BAND_IMAGES)
        if (self._black >= CORNER_IMAGES).any():
            _, label = cv2.connectedComponents((self._black >= CORNER_IMAGES).astype(np.uint8), connectivity=4)
            corners = np.unique(label[[0, 0, -1, -1], [0, -1, 0, -1]])
            dark |= np.isin(label, corners[corners > 0])
        return dark

    def _outline(self, seeds: BoolArray) -> BoolArray:
        """Find, in full size, what stays about as constant as the seeds beside them; without holes and specks."""
        lowest, highest = self._images[0].copy(), self._images[0].copy()
        for image in list(self._images)[1:]:
            cv2.min(lowest, image, lowest)
            cv2.max(highest, image, highest)
        spread, small = cv2.subtract(highest, lowest), seeds.astype(np.uint8)
        inside = self._large(seeds)
        constant = spread <= 2 * np.median(spread[inside]) + 4
        near = self._large(cv2.dilate(small, _box(NEAR_PX)))
        sure = self._large(cv2.erode(small, _box(1)))
        drawn = cv2.medianBlur(((near & constant) | sure).astype(np.uint8), 5)
        reach = CLOSED_PX * self._factor
        padded = cv2.copyMakeBorder(drawn, *4 * (2 * reach,), cv2.BORDER_REPLICATE)
        drawn = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _box(reach))[2 * reach : -2 * reach, 2 * reach : -2 * reach]
        drawn = cv2.morphologyEx(drawn, cv2.MORPH_OPEN, _box(2))
        _, label, stats, _ = cv2.connectedComponentsWithStats(drawn)
        large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= MIN_SHARE * drawn.size)
        return np.asarray((drawn > 0) & np.isin(label, large))

    # --- sizes

    def _resized(self, image: U8Image) -> U8Image:
        (height, width), factor = self._votes.shape, self._factor
        whole = image[: height * factor, : width * factor]
        return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def _small(self, mask: BoolArray) -> BoolArray:
        """Reduced pixels any of whose pixels a mask has."""
        return np.asarray(self._resized(mask.astype(np.uint8) * np.uint8(255)) > 0)

    def _large(self, small: NDArray[np.generic]) -> BoolArray:
        height, width = self._shape_px
        return np.asarray(cv2.resize(small.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def _mean(image: F32Image) -> F32Image:
    return np.asarray(cv2.boxFilter(image, -1, (WINDOW_PX, WINDOW_PX)), np.float32)


def _bands(black: BoolArray) -> BoolArray:
    """Return the bands along whole sides in which all is black."""
    bands = np.zeros_like(black)
    for each, filled in ((black, bands), (black.T, bands.T)):
        lines = np.asarray(each.all(axis=1))
        first, last = _run_at_start(lines), _run_at_start(lines[::-1])
        filled[:first] = True
        filled[len(lines) - last :] = True
    return bands


def _box(reach: int) -> U8Image:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _run_at_start(lines: BoolArray) -> int:
    """Return how many lines, from the first on, are true."""
    return len(lines) if lines.all() else int(lines.argmin())
