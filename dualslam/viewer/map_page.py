"""The map of a finished run as one page that any browser can turn, from its run folder alone, without a library."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualslam.core.types import FloatArray, FrameStatus, IntArray
from dualslam.report.markup import join, tag
from dualslam.report.page import headline
from dualslam.report.run_data import RunData
from dualslam.report.statuses import MEANING
from dualslam.viewer.colours import STATUS_COLOURS, rgb, submap_rgb
from dualslam.viewer.playback import Playback, Space, play, segments

MAX_POINTS = 60_000
"""Landmarks on the page, evenly chosen: 16 bytes each, a megabyte."""
WITHIN = 0.97
"""Landmarks further out on a side than this share of all need not be in sight at first."""
GAP_SHARE = 0.35
"""Between maps that are not linked, of the width of the one before."""


def map_page(run: RunData) -> str | None:
    """Return the page, or None where no frame has a pose.

    Landmarks have the colour of their submap, the way that of its frames; all appear with the frame that brought
    them. Maps that are not linked stand beside the main one, in units of their own.

    Raises
    ------
    InputError
        If the run folder is damaged.
    """
    playback = play(run)
    spaces = [space for space in playback.spaces if len(space.posed)]
    if not spaces:
        return None
    landmarks, way, cameras = _beside(playback, spaces)
    xyz = np.concatenate([landmarks[0], cameras[0]])
    low, high = np.quantile(xyz, [1 - WITHIN, WITHIN], axis=0)
    data = {
        "landmarks": _packed(*landmarks),
        "way": _packed(*way),
        "cameras": _packed(*cameras),
        "middle": np.round((low + high) / 2, 4).tolist(),
        "extent": round(max(float(np.linalg.norm(high - low)), 1e-3), 4),
        "frames": [row.index for row in playback.rows],
        "statuses": [str(row.status) for row in playback.rows],
    }
    shown = {row.status for row in playback.rows} & {FrameStatus.TRACKED, FrameStatus.RECOVERED, FrameStatus.BYPASSED}
    key = [_item(rgb(STATUS_COLOURS[status]), MEANING[status]) for status in MEANING if status in shown]
    submaps = sorted({int(m) for space in spaces for m in np.unique(space.landmarks.submap)})
    key += [_item(submap_rgb(m), f"landmarks of submap {m}") for m in submaps]
    page = Template(files("dualslam.viewer").joinpath("map_page.html").read_text(encoding="utf-8"))
    title = join(f"{run.summary.get('sequence', run.name)}: the map")
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return page.substitute(title=title, headline=join(headline(run)), key=join(key), data=text)


_Arrays = tuple[FloatArray, NDArray[np.uint8], IntArray]
"""Positions (N, 3), colours (N, 3), and the rows (N,) at which they appear."""


def _beside(playback: Playback, spaces: list[Space]) -> tuple[_Arrays, _Arrays, _Arrays]:
    """Return landmarks, ends of the way's pieces and cameras of all spaces, side by side."""
    n_points = sum(len(space.landmarks) for space in spaces)
    every = max(1, -(-n_points // MAX_POINTS))
    landmarks: list[_Arrays] = []
    way: list[_Arrays] = []
    cameras: list[_Arrays] = []

    def by_status(row: IntArray) -> NDArray[np.uint8]:
        return np.array([rgb(STATUS_COLOURS[playback.rows[r].status]) for r in row.tolist()], np.uint8).reshape(-1, 3)

    right, width = 0.0, 0.0
    for i, space in enumerate(spaces):
        shift = np.zeros(3)
        x = space.posed.xyz[:, 0]
        if i:
            shift[0] = right + GAP_SHARE * width - x.min()
        width = max(float(np.ptp(x)), 1.0)
        right = float(x.max()) + shift[0]
        chosen = slice(None, None, every)
        colours = np.array([submap_rgb(m) for m in space.landmarks.submap[chosen].tolist()], np.uint8).reshape(-1, 3)
        landmarks.append((space.landmarks.xyz[chosen] + shift, colours, space.landmarks.row[chosen]))
        row, ends = segments(space.posed)
        way.append((ends.reshape(-1, 3) + shift, np.repeat(by_status(row), 2, axis=0), np.repeat(row, 2)))
        cameras.append((space.posed.xyz + shift, by_status(space.posed.row), space.posed.row))
    return _joined(landmarks), _joined(way), _joined(cameras)


def _joined(parts: list[_Arrays]) -> _Arrays:
    xyz, colours, row = (np.concatenate(column) for column in zip(*parts, strict=True))
    return xyz, colours, row


def _packed(xyz: FloatArray, colours: NDArray[np.uint8], row: IntArray) -> dict[str, str]:
    return {"xyz": _base64(xyz, np.float32), "rgb": _base64(colours, np.uint8), "row": _base64(row, np.float32)}


def _base64(array: ArrayLike, kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, kind).tobytes()).decode("ascii")


def _item(colour: tuple[int, int, int], words: str) -> object:
    return tag("span", tag("i", style=f"background:rgb{colour}"), words)
