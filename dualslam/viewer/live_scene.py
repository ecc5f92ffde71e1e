"""Scene of the live view: submaps, links, camera and frame statuses, as arrays in one world.

Linked sets of submaps stand in one frame. An unlinked one stands beside them, in a unit of its own, until a link takes
it in. Knows no viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray, FrameStatus
from dualslam.viewer.colours import CONDEMNED_COLOUR, STATUS_COLOURS, rgb, submap_rgb
from dualslam.viewer.messages import LinkLine, Message, Picture, SubmapArrays, Walk

FRUSTUM = np.array([[-1, -0.75, 1], [1, -0.75, 1], [1, 0.75, 1], [-1, 0.75, 1]]) * (0.5, 0.5, 0.6)
"""Corners of the image of a drawn keyframe of size 1; x right, y down, z forward."""
FRUSTUM_SHARE = 0.02
"""Size of a drawn keyframe, of the way's extent."""
GAP_SHARE = 0.35
"""Between sets of submaps that are not linked, of the extent of the first."""
WITHIN = 0.97
"""Landmarks further out are far away, or wrong: the view need not hold them."""
RIGHT = np.array([1.0, 0.0, 0.0])
DOWN, AHEAD = np.array([[0.0, 0.81, -0.59], [0.0, 0.59, 0.81]])
"""The axes of a window onto the whole map, from behind and above its first camera."""
FILLED = 0.85
"""Of such a window, by the map."""
FOV_RAD, ASPECT = np.radians(75.0), 1.5
"""Of a window that is not known: a page that is saved."""
LEAST_EXTENT = 2.0
"""A map's first landmarks are about 1 away."""
TIMELINE_PX = (480, 28)
MARK_PX, MARK_RGB = 2, (255, 255, 255)
"""Half the width of the mark at the frame where reverse tracking is."""
FEATURE_RGB, MATCHED_RGB = (150, 150, 150), (60, 220, 90)


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A submap as it is drawn."""

    lines: NDArray[np.float32]  # (N, 2, 3): its keyframes as pyramids, and the way between them
    line_rgb: NDArray[np.uint8]  # (N, 2, 3)
    points: NDArray[np.float32]  # (L, 3)
    centres: FloatArray  # (K, 3)


@dataclass(frozen=True, slots=True, eq=False)
class DrawnWalk:
    """Reverse tracking that is under way."""

    submap_id: int
    way: NDArray[np.float32]  # (N, 3): the earliest frame first
    T_world_cam: FloatArray | None  # (4, 4): of the last frame that has a pose
    is_posed: bool  # whether that is the frame at which the walk is
    place: int | None  # of that frame among the statuses
    words: str


class LiveScene:
    """A run as its messages tell it.

    - `stale`: submaps that were drawn anew since this was last emptied.
    - `S_world` dict of int to (4, 4).
    - `size`: of a keyframe as it is drawn.
    - `T_world_cam` (4, 4) or None: the newest camera that has a pose.
    """

    def __init__(self) -> None:
        self.drawn: dict[int, Drawn] = {}
        self.stale: set[int] = set()
        self.S_world: dict[int, FloatArray] = {}
        self.T_world_cam: FloatArray | None = None
        self.links: tuple[LinkLine, ...] = ()
        self.walks: tuple[DrawnWalk, ...] = ()
        self.statuses: list[str] = []
        self._arrays: dict[int, SubmapArrays] = {}
        self.size = 0.0

    def take(self, message: Message) -> None:
        """Follow a run by one message."""
        self.statuses[message.n_statuses_before :] = message.statuses
        self.links = message.links
        for arrays in message.changed:
            self._arrays[arrays.submap_id] = arrays
        S_world = self._place(message.components)
        grown = self._keyframe_size(S_world)
        for m, S in S_world.items():
            moved = m not in self.S_world or not np.array_equal(S, self.S_world[m])
            if moved or grown or any(arrays.submap_id == m for arrays in message.changed):
                self.drawn[m] = self._draw(self._arrays[m], S)
                self.stale.add(m)
        self.S_world = S_world
        if message.T_submap_cam is not None and message.submap_id in S_world:
            self.T_world_cam = sim3.act_on_pose(S_world[message.submap_id], message.T_submap_cam)
        self.walks = tuple(
            _drawn_walk(w, S_world[w.news.submap_id]) for w in message.walks if w.news.submap_id in S_world
        )

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the box around all cameras, and landmarks but for the `1 - WITHIN` furthest out on each side."""
        centres = [d.centres for d in self.drawn.values()] + [walk.way for walk in self.walks]
        centres = [each for each in centres if len(each)]
        if not centres:
            return np.full(3, -1.0), np.full(3, 1.0)
        cameras = np.concatenate(centres).astype(np.float64)
        low, high = cameras.min(axis=0), cameras.max(axis=0)
        landmarks = np.concatenate([d.points for d in self.drawn.values()]).astype(np.float64)
        if len(landmarks):
            inner = np.quantile(landmarks, [1 - WITHIN, WITHIN], axis=0)
            low, high = np.minimum(low, inner[0]), np.maximum(high, inner[1])
        return np.asarray(low), np.asarray(high)

    @property
    def extent(self) -> float:
        """How large the map is."""
        low, high = self.bounds()
        return max(float(np.linalg.norm(high - low)), LEAST_EXTENT)

    def viewpoint(
        self, fov_rad: float = FOV_RAD, aspect: float = ASPECT, covered: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return what to look at, and from where, so that the box around the map fills what of a window is not covered.

        - `fov_rad`: from the upper rim to the lower one.
        - `aspect`: width over height.
        - `covered`: share of the height, at the lower rim.
        """
        low, high = self.bounds()
        middle, half = (low + high) / 2, np.maximum(high - low, LEAST_EXTENT / 2) / 2
        corners = half * np.array(list(product((-1, 1), repeat=3)))
        slope = np.tan(fov_rad / 2)
        across = np.abs(corners @ RIGHT) / (FILLED * slope * aspect)
        along = np.abs(corners @ DOWN) / (FILLED * slope * (1.0 - covered))
        distance = float((np.maximum(across, along) - corners @ AHEAD).max())
        look_at = middle + covered * slope * distance * DOWN
        return look_at, look_at - distance * AHEAD

    def walk_lines(self) -> NDArray[np.float32]:
        """Return the ways of the reverse tracking that is under way as lines, (N, 2, 3)."""
        lines = [np.stack([walk.way[:-1], walk.way[1:]], axis=1) for walk in self.walks]
        return np.concatenate(lines) if lines else np.zeros((0, 2, 3), np.float32)

    def link_lines(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the links as lines between keyframes, (N, 2, 3), and their colours, (N, 2, 3)."""
        ends, colours = [], []
        for link in self.links:
            if link.a in self.drawn and link.b in self.drawn:
                ends.append([self._centre(link.a, link.kf_a), self._centre(link.b, link.kf_b)])
                colour = STATUS_COLOURS[FrameStatus.LOST if link.rejected else FrameStatus.RECOVERED]
                colours.append([rgb(colour)] * 2)
        if not ends:
            return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
        return np.array(ends, np.float32), np.array(colours, np.uint8)

    def _centre(self, submap_id: int, kf: int) -> FloatArray:
        arrays = self._arrays[submap_id]
        at = min(int(np.searchsorted(arrays.kf, kf)), len(arrays.kf) - 1)
        centre: FloatArray = self.drawn[submap_id].centres[at]
        return centre

    def _place(self, components: Sequence[dict[int, FloatArray]]) -> dict[int, FloatArray]:
        """Return where submaps stand: the first linked set in its own frame, each other one to the right of it."""
        placed: dict[int, FloatArray] = {}
        right, gap = 0.0, 0.0
        for i, component in enumerate(components):
            known = {m: S for m, S in component.items() if m in self._arrays}
            if not known:
                continue
            x = np.concatenate([sim3.act(S, self._arrays[m].T_submap_kf[:, :3, 3])[:, 0] for m, S in known.items()])
            shift = np.eye(4)
            if i and placed:
                shift[0, 3] = right + gap - x.min()
            else:
                gap = max(GAP_SHARE * float(np.ptp(x)), 1.0)
            right = max(right, float(x.max()) + shift[0, 3])
            placed |= {m: shift @ S for m, S in known.items()}
        return placed

    def _keyframe_size(self, S_world: dict[int, FloatArray]) -> bool:
        """Let drawn keyframes grow with the way; return whether they did."""
        centres = [sim3.act(S, self._arrays[m].T_submap_kf[:, :3, 3]) for m, S in S_world.items()]
        if not centres:
            return False
        extent = float(np.linalg.norm(np.ptp(np.concatenate(centres), axis=0)))
        wanted = max(FRUSTUM_SHARE * extent, 0.02)
        if 0.67 * wanted <= self.size <= 1.5 * wanted:
            return False  # all that is drawn is sent anew: not for every step
        self.size = wanted
        return True

    def _draw(self, arrays: SubmapArrays, S: FloatArray) -> Drawn:
        T = np.array([sim3.act_on_pose(S, T) for T in arrays.T_submap_kf.astype(float)]).reshape(-1, 4, 4)
        centres = T[:, :3, 3]
        corners = centres[:, None] + np.einsum("kij,cj->kci", T[:, :3, :3], FRUSTUM * self.size)
        sides = np.stack([np.broadcast_to(centres[:, None], corners.shape), corners], axis=2)
        rims = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
        pyramids = np.concatenate([sides, rims], axis=1)  # (K, 8, 2, 3)
        way = np.stack([centres[:-1], centres[1:]], axis=1)
        own = submap_rgb(arrays.submap_id)
        colour = np.where(arrays.condemned[:, None], rgb(CONDEMNED_COLOUR), own).astype(np.uint8)
        lines = np.concatenate([pyramids.reshape(-1, 2, 3), way]).astype(np.float32)
        each = np.concatenate([np.repeat(colour, 8, axis=0), colour[1:]])
        points = sim3.act(S, arrays.landmarks_xyz.astype(float)).astype(np.float32)
        return Drawn(lines, np.repeat(each[:, None], 2, axis=1), points, centres)


def _drawn_walk(walk: Walk, S_world: FloatArray) -> DrawnWalk:
    news = walk.news
    T = None if news.T_submap_cam is None else sim3.act_on_pose(S_world, news.T_submap_cam.astype(np.float64))
    way = sim3.act(S_world, news.way.astype(np.float64)).astype(np.float32)
    found = f"{news.n_posed} posed" if news.is_posed else f"{news.n_posed} posed, looking for a way across a gap"
    return DrawnWalk(news.submap_id, way, T, news.is_posed, walk.place, f"at frame {news.frame}, {found}")


def draw_timeline(statuses: Sequence[str], places: Sequence[int] = ()) -> NDArray[np.uint8]:
    """Return the statuses of all frames, first to newest, as a strip (H, W, 3) in their colours.

    `places`: of frames that are marked.
    """
    width, height = TIMELINE_PX
    strip = np.full((height, width, 3), 235, np.uint8)
    if statuses:
        rgb_of = {str(status): rgb(colour) for status, colour in STATUS_COLOURS.items()}
        n = len(statuses)
        strip[:] = [rgb_of[statuses[column * n // width]] for column in range(width)]
        for place in places:
            at = (2 * place + 1) * width // (2 * n)
            strip[:, max(at - MARK_PX, 0) : at + MARK_PX] = MARK_RGB
    return strip


def draw_features(picture: Picture) -> NDArray[np.uint8]:
    """Return a frame with its features, 3 px squares: those that show a landmark in green over the grey others."""
    image = picture.pixels.copy()
    height, width = image.shape[:2]
    for chosen, colour in ((~picture.matched, FEATURE_RGB), (picture.matched, MATCHED_RGB)):
        uv = np.round(picture.uv_px[chosen]).astype(int)
        for dv in (-1, 0, 1):
            for du in (-1, 0, 1):
                u, v = uv[:, 0] + du, uv[:, 1] + dv
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
                image[v[inside], u[inside]] = colour
    return image
