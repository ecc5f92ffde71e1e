"""From a finished run to the numbers of its trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from dualslam.core.events import Event, EventKind
from dualslam.core.types import FloatArray, FrameStatus
from dualslam.io.run_folder import FrameRow
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate
from dualslam.lab.bench.record import STATUS_LETTERS, Breakage
from dualslam.lab.metrics.alignment import align_points
from dualslam.lab.metrics.trajectory_metrics import MIN_POSES, score_trajectory

# Ground truth of fewer of the posed frames than this does not tell how long the path is: it is there in parts alone.
_WHOLE_TRUTH = 0.9
# Truth of both ends has a gap between them at least this long; truth of the whole is cut into tenths.
_END_GAP_S = 5.0
_END_SHARE = 0.1


def status_letters(rows: Iterable[FrameRow]) -> str:
    """Return a letter for each frame: its status; a capital where it is in the main map."""
    letters = ((STATUS_LETTERS[FrameStatus(row.status)], row.in_main_map) for row in rows)
    return "".join(letter.upper() if in_main else letter for letter, in_main in letters)


def initialisation(rows: Sequence[FrameRow], events: Iterable[Event]) -> tuple[int | None, float | None]:
    """Return at which of the frames the first map was initialised, and after how many seconds of the source."""
    first = next((e for e in events if e.event is EventKind.INITIALISED), None)
    if first is None:
        return None, None
    at = next(i for i, row in enumerate(rows) if row.index == first.frame)
    return at, abs(first.timestamp_s - rows[0].timestamp_s)


def breakages(events: Sequence[Event]) -> tuple[Breakage, ...]:
    """Return every loss of a map with what was tried to recover it.

    A recovery starts from a new submap and looks for the maps that are lost by then (``recovery_started``). Each
    ``recovery_attempt`` of that submap is its next attempt. A map searched by several recoveries counts the most
    attempts of one of them. A walk that is made again (``again``) is a retry: what it tries is no attempt of its own,
    since it is made where all attempts have failed, of a map that has grown. A map that was found again before another
    had started (``relocalised``) may be lost once more.
    """
    found: list[dict[str, Any]] = []
    last: dict[int, dict[str, Any]] = {}  # the last loss of each submap
    looked_for: dict[int, list[dict[str, Any]]] = {}  # by the recovery's submap
    made: Counter[int] = Counter()
    again: set[int] = set()  # submaps whose reverse tracking is a retry
    for event in events:
        submap = -1 if event.submap is None else event.submap
        if event.event is EventKind.FAILED:
            reason = str(event.data.get("reason", ""))
            last[submap] = {"submap": submap, "frame": event.frame, "reason": reason, "at_s": event.timestamp_s}
            found.append(last[submap])
        elif event.event is EventKind.RELOCALISED and submap in last:
            last[submap]["relocalised"] = True
        elif event.event is EventKind.REINITIALISED:
            for lost in found:
                if not lost.get("relocalised") and "restart_frames" not in lost:
                    lost["restart_frames"] = abs(event.frame - lost["frame"])
                    lost["restart_s"] = abs(event.timestamp_s - lost["at_s"])
        elif event.event is EventKind.RECOVERY_STARTED:
            looked_for[submap] = [last[m] for m in event.data.get("lost", ()) if m in last]
            if event.data.get("again"):
                again.add(submap)
                for lost in looked_for[submap]:
                    lost["retries"] = lost.get("retries", 0) + 1
            else:
                _count(looked_for[submap], 1)
        elif event.event is EventKind.RECOVERY_ATTEMPT and submap not in again:
            made[submap] += 1
            _count(looked_for.get(submap, []), made[submap])
        elif event.event is EventKind.LINKED and event.data.get("old_submap") in last:
            lost = last[event.data["old_submap"]]
            lost["recovery_s"] = event.data.get("seconds")
            if submap in again:
                lost["linked_by_retry"] = True
            else:
                attempt = max(made[submap], 1)
                lost |= {"attempts": attempt, "succeeded_at": attempt}
        elif event.event is EventKind.MERGED and event.data.get("other_submap") in last:
            last[event.data["other_submap"]]["merged"] = True
    return tuple(Breakage(**{name: value for name, value in lost.items() if name != "at_s"}) for lost in found)


def _count(losses: Iterable[dict[str, Any]], attempt: int) -> None:
    for lost in losses:
        lost["attempts"] = max(lost.get("attempts", 0), attempt)


def trajectory_error(main: Trajectory, truth: Trajectory, times_s: FloatArray) -> tuple[float | None, float | None]:
    """Return ATE and the length of the path, metres; None where too few frames have ground truth.

    Where ground truth is there in parts alone (TUM-Mono: start and end), the path is the estimate's own, in the unit
    that the alignment found.
    """
    ordered = main.in_time_order()
    score = score_trajectory(ordered, truth, times_s)
    path_m = score.path_m
    if score.scale is not None and score.compared < _WHOLE_TRUTH * score.posed:
        path_m = score.scale * _length(ordered.T_world_cam[:, :3, 3])
    return score.ate_rmse_m, path_m


def end_point_error(main: Trajectory, truth: Trajectory | None) -> float | None:
    """Return how far the end of the estimate is off where its start is right, for a camera that comes back.

    It is the alignment error of Engel et al. (2016), "A photometrically calibrated benchmark for monocular visual
    odometry": the estimate is aligned to the truth once by its start and once by its end, with a Sim(3) each. The error
    is the RMS distance between the two. None without truth at both ends.
    """
    if truth is None or len(main) == 0:
        return None
    ordered = main.in_time_order()
    row, near = associate(truth.timestamps_s, ordered.timestamps_s, MAX_DT_S)
    times = ordered.timestamps_s[near]
    if len(times) < 2 * MIN_POSES:
        return None
    estimated, true = ordered.T_world_cam[:, :3, 3], truth.T_world_cam[row[near], :3, 3]
    gap = int(np.argmax(np.diff(times)))
    tenth = max(MIN_POSES, int(_END_SHARE * len(times)))
    by_gap = np.diff(times)[gap] > _END_GAP_S
    start, end = (slice(0, gap + 1), slice(gap + 1, None)) if by_gap else (slice(0, tenth), slice(-tenth, None))
    placed = []
    for part in (start, end):
        if len(times[part]) < MIN_POSES:
            return None
        s, R, t = align_points(estimated[near][part], true[part])
        placed.append(s * estimated @ R.T + t)
    return float(np.sqrt(((placed[0] - placed[1]) ** 2).sum(axis=1).mean()))


def _length(positions: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
