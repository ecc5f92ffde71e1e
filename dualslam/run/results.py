"""From a finished system to what a run leaves behind: composed trajectories, a row for every frame, and the summary."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from platform import python_version
from typing import Any

import numpy as np

from dualslam.atlas.atlas import LinkKind
from dualslam.atlas.trajectory import compose
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.resources import MB, peak_rss_mb
from dualslam.core.types import FloatArray
from dualslam.io.run_folder import FrameRow
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate
from dualslam.lab.metrics.trajectory_metrics import score_trajectory
from dualslam.run.claims import Claims, claims_in_atlas
from dualslam.run.runner import RunReport
from dualslam.system.audit.verdict import Verdict
from dualslam.system.system import System
from dualslam.workers.desk import WorkerDesk

log = logging.getLogger(__name__)

PACKAGES = ("dualslam", "numpy", "scipy", "opencv-python-headless", "gtsam", "poselib", "pydantic")
PACKAGES_OF_EXTRAS = ("torch", "kornia")
"""Named where a front end has loaded them; their modules have the packages' names."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """All poses of a run."""

    main_submaps: list[int]  # the largest linked set of submaps, by the number of posed frames: the main map
    main: Trajectory  # frames posed in it
    unlinked: dict[int, Trajectory]  # each other submap, in its own unit
    S_world_submap: dict[int, FloatArray]  # dict of int to (4, 4) float64: where the main submaps lie


def trajectories_of(system: System) -> Trajectories:
    """Compose the poses of all frames, each from its own keyframe, by the current map.

    Raises
    ------
    InputError
        If it is given no system, such as the path of a run folder.
    """
    if not hasattr(system, "atlas"):
        raise InputError(
            f"trajectories_of takes a system, not a {type(system).__name__}; "
            "of a run folder, read_run has the trajectories: main and unlinked."
        )
    atlas, count = system.atlas, Counter(p.submap_id for p in system.poses.values() if p.index in system.rows)
    # A saved map is the main one, whatever this run has besides.
    largest = atlas.largest(count) if system.world is None else atlas.component_of(system.world)
    unlinked = {m: _posed(system, _placed(system, [m])) for m in atlas.submaps if m not in largest and count[m]}
    S_world_submap = _placed(system, largest)
    return Trajectories(largest, _posed(system, S_world_submap), unlinked, S_world_submap)


def frame_rows(
    system: System,
    main: Trajectory | None = None,
    latencies_ms: Mapping[int, float] | None = None,
    claims: Claims | None = None,
) -> list[FrameRow]:
    """Return a row for every frame of the source, in the order in which they came: those of ``frames.csv``.

    Unlike `System.rows` they name a frame by its index in the source, and know what is known at the end.

    Parameters
    ----------
    system : System
    main : Trajectory, optional
        That of `trajectories_of`, if it is there already.
    latencies_ms : mapping of int to float, optional
        Of the frames that were tracked, by their index, as the harness measured them. Else that of their steps.
    claims : Claims, optional
        For the columns ``sigma_*``: those of `claims_in_atlas`, if they are there already. Without any, {}, they are
        empty.
    """
    in_main = set((trajectories_of(system).main if main is None else main).index.tolist())
    claims = claims_in_atlas(system.atlas) if claims is None else claims
    return [
        replace(
            _with_claim(system, row, claims),
            index=system.numbers.index_of(row.index),
            in_main_map=system.numbers.index_of(row.index) in in_main,
            latency_ms=(latencies_ms or {}).get(system.numbers.index_of(row.index), row.latency_ms),
            method=row.method if row.index in system.poses else None,
        )
        for row in list(system.rows.values())
    ]


def _with_claim(system: System, row: FrameRow, claims: Claims) -> FrameRow:
    """Return a frame's row with what the map claims of the keyframe that it hangs on."""
    pose = system.poses.get(row.index)
    if pose is None or not claims:
        return row
    claim = claims[pose.submap_id][system.atlas.submaps[pose.submap_id].keyframe_for(pose.keyframe_id)]
    known = [None if np.isnan(sigma) else sigma for sigma in (claim.sigma_position_rel, claim.sigma_scale)]
    return replace(row, sigma_position_rel=known[0], sigma_scale=known[1])


def summarise(
    system: System,
    report: RunReport,
    trajectories: Trajectories,
    config: Config,
    truth: Trajectory | None = None,
    verdict: Verdict | None = None,
) -> dict[str, Any]:
    """Return what ``summary.json`` holds.

    ``coverage`` is the share of all frames, dropped ones too, that have a pose in the main map (0 to 1).
    """
    main = trajectories.main
    posed = len(main)
    summary: dict[str, Any] = {
        **({} if verdict is None else {"verdict": verdict.as_dict()}),
        "frames": report.n_frames,
        "posed": posed,
        "coverage": posed / report.n_frames if report.n_frames else 0.0,
        "posed_in_all_submaps": posed + sum(len(frames) for frames in trajectories.unlinked.values()),
        "failures": len(system.events.of_kind(EventKind.FAILED)),
        "recoveries": sum(link.kind is LinkKind.RECOVERY for link in system.atlas.believed),
        "relocalised": len(system.events.of_kind(EventKind.RELOCALISED)),
        "loops": len(system.events.of_kind(EventKind.LOOP_CLOSED)),
        "merges": len(system.events.of_kind(EventKind.MERGED)),
        "first_id": system.numbers.first_id,
        "first_index": system.numbers.first_index,
        "recoveries_failed": len(system.events.of_kind(EventKind.RECOVERY_FAILED)),
        "submaps": len(system.atlas.submaps),
        "links": len(system.atlas.believed),
        "connections": dict(Counter(str(link.kind) for link in system.atlas.believed)),
        "rejected_connections": sum(link.rejected for link in system.atlas.links),
        "keyframes": sum(len(submap.keyframes) for submap in system.atlas.submaps.values()),
        "saved_keyframes": sum(
            k < system.numbers.first_id for submap in system.atlas.submaps.values() for k in submap.keyframes
        ),
        "landmarks": sum(int(submap.landmarks["alive"].sum()) for submap in system.atlas.submaps.values()),
        "condemned_keyframes": sum(len(submap.condemned) for submap in system.atlas.submaps.values()),
        "condemned_landmarks": sum(int(s.landmarks["condemned"].sum()) for s in system.atlas.submaps.values()),
        "seed": config.seed,
        "dropped": len(report.dropped),
        "interrupted": report.interrupted,
        "crashed": report.bug is not None,
        "fps": report.fps,
        "wall_s": report.wall_s,
        "cpu_ms_per_frame": 1e3 * report.cpu_s / max(len(report.latencies_ms), 1),
        "latency_ms": _latency(report.latencies_ms),
        "step_ms": _latency(report.steps_ms),
        "late": report.n_late,
        "pace": asdict(system.pace.statistics),
        "beside": _beside(system),
        "recovery_s": [
            event.data["seconds"] for event in system.events.of_kind(EventKind.LINKED) if "seconds" in event.data
        ],
        "peak_rss_mb": report.peak_rss_mb,
        "peak_rss_own_mb": peak_rss_mb(),
        "peak_buffer_mb": system.buffer.peak_bytes / MB,
        "stages_cpu_s": {name: stage.seconds for name, stage in system.timer.stages.items()},
        "stages_calls": {name: stage.calls for name, stage in system.timer.stages.items()},
        "stages_wall_s": {name: stage.wall_s for name, stage in system.timer.stages.items() if stage.wall_s},
        "stages_longest_ms": {name: 1e3 * s.longest_s for name, s in system.timer.stages.items() if s.wall_s},
        "versions": versions(),
    }
    if truth is not None:
        summary |= _errors(system, main, truth, report)
    return summary


def truth_of_frames(truth: Trajectory, rows: Iterable[FrameRow]) -> Trajectory:
    """Return the true poses that are nearest to the frames in time, each once, on the truth's own clock; no NaN."""
    pose, near = associate(truth.timestamps_s, np.array([row.timestamp_s for row in rows]), MAX_DT_S)
    chosen = np.unique(pose[near])
    chosen = chosen[np.isfinite(truth.T_world_cam[chosen]).all(axis=(1, 2))]
    return Trajectory(truth.timestamps_s[chosen], truth.T_world_cam[chosen])


def versions() -> dict[str, str]:
    """Return the versions that a run's numbers depend on."""
    found = {"python": python_version()}
    for name in (*PACKAGES, *(extra for extra in PACKAGES_OF_EXTRAS if extra in sys.modules)):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def _placed(system: System, submap_ids: list[int]) -> dict[int, FloatArray]:
    """Return where linked submaps lie in the world: the saved map's, or the first one's."""
    S_world_submap = system.atlas.S_world_submap(submap_ids) if submap_ids else {}
    if system.world in S_world_submap:
        S_world_first = sim3.inverse(S_world_submap[system.world])
        S_world_submap = {m: S_world_first @ S for m, S in S_world_submap.items()}
    return S_world_submap


def _posed(system: System, S_world_submap: dict[int, FloatArray]) -> Trajectory:
    own = (pose for pose in system.poses.values() if pose.index in system.rows)
    composed = compose(own, system.atlas, S_world_submap)
    index = np.array([system.numbers.index_of(i) for i in composed.index.tolist()], np.int64)
    order = np.argsort(index, kind="stable")  # a source that was read from its end: files ascend all the same
    return Trajectory(composed.timestamps_s[order], composed.T_world_cam[order], index[order])


def _beside(system: System) -> dict[str, Any]:
    """Statistics of the jobs in processes of their own, by kind: counts, the longest queue and wait, CPU time."""
    desk = system.desk.executor
    return {str(kind): asdict(each) for kind, each in desk.statistics.items()} if isinstance(desk, WorkerDesk) else {}


def _latency(latencies_ms: tuple[float, ...]) -> dict[str, float]:
    if not latencies_ms:
        return {}
    median, p95, p99 = np.percentile(latencies_ms, [50, 95, 99]).tolist()
    return {"median": median, "p95": p95, "p99": p99, "max": max(latencies_ms)}


def _errors(system: System, main: Trajectory, truth: Trajectory, report: RunReport) -> dict[str, Any]:
    """Return the errors; ``no_errors`` with the reason where the truth, which others made, cannot be used."""
    times = [row.timestamp_s for row in system.rows.values()]
    if len(times) < 2 or not len(main):
        return {}
    try:
        score = asdict(score_trajectory(main.in_time_order(), truth, np.array(times)))
    except (InputError, ValueError, ArithmeticError) as error:  # what the run has found is written all the same
        log.warning("the run is not held against its ground truth: %s", error)
        return {"no_errors": str(error)}
    return {
        "ate_rmse_m": score["ate_rmse_m"],
        "rpe": {
            "interval_s": 1.0,
            "rotation_deg_median": score["rpe_1s_rot_deg_median"],
            "translation_pct_median": score["rpe_1s_trans_pct_median"],
        },
    }
