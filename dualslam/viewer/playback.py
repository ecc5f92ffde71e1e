"""A finished run in time and space, as arrays: what a viewer plays. Nothing here knows the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import camera_from_dict
from dualslam.core.errors import ConfigError, InputError
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FloatArray, FrameStatus, IntArray
from dualslam.io.colours import load_colours, padded
from dualslam.io.map_files import METADATA, load_arrays
from dualslam.io.map_store import load_placement, submap_path
from dualslam.io.run_folder import MAP, SUMMARY, FrameRow
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.report.placement import align
from dualslam.report.run_data import CONDEMNED, PosedRows, RunData, are_shown
from dualslam.report.statuses import WITHOUT_POSE

_ARRAYS = (
    "landmarks_xyz_mu",
    "landmarks_distance_mu",
    "landmarks_alive",
    "landmarks_first_kf",
    "kf_id",
    "kf_T_submap_kf",
)
_NO_XYZ = np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Appearing:
    """Points that appear one by one and stay."""

    row: IntArray  # (N,): the frame at which each appears, ascending: a row of `Playback.rows`
    xyz: FloatArray  # (N, 3)
    submap: IntArray  # (N,)
    rgb: NDArray[np.uint8]  # (N, 3): their colours in the images; of keyframes, and where none are known, `GREY`

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """One frame of reference with all that stands in it, in the unit of its map."""

    submap: int | None  # none for the main map; a submap that is not linked to it has a space of its own
    posed: PosedRows  # poses as the trajectory file has them
    # Camera centres at their own frames; landmarks at the keyframe that first described them. Landmarks that were far
    # from it are left out, as in the pictures of the report.
    keyframes: Appearing
    landmarks: Appearing
    truth_xyz: FloatArray
    """(T, 3): true camera centres, taken into this space by one similarity; empty where there are none."""

    @property
    def size(self) -> float:
        """Length of the diagonal of the box around the cameras."""
        return float(np.linalg.norm(np.ptp(self.posed.xyz, axis=0))) if len(self.posed) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """A run as it is played."""

    rows: list[FrameRow]  # every input frame, ascending in time (a run may have read them backwards)
    camera: Camera
    spaces: list[Space]  # the main map first; it is there even if it is empty


def play(run: RunData) -> Playback:
    """Lay a run out in time and space.

    Raises `InputError` if the map or an event is damaged or is not of these frames, or the run does not name its
    camera.
    """
    order = np.argsort([row.timestamp_s for row in run.rows], kind="stable")
    rows = [run.rows[i] for i in order.tolist()]
    at = np.empty(len(order), np.int64)
    at[order] = np.arange(len(order))
    truth = _moved(run.truth, at)
    main = _moved(run.main, at)
    spaces = [_space(run, rows, None, main, truth)]
    spaces += [_space(run, rows, m, _moved(posed, at), truth) for m, posed in run.unlinked.items()]
    return Playback(rows, _camera(run), spaces)


def segments(posed: PosedRows) -> tuple[IntArray, FloatArray]:
    """Return the pieces of the way between neighbouring frames: rows (S,) at which they end, and ends (S, 2, 3).

    Where frames in between have no pose in this map there is no piece: the way over a gap is not known.
    """
    joined = np.flatnonzero(np.diff(posed.row) == 1)
    return posed.row[joined + 1], np.stack([posed.xyz[joined], posed.xyz[joined + 1]], axis=1)


def camera_statuses(playback: Playback, space: Space) -> list[FrameStatus | None]:
    """Return for each frame its status as the camera of one space shows it; None where its pose is in another map."""
    here = set(space.posed.row.tolist())
    return [row.status if i in here or row.status in WITHOUT_POSE else None for i, row in enumerate(playback.rows)]


def _moved(posed: PosedRows, at: IntArray) -> PosedRows:
    """Return poses by their rows in another order: row i is now row ``at[i]``."""
    row = at[posed.row]
    ascending = np.argsort(row, kind="stable")
    return PosedRows(row[ascending], posed.T_map_cam[ascending])


def _space(run: RunData, rows: Sequence[FrameRow], submap: int | None, posed: PosedRows, truth: PosedRows) -> Space:
    S_truth_map = align(posed, truth)
    xyz = _NO_XYZ if isinstance(S_truth_map, Failure) else sim3.act(sim3.inverse(S_truth_map), truth.xyz)
    return Space(submap, posed, *_map_parts(run, rows, submap), xyz)


def _map_parts(run: RunData, rows: Sequence[FrameRow], submap: int | None) -> tuple[Appearing, Appearing]:
    """Read the keyframes and landmarks of the main map, or of one submap in its own frame."""
    folder = run.path / MAP
    if submap is None:
        component, S_world_submap = load_placement(folder, (row.submap for row in rows if row.in_main_map))
    else:
        component, S_world_submap = [submap] if (folder / METADATA).is_file() else [], {submap: np.eye(4)}
    first_id = run.summary.get("first_id", 0)
    number_of = FrameNumbers(first_id, run.summary.get("first_index")).number_of
    row_of = dict.fromkeys(range(first_id), 0)  # what earlier runs have left in the saved map was there from the start
    row_of |= {number_of(row.index): i for i, row in enumerate(rows)}
    keyframes, landmarks = [], []
    colours = load_colours(folder)
    for m in component:
        arrays, S = load_arrays(submap_path(folder, m), _ARRAYS, (CONDEMNED,)), S_world_submap[m]
        shown = are_shown(arrays)
        kf_id, xyz = arrays["kf_id"], sim3.act(S, arrays["kf_T_submap_kf"][:, :3, 3])
        keyframes.append((m, kf_id, xyz, padded({}, m, len(kf_id))))
        rgb = padded(colours, m, len(shown))[shown]
        landmarks.append((m, arrays["landmarks_first_kf"][shown], sim3.act(S, arrays["landmarks_xyz_mu"][shown]), rgb))
    try:
        return _appear(keyframes, row_of), _appear(landmarks, row_of)
    except KeyError as error:
        raise InputError(f"{folder} is not the map of this run: its keyframe {error} is no frame of it.") from None


def _appear(parts: Sequence[tuple[int, IntArray, FloatArray, NDArray[np.uint8]]], row_of: dict[int, int]) -> Appearing:
    row = np.array([row_of[k] for _, frames, _, _ in parts for k in frames.tolist()], np.int64)
    xyz = np.concatenate([_NO_XYZ, *(part[2] for part in parts)])
    rgb = np.concatenate([np.zeros((0, 3), np.uint8), *(part[3] for part in parts)])
    submap = np.concatenate([np.zeros(0, np.int64), *(np.full(len(part[1]), part[0]) for part in parts)])
    order = np.argsort(row, kind="stable")
    return Appearing(row[order], xyz[order], submap[order], rgb[order])


def _camera(run: RunData) -> Camera:
    try:
        return camera_from_dict(run.summary["camera"])
    except (KeyError, TypeError, ValueError, ConfigError, InputError) as error:
        raise InputError(f"{run.path / SUMMARY} does not name the camera of the run: {error}.") from None
