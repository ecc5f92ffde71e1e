"""Run folder: written so that a crash or an interrupt at any moment loses nothing."""

from __future__ import annotations

import csv
import io
import json
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import cv2
import numpy as np
import yaml

from dualslam.core.camera.base import Camera
from dualslam.core.config.files import CONFIG as CONFIG
from dualslam.core.errors import OutputError
from dualslam.core.events import Event
from dualslam.core.schedule import SCHEDULE
from dualslam.core.types import BoolArray
from dualslam.io.atomic import FolderLock, write_bytes, write_text
from dualslam.io.map_files import METADATA, to_plain
from dualslam.io.metric_files import METRIC_FILES
from dualslam.io.trajectory_files import Trajectory, write_kitti, write_tum
from dualslam.map.frame_records import FrameRow as FrameRow  # a row of frames.csv

log = logging.getLogger(__name__)

TRAJECTORY = "trajectory.txt"
TRAJECTORIES_MERGED = ("trajectory_a.txt", "trajectory_b.txt")
"""Of a merged run: the frames of either run, on its own clock."""
TRAJECTORY_KITTI = "trajectory_kitti.txt"
TRAJECTORY_KITTI_FRAMES = "trajectory_kitti_frames.txt"
FRAMES = "frames.csv"
EVENTS = "events.jsonl"
DECISIONS = "decisions.jsonl"
SUMMARY = "summary.json"
REPORT = "report.html"
MAP_PAGE = "map.html"
GROUND_TRUTH = "groundtruth.txt"
MASK = "mask.png"
CAMERA = "camera.yaml"
SUBMAPS = "submaps"
SAMPLES = "samples"
MAP = "map"

FRAME_COLUMNS = (
    *("index", "timestamp_s", "status", "submap", "in_main_map", "n_matches", "n_inliers", "latency_ms"),
    *("sigma_position_rel", "sigma_scale", "method", "doubt"),
)
_FILES = (
    *(TRAJECTORY, TRAJECTORY_KITTI, TRAJECTORY_KITTI_FRAMES, FRAMES, EVENTS, DECISIONS, SCHEDULE, SUMMARY, CONFIG),
    *(REPORT, MAP_PAGE, GROUND_TRUTH, MASK, CAMERA, *METRIC_FILES, *TRAJECTORIES_MERGED),
)
_RESULTS = (
    *(CONFIG, EVENTS, DECISIONS, SCHEDULE, FRAMES, TRAJECTORY, f"{SUBMAPS}/", SUMMARY, GROUND_TRUTH, MASK, CAMERA),
    *(f"{MAP}/", MAP_PAGE, REPORT),
)
"""In the order in which they are listed for a person."""
_NOT_OF_EVERY_RUN = frozenset({f"{SUBMAPS}/", GROUND_TRUTH, MASK, CAMERA, MAP_PAGE, DECISIONS})
_SUBMAP_NAME = re.compile(r"\d+\.txt")
SAMPLE_NAME = re.compile(r"\d+\.jpg")
_MAP_NAME = re.compile(r"[\w.-]+\.(npz|json)")


@dataclass(frozen=True, slots=True, eq=False)
class RunRecord:
    """The result of a run as it goes to the disk."""

    frames: Sequence[FrameRow]  # one for every input frame
    main: Trajectory  # all frames posed in the main map
    unlinked: Mapping[int, Trajectory] = field(default_factory=dict)
    """Submaps that are not linked to the main map, each in its own unit."""
    summary: Mapping[str, Any] = field(default_factory=dict)  # plain numbers, strings and lists


class RunFolder:
    """A folder that a run writes to. Every file appears whole; events are on the disk as soon as they happen.

    - `path`: made if it is not there.
    - `overwrite`: remove the files of an earlier run. Files that no run writes stay in any case.

    - `n_events`: how many events have been taken.

    Raises `OutputError` as `check_vacant` does, or if another run is writing there, or the folder cannot be made.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._lines: dict[str, IO[str]] = {}
        """Files of lines that are open; the events' is as long as the folder is."""
        self._config: str | None = None
        self.n_events = 0
        check_vacant(self.path, overwrite=overwrite)
        with ExitStack() as undo:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                self._lock = FolderLock(self.path)
                undo.callback(self._lock.release)
                check_vacant(self.path, overwrite=overwrite)  # another run may have ended there meanwhile
                for file in _run_files(self.path):
                    if file.name != EVENTS:  # by which the next one knows that this is a run's folder
                        file.unlink()
                self._open(EVENTS)
            except OSError as e:
                raise _not_writable(self.path, e) from e
            undo.pop_all()

    @property
    def map_path(self) -> Path:
        """Where the map belongs."""
        return self.path / MAP

    def write_config(self, config: str | Mapping[str, Any]) -> None:
        """Write the resolved configuration: YAML text, or a mapping to be dumped."""
        text = config if isinstance(config, str) else yaml.safe_dump(to_plain(config), sort_keys=False)
        write_text(self.path / CONFIG, text)
        self._config = text

    def restore(self) -> None:
        """Write again what somebody has removed from the folder while the run went on.

        Without its event file `n_events` is 0 again: all events are to be appended once more.
        """
        if self._config is not None and not (self.path / CONFIG).exists():
            log.warning("%s was removed while the run went on; its results are written again", self.path / CONFIG)
            write_text(self.path / CONFIG, self._config)
        if EVENTS in self._lines and not (self.path / EVENTS).exists():
            with suppress(OSError):  # of the file that is gone
                self._lines[EVENTS].close()
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                self._open(EVENTS)
            except OSError as e:
                raise _not_writable(self.path, e) from e
            self.n_events = 0

    def append_event(self, event: Event) -> None:
        """Append an event to ``events.jsonl`` and flush it, so that a crash of the process cannot take it back."""
        if EVENTS not in self._lines:
            raise OutputError(f"{self.path / EVENTS} is closed; events come before the end of the run.")
        self._append(EVENTS, event.as_dict())
        self.n_events += 1  # from here on it is in the buffer, and goes with the next one where the disk is full
        try:
            self._lines[EVENTS].flush()
        except OSError as e:
            raise OutputError(f"{self.path / EVENTS} cannot be written: {e.strerror or e}.") from e

    def append_schedule(self, row: Mapping[str, Any]) -> None:
        """Append a line to ``schedule.jsonl``; nothing once the folder is closed."""
        self._append(SCHEDULE, row)

    def append_decision(self, row: Mapping[str, Any]) -> None:
        """Append a line to ``decisions.jsonl``; nothing once the folder is closed."""
        self._append(DECISIONS, row)

    def _append(self, name: str, row: Mapping[str, Any]) -> None:
        if EVENTS not in self._lines:
            return
        try:
            file = self._lines[name] if name in self._lines else self._open(name)
            file.write(json.dumps(to_plain(row), allow_nan=False) + "\n")
        except OSError as e:
            raise OutputError(f"{self.path / name} cannot be written: {e.strerror or e}.") from e

    def _open(self, name: str) -> IO[str]:
        self._lines[name] = (self.path / name).open("w", encoding="utf-8", newline="\n")
        return self._lines[name]

    def write_truth(self, truth: Trajectory) -> None:
        """Write the true poses that belong to the run's frames, so that the folder can be judged by itself."""
        write_tum(self.path / GROUND_TRUTH, truth)

    def write_sample(self, index: int, jpeg: bytes) -> None:
        """Write a small picture of a frame."""
        write_bytes(self.path / SAMPLES / f"{index:06d}.jpg", jpeg)

    def write_mask(self, hidden: BoolArray) -> None:
        """Write ``mask.png``: 0 for the pixels (H, W) that show no scene, 255 for the others."""
        write_bytes(self.path / MASK, cv2.imencode(".png", np.where(hidden, 0, 255).astype(np.uint8))[1].tobytes())

    def write_camera(self, camera: Camera) -> None:
        """Write ``camera.yaml``: a calibration file, which another run can be given."""
        write_text(self.path / CAMERA, yaml.safe_dump(camera.to_dict(), sort_keys=False))

    def write_map_page(self, page: str) -> None:
        """Write ``map.html``."""
        write_text(self.path / MAP_PAGE, page)

    def write_report(self, page: str) -> None:
        """Write ``report.html``."""
        write_text(self.path / REPORT, page)

    def write(self, record: RunRecord) -> None:
        """Write frames, trajectories and the summary."""
        self.write_poses(record)
        self.write_summary(record.summary)

    def write_poses(self, record: RunRecord) -> None:
        """Write frames and trajectories. May be called again as the run goes on: the last word holds."""
        self.write_frames(record.frames)
        main = record.main.in_time_order()
        write_tum(self.path / TRAJECTORY, main)
        write_kitti(self.path / TRAJECTORY_KITTI, main.T_world_cam, main.index, self.path / TRAJECTORY_KITTI_FRAMES)
        for submap_id, frames in record.unlinked.items():
            write_tum(self.path / SUBMAPS / _submap_name(submap_id), frames.in_time_order())
        # A submap that was written earlier in the run may be linked by now.
        kept = set(map(_submap_name, record.unlinked))
        for file in files_named(self.path / SUBMAPS, _SUBMAP_NAME):
            if file.name not in kept:
                file.unlink()

    def write_frames(self, rows: Iterable[FrameRow]) -> None:
        """Write ``frames.csv``."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(FRAME_COLUMNS)
        for row in rows:
            submap = "" if row.submap is None else row.submap
            counts = (int(bool(row.in_main_map)), row.n_matches, row.n_inliers)
            latency = f"{row.latency_ms:.3f}"
            sigmas = ["" if sigma is None else f"{sigma:.3g}" for sigma in (row.sigma_position_rel, row.sigma_scale)]
            time_s = repr(float(row.timestamp_s))
            found = ("" if row.method is None else str(row.method), row.doubt)
            writer.writerow([row.index, time_s, str(row.status), submap, *counts, latency, *sigmas, *found])
        write_text(self.path / FRAMES, text.getvalue())

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        write_summary(self.path, summary)

    def what_is_there(self) -> str:
        """Return a sentence on which results are written, and which are not: of a run that was cut off there."""
        is_there = {name: (self.path / name).exists() for name in _RESULTS}
        # A folder may be there before what it is for.
        is_there[f"{SUBMAPS}/"] = bool(unlinked_submaps(self.path))
        is_there[f"{MAP}/"] = (self.path / MAP / METADATA).exists()
        there = [name for name, found in is_there.items() if found]
        missing = [name for name, found in is_there.items() if not found and name not in _NOT_OF_EVERY_RUN]
        return f"In {self.path} are {', '.join(there)}; not written: {', '.join(missing) or 'nothing'}."

    def close(self) -> None:
        """Close the files and let another run in; more than once does no harm."""
        files, self._lines = list(self._lines.values()), {}
        try:
            for file in files:
                file.close()
        except OSError as e:
            raise OutputError(f"{self.path} cannot be written to: {e.strerror or e}.") from e
        finally:
            self._lock.release()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def write_summary(run: Path, summary: Mapping[str, Any]) -> None:
    """Write ``summary.json`` of a run folder; NaN becomes null, as JSON has none."""
    write_text(run / SUMMARY, json.dumps(to_plain(summary), indent=2, allow_nan=False) + "\n")


def check_vacant(path: Path, *, overwrite: bool) -> None:
    """Refuse a folder that a run must not write to. It changes nothing: to be asked before long work, too.

    Raises `OutputError` if there is an earlier run (or files of its names) and `overwrite` is not set. If it holds
    files of these names that no run has written, such as the ``groundtruth.txt`` of a sequence. If it is a file.
    """
    try:
        present = _run_files(path)
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path} cannot be written to: it is a file; choose another folder.")
    except OSError as e:
        raise _not_writable(path, e) from e
    if not present:
        return
    held = f"{path} holds {present[0].relative_to(path)} already"
    if not (path / EVENTS).exists():
        raise OutputError(f"{held}, and that is no run's (there is no {EVENTS}); choose another folder.")
    if not overwrite:
        raise OutputError(f"{held}; choose another folder, or say that it may be overwritten (--overwrite).")


def _not_writable(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path} cannot be written to: {error.strerror or error}; choose another folder.")


def _submap_name(submap_id: int) -> str:
    return f"{submap_id:02d}.txt"


def unlinked_submaps(run: str | Path) -> dict[int, Path]:
    """Return the trajectory files of a run's unlinked submaps, by submap id."""
    return {int(file.stem): file for file in sorted(files_named(Path(run) / SUBMAPS, _SUBMAP_NAME))}


def _run_files(folder: Path) -> list[Path]:
    found = [folder / name for name in _FILES if (folder / name).exists()]
    named = ((SUBMAPS, _SUBMAP_NAME), (SAMPLES, SAMPLE_NAME), (MAP, _MAP_NAME))
    return found + [file for name, pattern in named for file in files_named(folder / name, pattern)]


def files_named(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """Return the files of a folder whose whole name is of a pattern, in order; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(file for file in folder.iterdir() if file.is_file() and pattern.fullmatch(file.name))
