"""The maps of two runs as one: joined by places that both saw, solved in one graph, written as a run folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dualslam.atlas.stored_map import StoredMap, bring_to_pixels, renumbered
from dualslam.build import build_system, create_frontend
from dualslam.core.camera.mapped import own_camera
from dualslam.core.config.files import load_run_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.events import EventKind
from dualslam.core.metric_problem import MeasurementSource
from dualslam.core.resources import peak_rss_mb
from dualslam.io.export.exported_map import read_stored
from dualslam.io.run_folder import FRAMES, TRAJECTORIES_MERGED, TRAJECTORY, check_vacant
from dualslam.io.run_reading import read_frames, read_numbers, read_summary
from dualslam.io.trajectory_files import write_tum
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.map.frame_records import FrameRow
from dualslam.run.results import trajectories_of
from dualslam.run.runner import RunReport
from dualslam.run.session import save_system
from dualslam.system.audit.verdict import Level, Reason, ReasonCode
from dualslam.system.system import System

APART_S = 10.0
"""Between the last frame of the first run and the first of the second: no pose, step or measurement reaches across."""

JUDGED_ANEW = frozenset(
    {ReasonCode.NO_MAP, ReasonCode.UNPOSED, ReasonCode.UNJOINED, ReasonCode.DROPPED, ReasonCode.CLOCK}
    | {ReasonCode.MEASUREMENTS, ReasonCode.JUMP}
)
"""Reasons of a verdict that need no images: the merged run is asked again."""


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A run that is to be merged: its map, and its rows by their numbers in the map."""

    path: Path
    config: Config
    stored: StoredMap
    rows: list[FrameRow]
    summary: dict[str, Any]

    @classmethod
    def read(cls, path: Path) -> _Run:
        stored, config = read_stored(path), load_run_config(path)
        numbers = read_numbers(path)
        rows = [replace(row, index=numbers[row.index]) for row in read_frames(path / FRAMES)]
        return cls(path, config, stored, rows, read_summary(path))

    def after(self, first: _Run, scale_factor: float) -> tuple[_Run, float]:
        """Return it with numbers and times behind another run's, in the pixels of its map; and the shift of its clock.

        Times that lie behind the other run's stay.
        """
        end_s, begin_s = max(row.timestamp_s for row in first.rows), min(row.timestamp_s for row in self.rows)
        shift_s = 0.0 if begin_s > end_s else end_s + APART_S - begin_s
        n_submaps, n_frames = 1 + max(first.stored.atlas.submaps), first.n_frames
        atlas, poses = renumbered(self.stored.atlas, self.stored.poses, n_submaps, n_frames, shift_s)
        assert first.stored.camera is not None
        for submap in atlas.submaps.values():
            bring_to_pixels(submap, first.stored.camera.K, scale_factor)
        rows = [
            replace(
                row,
                index=row.index + n_frames,
                timestamp_s=row.timestamp_s + shift_s,
                submap=None if row.submap is None else row.submap + n_submaps,
            )
            for row in self.rows
        ]
        colours = {m + n_submaps: rgb for m, rgb in self.stored.colours.items()}
        stored = StoredMap(atlas, poses, self.stored.camera, colours)
        return replace(self, stored=stored, rows=rows), shift_s

    @property
    def reasons(self) -> list[Reason]:
        """What its verdict says that cannot be judged without its images; about all of its frames."""
        verdict = self.summary.get("verdict") or {"reasons": []}
        indices = [row.index for row in self.rows]
        return [
            Reason(code, Level(verdict["level"]), f"{self.path.name}: {reason['text']}", min(indices), max(indices))
            for reason in verdict["reasons"]
            if (code := ReasonCode(reason["code"])) not in JUDGED_ANEW
        ]

    @property
    def n_frames(self) -> int:
        """The first number that none of its frames has."""
        return max(self.stored.next_id, 1 + max(row.index for row in self.rows))

    def about(self, shift_s: float) -> dict[str, Any]:
        """Return what the summary of a merged run says of it."""
        return {
            "run": str(self.path),
            "first_frame": self.rows[0].index,
            "frames": len(self.rows),
            "clock_shift_s": shift_s,
            "submaps": sorted(self.stored.atlas.submaps),
            "verdict": self.summary.get("verdict"),
        }


def merge_runs(
    run_a: Path,
    run_b: Path,
    out: Path,
    *,
    overwrite: bool = False,
    measurements: Callable[[float], Sequence[MeasurementSource]] = lambda shift_s: (),
) -> System:
    """Join the maps of two runs, and write a run folder in the frame of the first one's map.

    `measurements`: gives those of both runs, given the shift of the second run's clock.

    Returns System: with the whole map.

    Raises `InputError` if a folder holds no map, the maps cannot be compared, or no place is in both.
    Raises `OutputError`.
    """
    check_vacant(out, overwrite=overwrite)
    if out.resolve() in (run_a.resolve(), run_b.resolve()):
        raise InputError(f"{out} holds one of the runs; give another folder to write to.")
    began, cpu_began = time.perf_counter(), time.process_time()
    a, b = _Run.read(run_a), _Run.read(run_b)
    if a.config.frontend.name != b.config.frontend.name:
        raise InputError(
            f"{run_a} was made with the front end {a.config.frontend.name} and {run_b} with "
            f"{b.config.frontend.name}: their descriptors cannot be compared. Run one of them again."
        )
    b, shift_s = b.after(a, create_frontend(a.config.frontend).scale_factor)
    config = a.config.with_section("recovery", workers=0)
    about = [a.about(0.0), b.about(shift_s)]
    system = _system_of(config, a, b)
    system.join(sorted(b.stored.atlas.submaps))
    system.rows.update((row.index, row) for row in (*a.rows, *b.rows))
    _check_joined(system, a, b)
    report = _report((a, b), time.perf_counter() - began, time.process_time() - cpu_began)
    assert a.stored.camera is not None
    sources = measurements(shift_s)
    try:
        save_system(
            system,
            config,
            own_camera(a.stored.camera),
            report,
            out,
            overwrite=overwrite,
            measurements=sources,
            given={"sequence": f"{run_a.name} and {run_b.name}", "merged": {"runs": about}},
            reasons=[*a.reasons, *b.reasons],
            colours={**a.stored.colours, **b.stored.colours},
        )
    finally:  # measurements that are refused leave the folder without them
        if (out / TRAJECTORY).is_file():
            main = trajectories_of(system).main
            of_b = main.index >= b.rows[0].index
            for name, rows, shift in zip(TRAJECTORIES_MERGED, (~of_b, of_b), (0.0, shift_s), strict=True):
                own = main.take(rows)
                write_tum(out / name, replace(own, timestamps_s=own.timestamps_s - shift).in_time_order())
    return system


def _system_of(config: Config, a: _Run, b: _Run) -> System:
    """Return a system that holds the maps and the frames of both runs."""
    camera = a.stored.camera
    assert camera is not None
    system = build_system(config, own_camera(camera), saved=a.stored, localise=True)
    atlas, other = system.atlas, b.stored.atlas
    for submap in other.submaps.values():
        atlas.add(submap)
    atlas.links += other.links
    atlas.placement |= other.placement
    atlas.warps |= other.warps
    atlas.held |= other.held
    system.poses.update(b.stored.poses)
    system.numbers = FrameNumbers()
    return system


def _check_joined(system: System, a: _Run, b: _Run) -> None:
    """Refuse two runs of which no submaps are joined."""
    main = set(trajectories_of(system).main_submaps)
    if main & b.stored.atlas.submaps.keys():
        return
    refused = [event.data for event in system.events.of_kind(EventKind.LOOP_REFUSED)]
    why = f" Of {len(refused)} that look alike the last was refused: {refused[-1]['detail']}." if refused else ""
    raise InputError(
        f"{a.path} and {b.path} have no place in common that their images prove.{why} "
        "Record a run that passes through a place of each."
    )


def _report(runs: Sequence[_Run], wall_s: float, cpu_s: float) -> RunReport:
    """Return what both runs and their merging have cost."""
    rows = [row for run in runs for row in run.rows]
    latencies_ms = tuple(row.latency_ms for row in rows)
    for run in runs:
        wall_s += run.summary.get("wall_s", 0.0)
        cpu_s += 1e-3 * run.summary.get("cpu_ms_per_frame", 0.0) * len(run.rows)
    return RunReport(
        n_frames=len(rows),
        latencies_ms=latencies_ms,
        steps_ms=latencies_ms,
        wall_s=wall_s,
        cpu_s=cpu_s,
        peak_rss_mb=peak_rss_mb(),
    )
