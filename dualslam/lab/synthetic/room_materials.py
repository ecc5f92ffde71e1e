"""Materials of the room's surfaces: each function paints one kind on a `Painter`, new each time."""

from __future__ import annotations

import cv2
import numpy as np

from dualslam.lab.synthetic.painter import Painter


def plaster(p: Painter) -> None:
    """A painted wall: nearly blank, with stains, sockets, a skirting board and notes pinned to it."""
    width, height = p.size_m
    p.fill(p.uniform(110, 175), rough=1.2, smooth=5)
    p.image += np.linspace(8, -14, p.image.shape[0], dtype=np.float32)[:, None]
    for _ in range(int(p.rng.integers(3, 8))):
        p.crack(p.uniform(90, 140), p.uniform(0.1, 0.5))
    p.rect(0, height - 0.1, width, 0.1, p.uniform(60, 220), 5)
    p.rect(0, height - 0.11, width, 0.012, 50)
    for _ in range(int(width * 1.2)):
        x, y = p.uniform(0.1, width - 0.4), p.uniform(0.4, height - 0.5)
        w, h = p.uniform(0.06, 0.3), p.uniform(0.08, 0.3)
        _paper(p, x, y, w, h)
    for _ in range(2):
        x, y = p.uniform(0.1, width - 0.3), height - p.uniform(0.25, 0.35)
        p.rect(x, y, 0.16, 0.085, 235)
        p.frame(x, y, 0.16, 0.085, 0.006, 110)
        for k in (0.04, 0.12):
            p.disc(x + k, y + 0.042, 0.028, 190)
            p.disc(x + k - 0.01, y + 0.042, 0.004, 20)
            p.disc(x + k + 0.01, y + 0.042, 0.004, 20)


def _paper(p: Painter, x: float, y: float, w: float, h: float) -> None:
    """A note or cutting with writing and a picture."""
    level = p.uniform(170, 250)
    p.rect(x + 0.01, y + 0.012, w, h, 90)
    p.rect(x, y, w, h, level, 3)
    p.glyphs(x + w * 0.1, y + h * 0.08, w * 0.8, h * 0.5, p.uniform(10, 80), max(2, int(h / 0.025)))
    if p.chance(0.6):
        p.rect(x + w * 0.1, y + h * 0.62, w * 0.8, h * 0.3, p.uniform(40, 180), 35)


def tiles(p: Painter) -> None:
    """A tiled wall."""
    p.fill(p.uniform(120, 190), rough=3, smooth=6)
    size = p.uniform(0.1, 0.16)
    p.bricks(size, size, p.uniform(1, 4), -p.uniform(10, 25))
    for _ in range(5):
        x, y = p.uniform(0, p.size_m[0] - 0.4), p.uniform(0, p.size_m[1] - 0.4)
        _paper(p, x, y, p.uniform(0.1, 0.3), p.uniform(0.12, 0.35))


def boards(p: Painter) -> None:
    """A floor of wooden boards."""
    p.fill(p.uniform(55, 140), smooth=7)
    p.add_noise(6, stretch=(9, 1))
    p.bricks(1.3, 0.13, 7, -20)
    for _ in range(60):
        p.disc(p.uniform(0, p.size_m[0]), p.uniform(0, p.size_m[1]), p.uniform(0.004, 0.015), p.uniform(30, 70))


def carpet(p: Painter) -> None:
    """A woven carpet: nested borders with ornaments."""
    width, height = p.size_m
    p.fill(p.uniform(70, 150), rough=13)
    for k in range(4):
        inset = 0.05 + k * 0.13
        p.frame(inset, inset, width - 2 * inset, height - 2 * inset, 0.04, p.uniform(30, 220))
    for _ in range(int(30 * width * height)):
        x, y, r = p.uniform(0.1, width - 0.1), p.uniform(0.1, height - 0.1), p.uniform(0.015, 0.06)
        corners = np.array([[-1, 0], [0, -1], [1, 0], [0, 1]]) * r + (x, y)
        cv2.fillConvexPoly(p.image, np.round(corners * p.px_per_m).astype(np.int32), p.uniform(20, 230))
    p.add_noise(9)


def ceiling(p: Painter) -> None:
    """A pale ceiling with panels and lamps."""
    p.fill(225, rough=1, smooth=5)
    p.bricks(0.62, 0.62, 3, -28)
    for _ in range(4):
        x, y = p.uniform(0.3, p.size_m[0] - 1), p.uniform(0.3, p.size_m[1] - 1)
        p.rect(x, y, 0.6, 0.6, 252)
        p.frame(x, y, 0.6, 0.6, 0.03, 120)


def wood(p: Painter) -> None:
    """Veneer or a table top, with scratches and rings of cups."""
    p.fill(p.uniform(30, 215), smooth=8)
    p.add_noise(7, 4, stretch=(7, 1))
    for _ in range(4):
        p.crack(p.uniform(40, 200), p.uniform(0.05, 0.3))


def table_top(p: Painter) -> None:
    """Wood with papers, magazines and things lying on it."""
    wood(p)
    width, height = p.size_m
    for _ in range(int(7 * width * height) + 3):
        clutter(p, p.uniform(0.15, width - 0.15), p.uniform(0.15, height - 0.15))


def clutter(p: Painter, x: float, y: float) -> None:
    """A sheet or magazine, turned at random, with writing and pictures."""
    sheet = Painter(p.rng, p.bank, (p.uniform(0.12, 0.3), p.uniform(0.15, 0.3)), p.px_per_m)
    picture(sheet) if p.chance(0.4) else _page(sheet)
    h, w = sheet.image.shape
    middle = np.array([x, y]) * p.px_per_m
    M = cv2.getRotationMatrix2D((w / 2, h / 2), p.uniform(0, 360), 1.0)
    M[:, 2] += middle - (w / 2, h / 2)
    size = (p.image.shape[1], p.image.shape[0])
    reach = int(np.hypot(h, w)) // 2 + 2
    mask = cv2.warpAffine(np.full((h, w), 255, np.uint8), M, size)
    turned = cv2.warpAffine(sheet.image, M, size)
    rows, cols = (slice(max(0, int(c) - reach), int(c) + reach) for c in middle[::-1])
    view = p.image[rows, cols]
    view[:] = np.where(mask[rows, cols] > 127, turned[rows, cols], view)


def _page(p: Painter) -> None:
    """A printed page."""
    p.fill(p.uniform(190, 245), rough=2)
    w, h = p.size_m
    p.glyphs(w * 0.1, h * 0.06, w * 0.8, h * 0.12, 25)
    p.glyphs(w * 0.1, h * 0.25, w * 0.8, h * 0.7, p.uniform(20, 70), max(4, int(h / 0.022)))


def picture(p: Painter) -> None:
    """A framed painting or poster."""
    width, height = p.size_m
    p.fill(p.uniform(60, 190), rough=12, smooth=28)
    for _ in range(int(p.rng.integers(6, 16))):
        corners = p.rng.uniform(0, 1, (int(p.rng.integers(3, 6)), 2)) * p.size_m
        hull = cv2.convexHull(np.round(corners * p.px_per_m).astype(np.int32))
        level = p.uniform(10, 245)
        if p.chance(0.4):
            p.disc(corners[0, 0], corners[0, 1], p.uniform(0.03, 0.2) * width, level)
        else:
            cv2.fillConvexPoly(p.image, hull, level)
    p.add_noise(8)
    if p.chance(0.5):
        p.glyphs(width * 0.15, height * 0.75, width * 0.7, height * 0.15, p.uniform(0, 255), 2)
    border = min(width, height) * 0.06
    p.frame(0, 0, width, height, border, p.uniform(15, 235))
    p.frame(border, border, width - 2 * border, height - 2 * border, border * 0.2, 30)


def books(p: Painter) -> None:
    """A shelf seen from the front: rows of spines with titles, gaps and things between."""
    width, height = p.size_m
    p.fill(p.uniform(30, 60), rough=5, smooth=5)
    n_rows = max(1, round(height / 0.34))
    pitch, board = height / n_rows, p.uniform(70, 190)
    for row in range(n_rows):
        bottom, x = (row + 1) * pitch - 0.02, 0.02
        while x < width - 0.05:
            w, h = p.uniform(0.015, 0.055), pitch * p.uniform(0.55, 0.88)
            if p.chance(0.06):
                x += p.uniform(0.05, 0.15)
                continue
            level = p.uniform(25, 230)
            p.rect(x, bottom - h, w, h, level, 5)
            ink = level + 110 if level < 128 else level - 110
            p.rect(x, bottom - h * p.uniform(0.8, 0.95), w, 0.012, ink)
            p.glyphs(x + w * 0.15, bottom - h * 0.75, w * 0.7, h * 0.55, ink, max(2, int(h / max(w, 0.02))))
            p.rect(x + w - 0.003, bottom - h, 0.003, h, 12)
            x += w
        p.rect(0, bottom, width, 0.025, board, 6)
    p.frame(0, 0, width, height, 0.025, board)


def cupboard(p: Painter) -> None:
    """Doors and drawers with handles."""
    wood(p)
    width, height = p.size_m
    columns = max(1, round(width / p.uniform(0.4, 0.6)))
    for column in range(columns):
        x, w = column * width / columns, width / columns
        rows = int(p.rng.integers(1, 4))
        for row in range(rows):
            y, h = row * height / rows, height / rows
            p.region(x, y, w, h)[:] += p.uniform(-10, 10)
            p.frame(x, y, w, h, 0.006, 20)
            p.rect(x + w * 0.35, y + 0.06, w * 0.3, 0.014, 225)
            p.rect(x + w * 0.35, y + 0.074, w * 0.3, 0.008, 25)


def appliance(p: Painter) -> None:
    """A machine's front: screen, buttons, label."""
    width, height = p.size_m
    p.fill(p.uniform(40, 210), rough=2, smooth=6)
    p.frame(0, 0, width, height, 0.008, 20)
    p.rect(width * 0.1, height * 0.12, width * 0.8, height * 0.5, p.uniform(10, 50), 14)
    p.glyphs(width * 0.15, height * 0.16, width * 0.6, height * 0.2, p.uniform(150, 250), 2)
    for k in range(6):
        p.disc(width * (0.15 + 0.14 * k), height * 0.78, min(width, height) * 0.04, p.uniform(0, 255))


def carton(p: Painter) -> None:
    """A packet or box with a printed side."""
    p.fill(p.uniform(40, 225), rough=3, smooth=5)
    w, h = p.size_m
    p.rect(0, h * p.uniform(0, 0.6), w, h * p.uniform(0.1, 0.35), p.uniform(20, 240), 8)
    p.glyphs(w * 0.1, h * 0.1, w * 0.8, h * 0.35, p.uniform(0, 255), int(p.rng.integers(1, 3)))
    p.glyphs(w * 0.1, h * 0.6, w * 0.8, h * 0.3, p.uniform(0, 255), int(p.rng.integers(2, 6)))
    p.frame(0, 0, w, h, min(w, h) * 0.03, p.uniform(0, 255))


def outdoors(p: Painter) -> None:
    """A window with the view outside, its frame and bars."""
    width, height = p.size_m
    p.fill(215, smooth=14)
    lower = p.region(0, height * 0.55, width, height)
    lower[:] = 120 + 32 * p.noise(lower.shape)
    p.frame(0, 0, width, height, 0.07, 238)
    p.rect(width / 2 - 0.035, 0, 0.07, height, 238)
    p.frame(0.07, 0.07, width - 0.14, height - 0.14, 0.012, 90)
    p.rect(width / 2 - 0.045, 0, 0.01, height, 90)
    p.rect(width / 2 + 0.035, 0, 0.01, height, 90)


def door(p: Painter) -> None:
    """A panelled door in its frame."""
    wood(p)
    width, height = p.size_m
    p.frame(0, 0, width, height, 0.07, p.uniform(180, 235))
    for row in range(3):
        for column in range(2):
            x, y = 0.14 + column * (width - 0.2) / 2, 0.15 + row * (height - 0.2) / 3
            p.frame(x, y, (width - 0.4) / 2, (height - 0.6) / 3, 0.02, 40)
            p.frame(x + 0.02, y + 0.02, (width - 0.48) / 2, (height - 0.75) / 3, 0.01, 190)
    p.rect(width - 0.2, height * 0.5, 0.11, 0.025, 235)
    p.disc(width - 0.11, height * 0.5 + 0.01, 0.03, 60)
