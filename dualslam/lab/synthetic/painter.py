"""The paint box: fractal noise, and a canvas with the marks that the materials of the scenes are composed of."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

F32Image = NDArray[np.float32]
_BANK_SIZE = 1024


class NoiseBank:
    """Periodic 1/f fields from which random windows are cut: as good as fresh noise, at a fraction of the time.

    Parameters
    ----------
    seed : int
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 0xBA2C])
        self.rough = [_fractal_field(rng, 1.1) for _ in range(2)]
        self.smooth = [_fractal_field(rng, 1.9) for _ in range(2)]


def _fractal_field(rng: np.random.Generator, exponent: float) -> F32Image:
    """Return a periodic field of unit variance whose amplitude spectrum falls as ``1 / f ** exponent``."""
    spectrum = np.fft.rfft2(rng.standard_normal((_BANK_SIZE, _BANK_SIZE)).astype(np.float32))
    frequency = np.hypot(np.fft.fftfreq(_BANK_SIZE)[:, None], np.fft.rfftfreq(_BANK_SIZE)[None, :])
    # Flat below four cycles per field, so that no window is all dark or all bright.
    spectrum /= np.maximum(frequency, 4 / _BANK_SIZE) ** exponent
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(_BANK_SIZE, _BANK_SIZE))
    return np.asarray(field / field.std(), np.float32)


def _window(field: F32Image, row: int, col: int, rows: int, cols: int) -> F32Image:
    """Return a (rows, cols) window of a periodic field; copied block by block, far faster than by wrapped indices."""
    out = np.empty((rows, cols), np.float32)
    y = 0
    while y < rows:
        top = (row + y) % _BANK_SIZE
        h = min(_BANK_SIZE - top, rows - y)
        x = 0
        while x < cols:
            left = (col + x) % _BANK_SIZE
            w = min(_BANK_SIZE - left, cols - x)
            out[y : y + h, x : x + w] = field[top : top + h, left : left + w]
            x += w
        y += h
    return out


class Painter:
    """A canvas in metres, (0, 0) at its top left, x to the right and y down.

    Parameters
    ----------
    rng : numpy Generator
    bank : NoiseBank
    size_m : (width, height)
    px_per_m : float

    Attributes
    ----------
    image : (H, W) float32
        Grey levels, nominally 0 to 255, clipped at the end.
    alpha : (H, W) uint8
        Opacity, 255 at first; only cut-out surfaces use it.
    """

    def __init__(self, rng: np.random.Generator, bank: NoiseBank, size_m: tuple[float, float], px_per_m: float) -> None:
        self.rng = rng
        self.size_m = size_m
        self.px_per_m = px_per_m
        self.bank = bank
        width = int(np.clip(round(size_m[0] * px_per_m), 4, 4096))
        height = int(np.clip(round(size_m[1] * px_per_m), 4, 4096))
        self.image: F32Image = np.zeros((height, width), np.float32)
        self.alpha = np.full((height, width), 255, np.uint8)

    def px(self, *lengths_m: float) -> tuple[int, ...]:
        """Return lengths or coordinates in whole pixels."""
        return tuple(round(float(a) * self.px_per_m) for a in lengths_m)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number; `low` where there is no room for one."""
        return float(low + max(high - low, 0.0) * self.rng.random())

    def chance(self, probability: float) -> bool:
        """Return True with the given probability."""
        return bool(self.rng.random() < probability)

    def noise(self, shape: tuple[int, int], smooth: bool = False, stretch: tuple[float, float] = (1, 1)) -> F32Image:
        """Return a window of fractal noise, unit variance, stretched by (horizontal, vertical) factors.

        Two fields are added with unrelated offsets, so that surfaces do not repeat each other nor themselves.
        """
        height, width = shape
        total = np.zeros(shape, np.float32)
        for field in self.bank.smooth if smooth else self.bank.rough:
            rows, cols = max(2, round(height / stretch[1])), max(2, round(width / stretch[0]))
            row, col = self.rng.integers(0, _BANK_SIZE, 2)
            turn, flip = self.rng.integers(0, 2, 2)
            window = (
                _window(field, int(row), int(col), cols, rows).T
                if turn
                else _window(field, int(row), int(col), rows, cols)
            )
            window = window[:, ::-1] if flip else window
            if (rows, cols) != shape:
                resized = cv2.resize(np.ascontiguousarray(window), (width, height), interpolation=cv2.INTER_LINEAR)
                window = np.asarray(resized, np.float32)
            total += np.float32(0.7071) * window
        return total

    def anchored_noise(self, x_px: int, y_px: int, smooth: bool = False) -> F32Image:
        """Return fractal noise for the whole canvas that continues that of a canvas at other (x, y): for tiles."""
        field = (self.bank.smooth if smooth else self.bank.rough)[0]
        return _window(field, y_px, x_px, *self.image.shape)

    def fill(self, level: float, rough: float = 0.0, smooth: float = 0.0) -> None:
        """Cover the canvas with a grey level and fractal noise of the given amplitudes."""
        self.image[:] = level
        self.add_noise(rough, smooth)

    def add_noise(self, rough: float, smooth: float = 0.0, stretch: tuple[float, float] = (1, 1)) -> None:
        """Add fractal noise to the whole canvas, amplitudes in grey levels."""
        if rough:
            self.image += rough * self.noise(self.image.shape, stretch=stretch)
        if smooth:
            self.image += smooth * self.noise(self.image.shape, smooth=True, stretch=stretch)

    def region(self, x: float, y: float, width: float, height: float) -> F32Image:
        """Return a view of the canvas inside a rectangle (may be empty)."""
        x0, y0, x1, y1 = self.px(x, y, x + width, y + height)
        return self.image[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)]

    def rect(self, x: float, y: float, width: float, height: float, level: float, noise: float = 0.0) -> None:
        """Fill a rectangle, optionally with fractal noise."""
        view = self.region(x, y, width, height)
        view[:] = level
        if noise and view.size:
            view += noise * self.noise(view.shape)

    def frame(self, x: float, y: float, width: float, height: float, border: float, level: float) -> None:
        """Draw the border of a rectangle, inside its outline."""
        for a, b, w, h in (
            (x, y, width, border),
            (x, y + height - border, width, border),
            (x, y, border, height),
            (x + width - border, y, border, height),
        ):
            self.region(a, b, w, h)[:] = level

    def line(self, points_m: NDArray[np.float64], level: float, width_m: float = 0.0) -> None:
        """Draw a polyline (N, 2)."""
        points = np.round(points_m * self.px_per_m).astype(np.int32)
        cv2.polylines(self.image, [points], False, float(level), max(1, self.px(width_m)[0]))

    def disc(self, x: float, y: float, radius: float, level: float) -> None:
        """Draw a filled circle."""
        cv2.circle(self.image, self.px(x, y), max(1, self.px(radius)[0]), float(level), -1)

    def glyphs(self, x: float, y: float, width: float, height: float, level: float, lines: int = 1) -> None:
        """Write rows of letter-like marks that fill a rectangle: the corners that signs, plates and books have."""
        row_height = height / lines
        for row in range(lines):
            letter_height = row_height * 0.72
            at, end = x, x + width * self.uniform(0.75, 1.0)
            while at + letter_height * 0.5 < end:
                letter_width = letter_height * self.uniform(0.4, 0.7)
                if not self.chance(0.12):
                    corners = self.rng.uniform(0, 1, (int(self.rng.integers(3, 6)), 2)).round(1)
                    corners = corners * (letter_width * 0.85, letter_height) + (at, y + row * row_height)
                    self.line(corners, level, letter_height * 0.14)
                at += letter_width * 1.15

    def bricks(self, brick_width: float, brick_height: float, contrast: float, mortar: float) -> None:
        """Add a running bond: each brick its own shade, `mortar` grey levels at the joints."""
        height, width = self.image.shape
        ys = np.arange(height) / self.px_per_m / brick_height
        row = ys.astype(np.int64)
        xs = np.arange(width)[None, :] / self.px_per_m / brick_width + 0.5 * (row % 2)[:, None]
        col = xs.astype(np.int64)
        shades = self.rng.normal(0, contrast, (int(row.max()) + 1, int(col.max()) + 1)).astype(np.float32)
        self.image += shades[row[:, None], col]
        joint = ((ys - row) < 0.14)[:, None] | ((xs - col) < 0.14 * brick_height / brick_width)
        self.image[joint] += np.float32(mortar)

    def crack(self, level: float, length_m: float) -> None:
        """Draw a random walk from a random place."""
        n = 14
        heading = self.uniform(0, 2 * np.pi) + np.cumsum(self.rng.normal(0, 0.6, n))
        steps = np.stack([np.cos(heading), np.sin(heading)], 1) * length_m / n
        start = self.rng.uniform(0, 1, 2) * self.size_m
        self.line(start + np.cumsum(steps, 0), level)

    def leaves(self, count: int, radius_m: tuple[float, float], levels: tuple[float, float], cut: bool = False) -> None:
        """Scatter leaf-like ellipses; with `cut`, they are what is opaque."""
        height, width = self.image.shape
        r_low, r_high = radius_m[0] * self.px_per_m, radius_m[1] * self.px_per_m
        if cut:
            # Thicker in the middle of the card: a twig with its leaves, not a rectangle of confetti.
            centres = np.clip(self.rng.normal(0.5, 0.2, (count, 2)), 0.06, 0.94)
        else:
            centres = self.rng.uniform(0, 1, (count, 2))
        radii, turns = self.rng.uniform(r_low, r_high, count), self.rng.uniform(0, 180, count)
        shades = self.rng.uniform(*levels, count)
        for (cx, cy), radius, turn, shade in zip(centres, radii, turns, shades, strict=True):
            middle = (int(cx * width), int(cy * height))
            axes = (max(1, int(radius)), max(1, int(radius * 0.55)))
            cv2.ellipse(self.image, middle, axes, float(turn), 0, 360, float(shade), -1)
            if cut:
                cv2.ellipse(self.alpha, middle, axes, float(turn), 0, 360, 255, -1)

    def finish(self, shade: float) -> NDArray[np.uint8]:
        """Return the canvas as grey levels under the given light."""
        return np.asarray(np.clip(self.image * np.float32(shade), 0, 255), np.uint8)
