"""A run folder, read: what the pages are made from. Nothing else is needed, so a page can be made again at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.config import strict_yaml
from dualslam.core.errors import InputError, how_to_install
from dualslam.core.geometry import sim3
from dualslam.core.types import BoolArray, FloatArray, FrameStatus, IntArray
from dualslam.io import run_folder
from dualslam.io.map_files import load_arrays
from dualslam.io.map_store import load_placement, submap_path
from dualslam.io.run_folder import FrameRow, unlinked_submaps
from dualslam.io.run_reading import read_events, read_frames, read_samples, read_summary
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate, read_text, read_tum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_POINTS = 2500
MAX_VIEW_DISTANCE_MU = 8.0
"""Landmarks farther from the camera that made them (the start's median depth is 1) are left out of the pictures."""
_POINT_ARRAYS = ("landmarks_xyz_mu", "landmarks_distance_mu", "landmarks_alive")
CONDEMNED = "landmarks_condemned"


@dataclass(frozen=True, slots=True, eq=False)
class PosedRows:
    """Rows of ``frames.csv`` with a pose, N of them, in one map."""

    row: IntArray  # (N,): ascending
    T_map_cam: FloatArray  # (N, 4, 4)

    def __len__(self) -> int:
        return len(self.row)

    @property
    def xyz(self) -> FloatArray:
        """(N, 3) camera centres."""
        return self.T_map_cam[:, :3, 3]


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """Data of a finished run."""

    path: Path
    rows: list[FrameRow]  # every input frame, in the order in which they came
    events: list[dict[str, Any]]
    summary: dict[str, Any]
    config: dict[str, Any]  # the resolved configuration, nested
    config_text: str  # the same as it was written, with its comments
    main: PosedRows
    unlinked: dict[int, PosedRows]  # submaps that are not linked to the main map, each in its own unit
    truth: PosedRows  # true poses of the frames that have one; empty where there is no ground truth
    points: FloatArray  # (P, 3): some of the main map's landmarks
    samples: dict[int, bytes]  # small JPEGs of frames around the gaps, by frame index
    mask: bytes | None = None  # the run's mask as a PNG; None where nothing was left out

    def __repr__(self) -> str:
        return f"<run {self.path}: {len(self.main)} of {len(self.rows)} frames posed, {len(self.events)} events>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the outcome and the trajectory from above."""
        page = import_module("dualslam.report.page")  # by name: the pages are made of this
        return str(page.notebook_cell(self))

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the trajectory from above, with matplotlib (extra `report`).

        `path`: file to write, in the format of its ending: ``.pdf``, ``.svg``, ``.png``.

        Raises `InputError` if matplotlib is not installed, or no frame has a pose.
        """
        try:
            plot = import_module("dualslam.report.plot")
        except ImportError as error:
            raise InputError(f"plot draws with matplotlib: {how_to_install('report')}.") from error
        figure: Figure = plot.plot_run(self, path)
        return figure

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.resolve().name

    @property
    def row_of(self) -> dict[int, int]:
        """Where each frame stands among the rows, by its index in the source."""
        return {row.index: i for i, row in enumerate(self.rows)}

    @property
    def losses(self) -> list[tuple[int, int, int]]:
        """Number of each failure from 1 on, frame since which track was lost, and that frame's row if it has one."""
        row_of = self.row_of
        since = [event.get("lost_since", event["frame"]) for event in self.events_of("failed")]
        return [(i, frame, row_of[frame]) for i, frame in enumerate(since, 1) if frame in row_of]

    def events_of(self, *kinds: str) -> list[dict[str, Any]]:
        """Return the events of some kinds, in order."""
        return [event for event in self.events if event.get("event") in kinds]

    def count(self, status: FrameStatus) -> int:
        """Return how many frames have a status."""
        return sum(row.status is status for row in self.rows)


def read_run(path: str | Path) -> RunData:
    """Read a run folder.

    Raises `InputError` if it is none, the run did not come to its end, or a file is damaged.
    """
    path = Path(path)
    if not (path / run_folder.SUMMARY).is_file():
        missing = f"it has no {run_folder.SUMMARY}" if path.is_dir() else "there is no such folder"
        raise InputError(f"{path} is not the folder of a finished run: {missing}.")
    rows = read_frames(path / run_folder.FRAMES)
    times = np.array([row.timestamp_s for row in rows])
    config_file = path / run_folder.CONFIG
    config_text = read_text(config_file)
    truth_file = path / run_folder.GROUND_TRUTH
    events = read_events(path / run_folder.EVENTS)
    if not all("timestamp_s" in event and "frame" in event for event in events):
        raise InputError(f"{path / run_folder.EVENTS} is damaged: an event has no frame or no time.")
    return RunData(
        path=path,
        rows=rows,
        events=events,
        summary=read_summary(path),
        config=_settings(config_file, config_text),
        config_text=config_text,
        main=_on_rows(path / run_folder.TRAJECTORY, times),
        unlinked={m: _on_rows(file, times) for m, file in unlinked_submaps(path).items()},
        truth=_truth_on_rows(read_tum(truth_file, allow_empty=True), times) if truth_file.exists() else _no_rows(),
        points=_map_points(path / run_folder.MAP, {row.submap for row in rows if row.in_main_map}),
        samples=read_samples(path),
        mask=(path / run_folder.MASK).read_bytes() if (path / run_folder.MASK).is_file() else None,
    )


def _settings(path: Path, text: str) -> dict[str, Any]:
    """Return what a configuration's text says."""
    try:
        found = strict_yaml.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is damaged: {error}.") from None
    if not isinstance(found, dict):
        raise InputError(f"{path} is not what a run writes: it holds no names with values.")
    return found


def _no_rows() -> PosedRows:
    return PosedRows(np.zeros(0, np.int64), np.zeros((0, 4, 4)))


def _on_rows(file: Path, times_s: FloatArray) -> PosedRows:
    """Read a trajectory, and give each pose its row: their times were written from the same numbers."""
    trajectory = read_tum(file, allow_empty=True)
    if not len(trajectory):
        return _no_rows()
    order = np.argsort(times_s, kind="stable")
    at, near = associate(times_s[order], trajectory.timestamps_s, MAX_DT_S)
    if not near.all():
        raise InputError(
            f"{file} has a pose at {trajectory.timestamps_s[np.argmin(near)]:.6f} s, where {run_folder.FRAMES} has no "
            "frame: one of the two is cut off, or of another run. Give another run, or run it again."
        )
    row = order[at]
    ascending = np.argsort(row, kind="stable")
    return PosedRows(row[ascending], trajectory.T_world_cam[ascending])


def _truth_on_rows(truth: Trajectory, times_s: FloatArray) -> PosedRows:
    pose, near = associate(truth.timestamps_s, times_s, MAX_DT_S)
    return PosedRows(np.flatnonzero(near), truth.T_world_cam[pose[near]])


def _map_points(folder: Path, submap_ids: set[int | None]) -> FloatArray:
    """Read landmarks of the main map in its frame: the arrays that are needed, of the many that a map holds."""
    component, S_world_submap = load_placement(folder, submap_ids)
    clouds = [np.zeros((0, 3))]
    for m in component:
        arrays = load_arrays(submap_path(folder, m), _POINT_ARRAYS, (CONDEMNED,))
        clouds.append(sim3.act(S_world_submap[m], arrays["landmarks_xyz_mu"][are_shown(arrays)]))
    points = np.concatenate(clouds)
    return points[:: max(1, len(points) // MAX_POINTS)]


def are_shown(arrays: Mapping[str, NDArray[Any]]) -> BoolArray:
    """Return which landmarks of a stored submap belong into a picture: none that a by-pass has marked invalid."""
    shown = arrays["landmarks_alive"] & (arrays["landmarks_distance_mu"] < MAX_VIEW_DISTANCE_MU)
    return np.asarray(shown & ~arrays[CONDEMNED] if CONDEMNED in arrays else shown)
