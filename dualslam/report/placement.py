"""Where the trajectories of a run lie on paper: aligned to the truth where there is one, and seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.types import Failure, FloatArray, IntArray
from dualslam.report.run_data import PosedRows, RunData

MIN_UPRIGHT = 0.3
"""Length of the mean of all cameras' downward axes, under which the camera was held at all angles."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A trajectory in the frame of a drawing."""

    submap: int | None  # none for the main map
    row: IntArray  # (N,)
    xyz: FloatArray  # (N, 3)
    error: FloatArray  # (N,): distance from the true position, NaN where there is none


@dataclass(frozen=True, slots=True, eq=False)
class PlacedRun:
    """All that one drawing shows, in one frame."""

    placed: list[Placed]  # the main map first, where there is one
    down: FloatArray  # (3,): mean of the cameras' downward axes (as unit vectors)
    note: str = ""  # what was done to bring it all together
    apart: Sequence[Placed] = ()  # submaps that nothing places in this frame: each has a frame and a unit of its own
    truth_row: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (T,)
    truth_xyz: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (T, 3)
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (P, 3)
    unit: str = ""  # ``m``, or empty where a monocular map's own unit is all there is


def place(run: RunData) -> PlacedRun:
    """Bring the trajectories of a run into one frame: the truth's, or the main map's own."""
    maps: list[tuple[int | None, PosedRows]] = [(None, run.main)] if len(run.main) else []
    maps += list(run.unlinked.items())
    if not len(run.truth):
        apart = [_unplaced(m, posed) for m, posed in maps[1:]]
        placed = [_unplaced(m, posed) for m, posed in maps[:1]]
        down = run.main.T_map_cam[:, :3, 1].mean(axis=0) if len(run.main) else np.zeros(3)
        return PlacedRun(placed, down, "No ground truth: in the map's own unit.", apart, points=run.points)
    placed, apart, points = [], [], np.zeros((0, 3))
    for m, posed in maps:
        S_truth_map = align(posed, run.truth)
        if isinstance(S_truth_map, Failure):
            apart.append(_unplaced(m, posed))
            continue
        placed.append(_placed(m, posed, S_truth_map, run.truth))
        if m is None:
            points = sim3.act(S_truth_map, run.points)
    note = "Each map is aligned to the truth by one similarity, as for the ATE."
    if apart:
        note += " A map with too little motion to be aligned is drawn apart."
    down = run.truth.T_map_cam[:, :3, 1].mean(axis=0)
    return PlacedRun(placed, down, note, apart, run.truth.row, run.truth.xyz, points, "m")


def position_errors(run: RunData) -> FloatArray:
    """Return each row's distance (N,) from the true position, NaN where there is none."""
    error = np.full(len(run.rows), np.nan)
    for placed in place(run).placed:
        error[placed.row] = placed.error
    return error


def align(posed: PosedRows, truth: PosedRows) -> FloatArray | Failure:
    """Return the similarity (4, 4) that takes a map nearest to the truth."""
    _, a, b = np.intersect1d(posed.row, truth.row, return_indices=True)
    alignment = umeyama(posed.xyz[a], truth.xyz[b])
    return alignment.S_dst_src if not isinstance(alignment, Failure) else alignment


def plane_from_above(xyz: FloatArray, down: FloatArray) -> tuple[FloatArray, str]:
    """Return (2, 3) axes of the paper, right and up, with the longest extent to the right, and what is looked along.

    - `xyz` (N, 3): what is drawn.
    - `down` (3,): mean of the cameras' downward axes; short where the camera was held at all angles.
    """
    centred = xyz - xyz.mean(axis=0)
    _, _, principal = np.linalg.svd(centred, full_matrices=False) if len(xyz) >= 3 else (0, 0, np.eye(3))
    if np.linalg.norm(down) >= MIN_UPRIGHT:
        up, view = -down / np.linalg.norm(down), "seen from above (against the mean of the cameras' downward axes)"
    else:
        up, view = principal[2], "seen along the direction of least extent (the camera was held at all angles)"
    flat = centred - np.outer(centred @ up, up)
    _, _, principal = np.linalg.svd(np.vstack([flat, 1e-9 * np.eye(3)]), full_matrices=False)
    right = principal[0] - (principal[0] @ up) * up
    right /= np.linalg.norm(right)
    # From left to right in time, so that the eye follows.
    if (centred[-1] - centred[0]) @ right < 0:
        right = -right
    return np.stack([right, np.cross(up, right)]), view


def _placed(submap: int | None, posed: PosedRows, S_truth_map: FloatArray, truth: PosedRows) -> Placed:
    xyz = sim3.act(S_truth_map, posed.xyz)
    error = np.full(len(posed), np.nan)
    _, a, b = np.intersect1d(posed.row, truth.row, return_indices=True)
    error[a] = np.linalg.norm(xyz[a] - truth.xyz[b], axis=1)
    return Placed(submap, posed.row, xyz, error)


def _unplaced(submap: int | None, posed: PosedRows) -> Placed:
    return Placed(submap, posed.row, posed.xyz, np.full(len(posed), np.nan))


def extent(parts: Sequence[FloatArray]) -> FloatArray:
    """Return (2, D) lowest and highest coordinates of point sets (N, D) together."""
    every = np.concatenate([part for part in parts if len(part)])
    return np.stack([every.min(axis=0), every.max(axis=0)])
