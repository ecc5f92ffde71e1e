"""The verdict on a finished run, from what its audit has found and what the run itself knows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dualslam.core.estimates import MAX_PATH_CHANGE
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.noise_model import UNSURE_SCALE
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import Failure, FloatArray, FrameStatus, IntArray
from dualslam.map.frame_records import FrameRow
from dualslam.run.camera_judgement import judge_camera
from dualslam.run.claims import Claims, claims_in_atlas
from dualslam.run.measuring import MANY_REJECTED, Measured
from dualslam.run.results import Trajectories
from dualslam.system.audit.photometric import Disagreement, Sample, find_disagreement
from dualslam.system.audit.verdict import Level, Reason, ReasonCode, Verdict, measure_jumps
from dualslam.system.system import System

MAX_JUMP = 0.2
"""Share of the way of a stretch (`STRETCH_S`). A jump of so much leaves a quarter of itself, RMS, when the stretch is
laid on the truth: then its shape is 5 % of the way off, and broken (docs/bench.md)."""
MIN_MOTION_DEPTHS = 0.02
"""Length over the median depth of the scene: shorter ones are noise of single frames."""
MIN_COVERAGE = 0.95
"""Share of the frames that can be posed."""
MAX_UNSURE = 0.1
"""Share of frames with an unsure scale: right runs of a hand-held camera that mostly turns have up to 7 %."""
MIN_COMPARED = 5
"""Keyframes by which two maps are compared: a similarity alone fits two of them, and most paths of three."""
STOOD_S = 1.0
"""For so long at least a camera has stood when it is found to: seven images, a fifth of a second apart, show it."""
INTERVALS_S = (1e-3, 2.0)
"""Median time between two frames: outside, timestamps are in another unit, or not those of the frames."""


def judge_run(
    system: System,
    trajectories: Trajectories,
    rows: Sequence[FrameRow],
    crashed: bool = False,
    measured: Measured | None = None,
    besides: Iterable[Reason] = (),
    claims: Claims | None = None,
) -> Verdict:
    """Judge a run that has ended.

    - `trajectories`: of `trajectories_of`.
    - `rows`: of `frame_rows`: one for each frame of the source.
    - `measured`: the run in the frame of measurements from outside.
    - `besides`: what is known against it already.
    - `claims`: those of `claims_in_atlas`, if they are there already.
    """
    if not rows:
        return Verdict(Level.DOUBTFUL)
    reasons, scores = [*besides, *_coverage(system, rows), *_clock(rows)], dict[str, float]()
    if crashed:
        text = "The run crashed: what it had found until then was kept. Report the error, and run again."
        reasons.append(_about_all(rows, ReasonCode.CRASHED, Level.USABLE, text))
    if len(trajectories.main):
        index, jumps = _measure_jumps(system, trajectories.main)
        found = find_disagreement(_held_samples(system, trajectories))
        reasons += [*_jumps(index, jumps), *_photometric(system, found), *_still(system, trajectories)]
        reasons += _scale(rows, _loosely_joined(system, trajectories))
        reasons += _replaced(system, trajectories, claims)
        camera, scores = judge_camera(system)
        reasons += [] if camera is None else [_about_all(rows, *camera)]
        reasons += _zoom(system, rows)
        scores |= {
            str(ReasonCode.JUMP): float(jumps.max(initial=0.0)),
            str(ReasonCode.PHOTOMETRIC): found.worst,
        }
    if measured is not None:
        reasons += _measurements(rows, measured)
    return Verdict.of(reasons, scores)


def _about_all(rows: Sequence[FrameRow], code: ReasonCode, level: Level, text: str) -> Reason:
    """Return a reason that is about the whole run."""
    return Reason(code, level, text, *sorted((rows[0].index, rows[-1].index)))


# --- what is posed


def _coverage(system: System, rows: Sequence[FrameRow]) -> list[Reason]:
    main = [row for row in rows if row.in_main_map]
    if not main:
        text = "No frame has a pose. The last line of the run says why no map started."
        return [_about_all(rows, ReasonCode.NO_MAP, Level.DOUBTFUL, text)]
    blank = {system.numbers.index_of(i) for i in system.blank}
    outside = [row for row in rows if not row.in_main_map]
    missing = [row for row in outside if row.index not in blank]
    if len(main) >= MIN_COVERAGE * (len(main) + len(missing)):
        return _blank(rows, sorted(row.index for row in outside if row.index in blank))
    dropped = [row for row in missing if row.status is FrameStatus.DROPPED]
    apart = [row for row in missing if system.numbers.number_of(row.index) in system.poses]
    counted = {row.index for row in (*dropped, *apart)}
    unposed = [row for row in missing if row.index not in counted]
    if len(dropped) == max(len(apart), len(dropped), len(unposed)):
        text = (
            f"{len(dropped)} frames came too late. Use a faster machine or smaller images, or run without --realtime."
        )
        return [_about_all(rows, ReasonCode.DROPPED, Level.USABLE, text)]
    if len(apart) > len(unposed):
        first, last = sorted((apart[0].index, apart[-1].index))
        text = (
            f"{len(apart)} frames from {first} to {last} are in maps that could not be joined to the main one. "
            "Their trajectories are in submaps/, each in its own unit. To join them, record the place again with "
            "something in view that does not repeat, or give measurements (--measurements)."
        )
        return [Reason(ReasonCode.UNJOINED, Level.USABLE, text, first, last)]
    first, last = _longest_run(rows, sorted(row.index for row in unposed))
    text = (
        f"{len(unposed)} frames have no pose; the longest stretch is {first} to {last}. "
        "Move slower there, with more light and texture in view."
    )
    return [Reason(ReasonCode.UNPOSED, Level.USABLE, text, first, last)]


def _blank(rows: Sequence[FrameRow], blank: list[int]) -> list[Reason]:
    """Return a remark where many frames could not be posed."""
    if len(blank) <= (1.0 - MIN_COVERAGE) * len(rows):
        return []
    first, last = _longest_run(rows, blank)
    text = (
        f"{len(blank)} frames have no pose: they show too little, or nothing that leads to a frame with a pose. "
        f"The longest stretch is {first} to {last}. Poses beside them do not suffer."
    )
    return [Reason(ReasonCode.UNPOSED, Level.GOOD, text, first, last)]


def _longest_run(rows: Sequence[FrameRow], indices: list[int]) -> tuple[int, int]:
    """Return first and last of the longest run of neighbouring frames among some with ascending indices."""
    places = np.searchsorted(sorted(row.index for row in rows), indices)
    parts = np.split(np.array(indices), np.flatnonzero(np.diff(places) > 1) + 1)
    longest = max(parts, key=len)
    return int(longest[0]), int(longest[-1])


# --- what is wrong


def _measure_jumps(system: System, main: Trajectory) -> tuple[IntArray, FloatArray]:
    """Return the frames of the main trajectory but those that repeat the image before them, and the jumps between."""
    repeated = {system.numbers.index_of(i) for i in system.audit.repeated}
    main = main.in_time_order()
    main = main.take(np.array([i not in repeated for i in main.index.tolist()], bool))
    return main.index, measure_jumps(main.timestamps_s, main.T_world_cam[:, :3, 3])


def _jumps(index: IntArray, jumps: FloatArray) -> list[Reason]:
    if jumps.max(initial=0.0) <= MAX_JUMP:
        return []
    worst = int(np.argmax(jumps))
    first, last = sorted(index[worst : worst + 2].tolist())
    text = (
        f"Between frames {first} and {last} the camera jumps by {100 * jumps[worst]:.0f} % of what it goes in 2 s. "
        "Two places that look alike may have been joined, or poses there hang on false matches. "
        "Do not trust where both sides lie to each other."
    )
    return [Reason(ReasonCode.JUMP, Level.DOUBTFUL, text, first, last)]


def _median_depth(system: System, trajectories: Trajectories, index: int) -> float:
    """Return the median depth of what a frame's keyframe sees, in the unit of the main map."""
    pose = system.poses[system.numbers.number_of(index)]
    submap = system.atlas.submaps[pose.submap_id]
    depths = submap.depths_in(submap.keyframe_for(pose.keyframe_id))
    scale = float(sim3.scale(trajectories.S_world_submap[pose.submap_id]))
    return scale * float(np.median(depths)) if len(depths) else 0.0


def _held_samples(system: System, trajectories: Trajectories) -> list[Sample]:
    """Return the samples whose frame is still posed in the map that was compared, which is part of the main one."""
    poses = system.poses
    held = [s for s in system.audit.samples if s.submap_id in trajectories.S_world_submap and s.index in poses]
    return [s for s in held if poses[s.index].submap_id == s.submap_id]


def _photometric(system: System, found: Disagreement) -> list[Reason]:
    if not found.stretches:
        return []
    worst = max(found.stretches, key=lambda s: s.last - s.first)
    first, last = sorted(system.numbers.index_of(i) for i in (worst.first, worst.last))
    text = (
        f"From frame {first} to {last} the images disagree with the map: {100 * worst.agreement:.0f} % of the patches "
        "look as predicted. Something that moves may have been followed, or a turn lost. Do not use the poses there, "
        "nor how what follows lies to what came before. Mask what moves."
    )
    return [Reason(ReasonCode.PHOTOMETRIC, Level.DOUBTFUL, text, first, last)]


def _scale(rows: Sequence[FrameRow], loose: set[int]) -> list[Reason]:
    """Return where the scale is unsure, if that is at many frames; `loose`: where a link leaves it so."""
    sigma = {row.index: row.sigma_scale or 0.0 for row in rows if row.in_main_map}
    unsure = [i for i in sorted(sigma) if i in loose or sigma[i] > UNSURE_SCALE]
    if len(unsure) <= MAX_UNSURE * len(sigma):
        return []
    first, last = _longest_run(rows, unsure)
    text = (
        f"The size of the path at {len(unsure)} frames, mostly {first} to {last}, is hardly tied to that of the rest: "
        "it may be 10 to 20 % too large or too small. "
        "Too little is seen from both sides. Move sideways there, turn more slowly, or come back to the place."
    )
    return [Reason(ReasonCode.SCALE, Level.USABLE, text, first, last)]


def _measurements(rows: Sequence[FrameRow], measured: Measured) -> list[Reason]:
    if measured.undone:
        pairs = ", ".join(f"{link.a} and {link.b}" for link in measured.undone)
        text = f"The measurements contradict the join of submaps {pairs}: it was undone. Compare the two places."
        return [_about_all(rows, ReasonCode.MEASUREMENTS, Level.USABLE, text)]
    if measured.is_consistent and measured.rejected_share <= MANY_REJECTED:
        return []
    text = (
        f"Map and measurements disagree: {100 * measured.rejected_share:.0f} % of the measurements were outvoted, and "
        f"the rest are {measured.main.misfit_sigmas:.1f} standard deviations off. Check their sigmas, clock and axes."
    )
    return [_about_all(rows, ReasonCode.MEASUREMENTS, Level.USABLE, text)]


def _loosely_joined(system: System, trajectories: Trajectories) -> set[int]:
    """Return the frames that are joined to most others by links alone that hardly know their scale."""
    main = trajectories.main.index.tolist()
    submap_of = {i: system.poses[system.numbers.number_of(i)].submap_id for i in main}
    frames = [{i for i in main if submap_of[i] in part} for part in system.atlas.components(sure=True)]
    return set(main) - max(frames, key=len)


def _replaced(system: System, trajectories: Trajectories, claims: Claims | None) -> list[Reason]:
    """Find frames that the main map has taken from another one whose path it contradicts: one is wrong.

    Where the other map does not know its own scale, it contradicts nothing.
    """
    centres = dict(zip(trajectories.main.index.tolist(), trajectories.main.T_world_cam[:, :3, 3], strict=True))
    for earlier in (submap for m, submap in system.atlas.submaps.items() if m not in trajectories.main_submaps):
        index_of = {system.numbers.index_of(k): k for k in sorted(earlier.keyframes.keys() - earlier.condemned)}
        index = [i for i in index_of if i in centres]
        if len(index) >= MIN_COMPARED:
            claims = claims_in_atlas(system.atlas) if claims is None else claims
            index = [i for i in index if not claims[earlier.id][index_of[i]].sigma_scale > UNSURE_SCALE]
        if len(index) < MIN_COMPARED:
            continue
        was = earlier.keyframe_poses(np.array([index_of[i] for i in index]))[:, :3, 3]
        now = np.array([centres[i] for i in index])
        path, aligned = float(np.linalg.norm(np.diff(now, axis=0), axis=1).sum()), umeyama(was, now)
        noise = MIN_MOTION_DEPTHS * _median_depth(system, trajectories, index[len(index) // 2])
        if isinstance(aligned, Failure) or aligned.rmse < max(MAX_PATH_CHANGE * path, noise):
            continue
        first, last = min(index), max(index)
        text = (
            f"Two maps of frames {first} to {last} contradict each other by {100 * aligned.rmse / path:.0f} % of "
            "the path. The larger one was kept. Compare with a run backwards (--reverse)."
        )
        return [Reason(ReasonCode.REPLACED, Level.USABLE, text, first, last)]
    return []


def _still(system: System, trajectories: Trajectories) -> list[Reason]:
    """Return where most of the image stood still, as that of a camera at rest, and the map moved the camera."""
    main, numbers = trajectories.main, system.numbers
    for event in system.events.of_kind(EventKind.CAMERA_STANDS):
        near = np.flatnonzero(np.abs(main.timestamps_s - event.timestamp_s) <= STOOD_S)
        rows = np.array([n for n in near.tolist() if numbers.number_of(int(main.index[n])) <= event.frame], np.int64)
        if len(rows) < 2:
            continue
        moved = float(np.ptp(main.T_world_cam[rows, :3, 3], axis=0).max())
        if moved > MIN_MOTION_DEPTHS * _median_depth(system, trajectories, int(main.index[rows[0]])):
            first, last = sorted((int(main.index[rows[0]]), int(main.index[rows[-1]])))
            text = (
                f"From frame {first} to {last} most of the image stands still, but the camera moves in the map. "
                "Something that moves may have been followed. Do not use this map. Mask what moves."
            )
            return [Reason(ReasonCode.STILL, Level.DOUBTFUL, text, first, last)]
    return []


def _zoom(system: System, rows: Sequence[FrameRow]) -> list[Reason]:
    """Return from which frame on the focal length is another one."""
    reasons = []
    for event in system.events.of_kind(EventKind.FOCAL_CHANGED):
        since, change = system.numbers.index_of(event.frame), float(np.expm1(event.data["log_change"]))
        text = (
            f"From about frame {since} on the focal length is {100 * abs(change):.0f} % "
            f"{'longer' if change > 0 else 'shorter'} than before, and the map may be bent. Lock zoom and focus."
        )
        reasons.append(Reason(ReasonCode.ZOOM, Level.USABLE, text, *sorted((since, rows[-1].index))))
    return reasons


# --- clock


def _clock(rows: Sequence[FrameRow]) -> list[Reason]:
    times_s = np.array([row.timestamp_s for row in rows])
    if len(times_s) < 3:
        return []
    intervals_s = np.diff(times_s)
    usual_s = float(np.median(intervals_s))
    backwards = int((np.sign(intervals_s) != np.sign(usual_s)).sum())
    low, high = INTERVALS_S
    if low <= abs(usual_s) <= high and not backwards:
        return []
    problem = (
        f"{backwards} of {len(times_s)} timestamps repeat or go backwards"
        if backwards
        else f"The median time between two frames is {abs(usual_s):.3g} s"
    )
    text = f"{problem}. Check the clock or the unit of the timestamps: the trajectory has them, too."
    return [_about_all(rows, ReasonCode.CLOCK, Level.GOOD, text)]
