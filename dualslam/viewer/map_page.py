"""The map of a finished run as one page that any browser can turn, from its run folder alone, without a library."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.types import FloatArray, FrameStatus, IntArray
from dualslam.io.colours import GREY, load_pictures
from dualslam.io.export.metric import read_scale
from dualslam.io.run_folder import MAP, FrameRow
from dualslam.report.canvas import nice_step, units_of_map
from dualslam.report.markup import Markup, join, number, tag
from dualslam.report.page import headline
from dualslam.report.run_data import RunData
from dualslam.report.statuses import MEANING, WITHOUT_POSE, stretches
from dualslam.viewer.colours import STATUS_COLOURS, rgb, submap_rgb
from dualslam.viewer.playback import Playback, Space, play, segments

MAX_POINTS = 30_000
"""Landmarks on the page, evenly chosen: 25 bytes each, 750 KB."""
MAX_FRUSTA, MAX_POSES = 120, 1500
"""Keyframes that are drawn as pyramids, and poses at which the camera can stand, evenly chosen: 40 and 100 KB."""
WITHIN = 0.97
"""Landmarks further out on a side than this share of all need not be in sight at first."""
FRUSTUM_SHARE = 0.02
"""Depth of a camera's pyramid, of the extent of the map."""
GRID_LINES = 20
RED, GRID = (232, 80, 91), (52, 59, 70)
GAP_SHARE = 0.35
"""Between maps that are not linked, of the width of the one before."""


def map_page(run: RunData) -> str | None:
    """Return the page, or None where no frame has a pose.

    Landmarks have their colours in the images, or those of their submaps; the way has the colours of its frames'
    statuses. All appear with the frame that brought them. Maps that are not linked stand beside the main one, in units
    of their own.

    Raises `InputError` if the run folder is damaged.
    """
    playback = play(run)
    spaces = [space for space in playback.spaces if len(space.posed)]
    if not spaces:
        return None
    landmarks, way, cameras, poses = _beside(playback, spaces)
    xyz = np.concatenate([landmarks[0], cameras[0]])
    low, high = np.quantile(xyz, [1 - WITHIN, WITHIN], axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-3)
    corners = _pyramid(playback.camera, FRUSTUM_SHARE * extent)
    step, grid = _grid(low, high)
    data = {
        "landmarks": _packed(*landmarks),
        "way": _packed(*way),
        "cameras": _packed(*cameras),
        "frusta": _packed(*_frusta(spaces, poses, corners)),
        "grid": _packed(grid, np.full((len(grid), 3), GRID, np.uint8), np.full(len(grid), -1)),
        "poses": {
            "row": _base64(poses[1], np.float32),
            "T": _base64(poses[0][:, :3].reshape(-1, 12), np.float32),
            "pyramid": np.round(corners, 5).tolist(),
        },
        "middle": np.round((low + high) / 2, 4).tolist(),
        "extent": round(extent, 4),
        "frames": [row.index for row in playback.rows],
        "statuses": [str(row.status) for row in playback.rows],
        "pictures": _pictures(run),
    }
    shown = {row.status for row in playback.rows} & {FrameStatus.TRACKED, FrameStatus.RECOVERED, FrameStatus.BYPASSED}
    key = [_item(rgb(STATUS_COLOURS[status]), MEANING[status]) for status in MEANING if status in shown]
    key.append(_item(RED, "no pose, or doubtful"))
    metres = read_scale(run.path)
    unit = f"{number(step * metres)} m" if metres else units_of_map(step)
    key.append(_item(GRID, f"grid: {unit}"))
    page = Template(files("dualslam.viewer").joinpath("map_page.html").read_text(encoding="utf-8"))
    title = join(f"{run.summary.get('sequence', run.name)}: the map")
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    strip = _strip(playback)
    return page.substitute(
        title=title, verdict=join(verdict_words(run)), headline=headline(run), key=join(key), strip=strip, data=text
    )


def verdict_words(run: RunData) -> str:
    """Return the verdict on a run, with its reasons; empty where it has none."""
    verdict = run.summary.get("verdict") or {}
    if not verdict:
        return ""
    reasons = [str(reason.get("text", "")) for reason in verdict.get("reasons", ())]
    return " ".join([f"Verdict: {verdict.get('level', '')}.", *reasons])


def _strip(playback: Playback) -> Markup:
    """Return the statuses over time, to stand above the slider; red: no pose, or doubtful."""
    colours = [_colour(row) for row in playback.rows]
    n = len(colours)
    pieces = [
        tag("i", style=f"left:{100 * s.start / n:.2f}%;width:{100 * len(s) / n:.2f}%;background:rgb{s.value}")
        for s in stretches(colours)
    ]
    return tag("div", pieces, cls="strip")


def _pictures(run: RunData) -> dict[str, str]:
    """Return the pictures that the run kept, by the index of their frame."""
    kept = load_pictures(run.path / MAP) or run.samples
    return {str(index): base64.b64encode(jpeg).decode("ascii") for index, jpeg in sorted(kept.items())}


def _pyramid(camera: Camera, depth: float) -> FloatArray:
    """Return the corners (4, 3) of the image at a depth in front of the camera."""
    w, h = camera.size_px
    corners = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], float)
    return np.asarray(corners @ np.linalg.inv(camera.K).T * depth)


def _frusta(spaces: list[Space], poses: tuple[FloatArray, IntArray], corners: FloatArray) -> _Arrays:
    """Return the edges of the keyframes' pyramids: 8 lines each."""
    keyframes = np.concatenate([space.keyframes.row for space in spaces])
    T, row = poses
    at = np.flatnonzero(np.isin(row, keyframes))
    at = at[:: max(1, -(-len(at) // MAX_FRUSTA))]
    seen = np.einsum("nij,kj->nki", T[at, :3, :3], corners) + T[at, None, :3, 3]
    apex = np.repeat(T[at, None, :3, 3], 4, axis=1)
    ends = np.stack([apex, seen, seen, np.roll(seen, -1, axis=1)], axis=2).reshape(-1, 3)
    colour = np.full((len(ends), 3), (150, 160, 175), np.uint8)
    return ends, colour, np.repeat(row[at], 16)


def _grid(low: FloatArray, high: FloatArray) -> tuple[float, FloatArray]:
    """Return the step of a level grid under the map (y points down), and the ends of its lines (2 N, 3)."""
    step = nice_step(2 * max(float(high[0] - low[0]), float(high[2] - low[2]), 1e-3) / GRID_LINES)  # or a still camera
    x, z = (np.arange(np.floor(low[i] / step), np.ceil(high[i] / step) + 1) * step for i in (0, 2))
    y = high[1]
    along = [[(u, y, z[0]), (u, y, z[-1])] for u in x] + [[(x[0], y, v), (x[-1], y, v)] for v in z]
    return step, np.array(along, float).reshape(-1, 3)


_Arrays = tuple[FloatArray, NDArray[np.uint8], IntArray]
"""Positions (N, 3), colours (N, 3), and the rows (N,) at which they appear."""


def _colour(row: FrameRow) -> tuple[int, int, int]:
    """Return the colour of a frame: its status's, or red where there is no pose or it is doubtful."""
    return RED if row.doubt or row.status in WITHOUT_POSE else rgb(STATUS_COLOURS[row.status])


def _beside(playback: Playback, spaces: list[Space]) -> tuple[_Arrays, _Arrays, _Arrays, tuple[FloatArray, IntArray]]:
    """Return landmarks, ends of the way's pieces, cameras, and poses of all spaces, side by side."""
    n_points = sum(len(space.landmarks) for space in spaces)
    every = max(1, -(-n_points // MAX_POINTS))
    landmarks: list[_Arrays] = []
    way: list[_Arrays] = []
    cameras: list[_Arrays] = []
    poses: list[FloatArray] = []

    def by_status(row: IntArray) -> NDArray[np.uint8]:
        return np.array([_colour(playback.rows[r]) for r in row.tolist()], np.uint8).reshape(-1, 3)

    right, width = 0.0, 0.0
    for i, space in enumerate(spaces):
        shift = np.zeros(3)
        x = space.posed.xyz[:, 0]
        if i:
            shift[0] = right + GAP_SHARE * width - x.min()
        width = max(float(np.ptp(x)), 1.0)
        right = float(x.max()) + shift[0]
        chosen = slice(None, None, every)
        landmarks.append((space.landmarks.xyz[chosen] + shift, _shown(space)[chosen], space.landmarks.row[chosen]))
        row, ends = segments(space.posed)
        way.append((ends.reshape(-1, 3) + shift, np.repeat(by_status(row), 2, axis=0), np.repeat(row, 2)))
        row, ends = _gaps(space)
        way.append((ends.reshape(-1, 3) + shift, np.full((2 * len(row), 3), RED, np.uint8), np.repeat(row, 2)))
        cameras.append((space.posed.xyz + shift, by_status(space.posed.row), space.posed.row))
        T = space.posed.T_map_cam.copy()
        T[:, :3, 3] += shift
        poses.append(T)
    T, row = np.concatenate(poses), np.concatenate([space.posed.row for space in spaces])
    order = np.argsort(row, kind="stable")
    order = order[:: max(1, -(-len(order) // MAX_POSES))]
    return _joined(landmarks), _joined(way), _joined(cameras), (T[order], row[order])


def _shown(space: Space) -> NDArray[np.uint8]:
    """Return the colours of the landmarks: those of the images, or of their submaps where none are known."""
    if (space.landmarks.rgb != GREY).any():
        return space.landmarks.rgb
    return np.array([submap_rgb(m) for m in space.landmarks.submap.tolist()], np.uint8).reshape(-1, 3)


def _gaps(space: Space) -> tuple[IntArray, FloatArray]:
    """Return the gaps in a map: rows (S,) at which they end, and the positions before and after (S, 2, 3)."""
    apart = np.flatnonzero(np.diff(space.posed.row) > 1)
    xyz = space.posed.xyz
    return space.posed.row[apart + 1], np.stack([xyz[apart], xyz[apart + 1]], axis=1)


def _joined(parts: list[_Arrays]) -> _Arrays:
    xyz, colours, row = (np.concatenate(column) for column in zip(*parts, strict=True))
    return xyz, colours, row


def _packed(xyz: FloatArray, colours: NDArray[np.uint8], row: IntArray) -> dict[str, str]:
    return {"xyz": _base64(xyz, np.float32), "rgb": _base64(colours, np.uint8), "row": _base64(row, np.float32)}


def _base64(array: ArrayLike, kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, kind).tobytes()).decode("ascii")


def _item(colour: tuple[int, int, int], words: str) -> object:
    return tag("span", tag("i", style=f"background:rgb{colour}"), words)
