"""Materials of the street's surfaces: each function paints one kind on a `Painter`, new each time."""

from __future__ import annotations

import cv2
import numpy as np

from dualslam.lab.synthetic.painter import Painter


def facade(p: Painter) -> None:
    """A front of a house: brick, plaster or panels, rows of windows, a ground floor with doors, shops and signs."""
    width, height = p.size_m
    masonry(p)
    storey = p.uniform(2.7, 3.4)
    n_storeys = max(1, int((height - 0.4) / storey))
    base = height - n_storeys * storey
    for i in range(n_storeys + 1):
        if p.chance(0.5):
            p.rect(0, base + i * storey - 0.1, width, 0.14, p.uniform(60, 210), 6)
    n_columns = max(1, int(width / p.uniform(1.9, 3.0)))
    pitch = width / n_columns
    window_width, window_height = pitch * p.uniform(0.42, 0.62), storey * p.uniform(0.45, 0.6)
    frame_level, arched = p.uniform(30, 245), p.chance(0.3)
    for floor in range(n_storeys - 1):
        for column in range(n_columns):
            if p.chance(0.06):
                continue
            x = column * pitch + (pitch - window_width) / 2
            y = base + floor * storey + (storey - window_height) * 0.45
            window(p, x, y, window_width, window_height, frame_level)
            if arched:
                p.rect(x - 0.1, y - 0.25, window_width + 0.2, 0.16, frame_level * 0.8, 8)
    _ground_floor(p, base + (n_storeys - 1) * storey, storey, pitch, n_columns, frame_level)
    _weather(p)


def masonry(p: Painter) -> None:
    """A bare wall."""
    level, style = p.uniform(55, 215), p.rng.integers(0, 4)
    p.fill(level, rough=5, smooth=9)
    if style == 0:
        p.bricks(0.24, 0.075, p.uniform(8, 20), p.uniform(15, 45))
    elif style == 1:
        p.bricks(p.uniform(0.5, 0.9), p.uniform(0.25, 0.4), p.uniform(5, 14), -p.uniform(15, 45))
    elif style == 2:
        p.bricks(p.uniform(1.0, 2.4), p.uniform(0.15, 0.3), p.uniform(3, 8), -p.uniform(20, 40))
    else:
        p.add_noise(9)


def gable(p: Painter) -> None:
    """A side wall: masonry with few windows, an old advertisement or graffiti."""
    width, height = p.size_m
    masonry(p)
    for _ in range(int(p.rng.integers(0, 5))):
        window(p, p.uniform(0.3, width - 1.4), p.uniform(0.5, height - 2), 0.9, 1.2, p.uniform(60, 240))
    if p.chance(0.4) and width > 4:
        w, h = p.uniform(2, width * 0.7), p.uniform(1, 2.5)
        x, y = p.uniform(0.2, width - w - 0.2), p.uniform(0.5, max(0.6, height - h - 2))
        p.rect(x, y, w, h, p.uniform(30, 230), 10)
        p.glyphs(x + 0.2, y + 0.15, w - 0.4, h - 0.2, p.uniform(0, 255), int(p.rng.integers(1, 4)))
    _weather(p)


def window(p: Painter, x: float, y: float, width: float, height: float, frame_level: float) -> None:
    """One window: surround, dark glass with reflections, curtains or blinds, bars, the sill and its shadow."""
    p.rect(x - 0.09, y - 0.09, width + 0.18, height + 0.18, frame_level, 4)
    glass = p.region(x, y, width, height)
    if glass.size == 0:
        return
    fall = np.linspace(p.uniform(-30, 30), p.uniform(-30, 30), glass.shape[0], dtype=np.float32)
    glass[:] = p.uniform(25, 95) + fall[:, None] + 22 * p.noise(glass.shape, smooth=True)
    kind = p.rng.random()
    if kind < 0.3:
        side = width * p.uniform(0.12, 0.3)
        for at in (x, x + width - side):
            curtain = p.region(at, y, side, height)
            curtain[:] = p.uniform(120, 220) + 20 * np.sin(np.arange(curtain.shape[1]) * 1.9)[None, :]
    elif kind < 0.5:
        drop = height * p.uniform(0.2, 0.9)
        blind = p.region(x, y, width, drop)
        blind[:] = p.uniform(110, 210) + 14 * np.sin(np.arange(blind.shape[0]) * 1.3)[:, None]
    p.frame(x, y, width, height, 0.06, frame_level * p.uniform(0.75, 1.0))
    p.rect(x + width * p.uniform(0.4, 0.6), y, 0.05, height, frame_level * 0.9)
    if p.chance(0.6):
        p.rect(x, y + height * p.uniform(0.25, 0.55), width, 0.05, frame_level * 0.9)
    p.rect(x, y, width, 0.05, 20)
    p.rect(x - 0.12, y + height + 0.06, width + 0.24, 0.08, p.uniform(150, 240))
    p.rect(x - 0.1, y + height + 0.14, width + 0.2, 0.06, p.uniform(20, 60))


def _ground_floor(p: Painter, y: float, storey: float, pitch: float, n_columns: int, frame_level: float) -> None:
    """Doors, shop windows with goods and a sign, garages."""
    shop = p.chance(0.45)
    if shop:
        p.rect(0, y, p.size_m[0], storey, p.uniform(40, 200), 8)
        x, w = p.uniform(0, 0.8), p.size_m[0] - p.uniform(0.8, 2)
        p.rect(x, y + 0.1, w, 0.65, p.uniform(20, 240), 5)
        p.glyphs(x + 0.3, y + 0.18, w - 0.6, 0.5, p.uniform(0, 255))
    for column in range(n_columns):
        x = column * pitch
        kind = p.rng.random()
        if kind < 0.3:
            w, h = min(1.1, pitch * 0.6), 2.15
            top = y + storey - h
            p.rect(x + 0.3, top, w, h, p.uniform(20, 160), 8)
            p.frame(x + 0.3, top, w, h, 0.09, p.uniform(120, 240))
            for panel in range(3):
                p.frame(x + 0.45, top + 0.2 + panel * 0.62, w - 0.3, 0.5, 0.04, p.uniform(10, 200))
            p.disc(x + 0.3 + w * 0.85, top + 1.1, 0.05, 230)
            p.rect(x + 0.5 + w, top + 0.5, 0.18, 0.14, 235)
            p.glyphs(x + 0.51 + w, top + 0.52, 0.15, 0.1, 20)
        elif shop:
            view = p.region(x + 0.15, y + 0.9, pitch - 0.3, storey - 1.3)
            if view.size:
                view[:] = p.uniform(20, 90) + 30 * p.noise(view.shape)
                for _ in range(12):
                    gx, gy = x + p.uniform(0.2, pitch - 0.5), y + p.uniform(1, storey - 0.8)
                    p.rect(gx, gy, p.uniform(0.08, 0.4), p.uniform(0.1, 0.5), p.uniform(10, 250), 12)
                p.frame(x + 0.15, y + 0.9, pitch - 0.3, storey - 1.3, 0.07, frame_level)
        elif kind < 0.85:
            window(p, x + pitch * 0.25, y + 0.8, pitch * 0.5, storey * 0.5, frame_level)
        else:
            p.rect(x + 0.1, y + 0.5, pitch - 0.2, storey - 0.5, p.uniform(70, 200), 5)
            for k in range(6):
                p.rect(x + 0.1, y + 0.5 + k * (storey - 0.5) / 6, pitch - 0.2, 0.04, p.uniform(20, 90))


def _weather(p: Painter) -> None:
    """Rain streaks, cracks, a drain pipe, graffiti, dirt at the foot."""
    width, height = p.size_m
    p.add_noise(5, stretch=(1, 8))
    for _ in range(int(p.rng.integers(2, 7))):
        p.crack(p.uniform(20, 90), p.uniform(0.6, 2.5))
    if p.chance(0.6):
        x = p.uniform(0.1, width - 0.3)
        p.rect(x, 0, 0.11, height, p.uniform(50, 200), 6)
        p.rect(x + 0.11, 0, 0.05, height, 35)
    if p.chance(0.5):
        start = np.array([p.uniform(0.3, max(0.4, width - 2.5)), height - p.uniform(0.8, 1.8)])
        points = start + np.cumsum(p.rng.normal(0, 0.22, (18, 2)) + (0.05, 0), 0)
        p.line(points, p.uniform(0, 255), 0.06)
    rows = max(1, p.px(0.6)[0])
    p.image[-rows:] -= np.linspace(0, 40, min(rows, len(p.image)), dtype=np.float32)[:, None]


def roof(p: Painter) -> None:
    """Tiles, a dormer or skylights, moss."""
    p.fill(p.uniform(50, 120), rough=7, smooth=8)
    p.bricks(0.3, 0.33, p.uniform(6, 14), -p.uniform(20, 40))
    for _ in range(int(p.rng.integers(0, 4))):
        x, y = p.uniform(0, p.size_m[0] - 1), p.uniform(0.4, max(0.5, p.size_m[1] - 1.4))
        p.rect(x, y, 0.8, 1.1, p.uniform(20, 80), 15)
        p.frame(x, y, 0.8, 1.1, 0.08, p.uniform(100, 220))


def plain(p: Painter) -> None:
    """Painted metal or wood with wear."""
    p.fill(p.uniform(50, 200), rough=7, smooth=7)
    for _ in range(3):
        p.crack(p.uniform(10, 240), 0.5)


def panel(p: Painter) -> None:
    """A sign, poster or notice: a border and writing."""
    width, height = p.size_m
    back = p.uniform(10, 245)
    ink = back - 150 if back > 128 else back + 150
    p.fill(back, rough=4, smooth=4)
    p.frame(0, 0, width, height, min(width, height) * 0.08, ink)
    lines = max(1, round(height / width * p.uniform(1.2, 3)))
    p.glyphs(width * 0.16, height * 0.16, width * 0.72, height * 0.72, ink, lines)
    if p.chance(0.5):
        p.disc(p.uniform(0.2, 0.8) * width, p.uniform(0.2, 0.8) * height, min(width, height) * 0.15, p.uniform(0, 255))


def round_sign(p: Painter) -> None:
    """A round traffic sign (cut out)."""
    radius = p.size_m[0] / 2
    p.fill(225, rough=3)
    p.alpha[:] = 0
    cv2.circle(p.alpha, p.px(radius, radius), p.px(radius * 0.97)[0], 255, -1)
    p.disc(radius, radius, radius * 0.97, p.uniform(40, 90))
    p.disc(radius, radius, radius * 0.74, 235)
    p.glyphs(radius * 0.55, radius * 0.65, radius, radius * 0.7, 15)


def bark(p: Painter) -> None:
    """A trunk."""
    p.fill(p.uniform(50, 95), smooth=8)
    p.add_noise(18, stretch=(1, 5))


def twigs(p: Painter) -> None:
    """A card of leaves (cut out)."""
    p.fill(35, rough=12)
    p.alpha[:] = 0
    dark = p.uniform(15, 40)
    p.leaves(230, (0.05, 0.13), (dark, dark + 60), cut=True)
    p.leaves(230, (0.03, 0.08), (dark + 20, dark + 190), cut=True)


def hedge(p: Painter) -> None:
    """Leaves without holes."""
    p.fill(40, rough=18, smooth=10)
    count = int(min(1500, 150 * p.size_m[0] * p.size_m[1]))
    p.leaves(count, (0.03, 0.09), (10, 170))


def pickets(p: Painter) -> None:
    """A fence of boards (cut out)."""
    width, height = p.size_m
    p.fill(p.uniform(60, 190), rough=9)
    p.alpha[:] = 0
    pitch, x = p.uniform(0.14, 0.24), 0.0
    while x < width:
        view = p.region(x, 0, pitch * 0.65, height)
        view += p.uniform(-25, 25)
        x0, x1, top = *p.px(x, x + pitch * 0.65), p.px(p.uniform(0, 0.06))[0]
        p.alpha[top:, x0:x1] = 255
        x += pitch
    for y in (0.2, height - 0.3):
        y0, y1 = p.px(y, y + 0.09)
        p.alpha[y0:y1] = 255
        p.rect(0, y, width, 0.025, 35)


def car_side(p: Painter) -> None:
    """The flank of a parked car: paint, door lines, wheels, the shadow below."""
    width, height = p.size_m
    p.fill(p.uniform(25, 215), rough=2, smooth=10)
    p.image += np.linspace(25, -25, p.image.shape[0], dtype=np.float32)[:, None]
    for x in (0.36, 0.58, 0.76):
        p.rect(width * x, 0, 0.025, height * 0.8, 15)
        p.rect(width * x - 0.25, height * 0.2, 0.17, 0.04, 200)
    p.rect(0, height * 0.45, width, 0.03, p.uniform(10, 230))
    p.rect(0, height * 0.82, width, height * 0.2, 15)
    for x in (0.19, 0.8):
        p.disc(width * x, height * 0.78, 0.33, 12)
        p.disc(width * x, height * 0.78, 0.2, p.uniform(120, 210))
        for angle in np.arange(5) * 2 * np.pi / 5:
            tip = 0.18 * np.array([np.cos(angle), np.sin(angle)])
            p.line(np.array([[0, 0], tip]) + (width * x, height * 0.78), 30, 0.04)


def car_end(p: Painter) -> None:
    """The front or back of a parked car: lamps, grille, plate."""
    width, height = p.size_m
    p.fill(p.uniform(30, 200), rough=3, smooth=8)
    p.rect(0, height * 0.7, width, height * 0.3, 18, 5)
    for x in (0.05, width - 0.4):
        p.rect(x, height * 0.2, 0.35, 0.2, 235, 15)
        p.frame(x, height * 0.2, 0.35, 0.2, 0.04, 30)
    p.rect(width / 2 - 0.3, height * 0.52, 0.6, 0.15, 235)
    p.glyphs(width / 2 - 0.26, height * 0.53, 0.52, 0.12, 15)
    for k in range(5):
        p.rect(width * 0.3, height * (0.18 + 0.06 * k), width * 0.4, 0.025, 20)


def car_glass(p: Painter) -> None:
    """Windows of a car with reflections and pillars."""
    width, height = p.size_m
    p.fill(p.uniform(25, 70))
    p.add_noise(8, 26)
    p.frame(0, 0, width, height, 0.08, p.uniform(20, 200))
    p.rect(width * p.uniform(0.4, 0.6), 0, 0.09, height, p.uniform(15, 60))


def clouds(p: Painter) -> None:
    """The sky overhead."""
    noise = p.noise(p.image.shape, smooth=True)
    p.image[:] = 222 + 26 * np.tanh(1.4 * noise) + 3 * p.noise(p.image.shape)


def skyline(p: Painter) -> None:
    """Wooded hills at the horizon (cut out)."""
    height, width = p.image.shape
    p.fill(105, rough=14, smooth=12)
    p.image += np.linspace(25, -15, height, dtype=np.float32)[:, None]
    ridge = p.noise((8, width), smooth=True)[0] * 0.14 + p.noise((8, width))[0] * 0.03
    top = (np.clip(0.45 + ridge, 0.05, 0.9) * height).astype(np.int64)
    p.alpha[:] = np.where(np.arange(height)[:, None] > top[None, :], 255, 0).astype(np.uint8)
