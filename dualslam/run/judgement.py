"""The verdict on a finished run, from what its audit has found and what the run itself knows."""

from __future__ import annotations

import numpy as np

from dualslam.audit.photometric import Sample, disagreeing_stretches
from dualslam.audit.steps import measure_steps
from dualslam.audit.verdict import Level, Reason, ReasonCode, Verdict
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray
from dualslam.run.results import Trajectories
from dualslam.system import System

MAX_STEP_RATIO = 12.0
"""A step of so many times the median of those about it is a jump. Right runs have at most 7, false joins 34 to 199."""
MIN_JUMP_DEPTHS = 0.02
"""Length of a jump over the median depth of the scene: shorter ones are noise of single frames."""
MIN_COVERAGE = 0.95
"""Share of the frames that can be posed."""
MAX_FOCAL_SIGMA = 0.03
"""Standard deviation of the logarithm of the focal length."""
INTERVALS_S = (1e-3, 2.0)
"""Median time between two frames: outside, timestamps are in another unit, or not those of the frames."""


def judge_run(system: System, trajectories: Trajectories, dropped: int = 0, crashed: bool = False) -> Verdict:
    """Judge a run that has ended.

    Parameters
    ----------
    system : System
    trajectories : Trajectories
    dropped : int
        Frames that came too late (real time).
    crashed : bool
    """
    reasons = _coverage(system, trajectories, dropped) + _clock(system)
    if crashed:
        text = "The run crashed: what it had found until then was kept. Report the error, and run again."
        reasons.append(_about_all(system, ReasonCode.CRASHED, Level.USABLE, text))
    if len(trajectories.main):
        reasons += _jumps(system, trajectories) + _photometric(system, trajectories) + _focal(system)
    return Verdict.of(reasons)


def _about_all(system: System, code: ReasonCode, level: Level, text: str) -> Reason:
    """Return a reason that is about the whole run."""
    indices = [system.numbers.index_of(i) for i in system.rows] or [0]
    return Reason(code, level, text, min(indices), max(indices))


def _about(system: System, code: ReasonCode, level: Level, text: str, first: int, last: int) -> Reason:
    """Return a reason about the frames between two numbers."""
    ends = (system.numbers.index_of(first), system.numbers.index_of(last))
    return Reason(code, level, text.format(*sorted(ends)), min(ends), max(ends))


# --- what is posed


def _coverage(system: System, trajectories: Trajectories, dropped: int) -> list[Reason]:
    n_main, rows = len(trajectories.main), system.rows
    if not n_main:
        text = "No frame has a pose. The last line of the run says why no map started."
        return [_about_all(system, ReasonCode.NO_MAP, Level.DOUBTFUL, text)]
    n_apart = sum(len(each) for each in trajectories.unlinked.values())
    in_main = set(trajectories.main.index.tolist())
    missing = [i for i in rows if system.numbers.index_of(i) not in in_main and i not in system.blank]
    n_possible = n_main + len(missing) + dropped
    if n_main >= MIN_COVERAGE * n_possible:
        return []
    reasons = []
    unposed = [i for i in missing if i not in system.poses]
    if dropped > len(missing):
        text = (
            f"{dropped} frames came too late and were dropped. Use a faster machine, smaller images, or no --realtime."
        )
        reasons.append(_about_all(system, ReasonCode.DROPPED, Level.USABLE, text))
    if n_apart > len(unposed):
        apart = [i for i in missing if i in system.poses]
        text = (
            f"{n_apart} frames from {{0}} to {{1}} are in maps that could not be joined to the main one. "
            "Their trajectories are in submaps/, each in its own unit. A recording that returns there would join them."
        )
        reasons.append(_about(system, ReasonCode.UNJOINED, Level.USABLE, text, apart[0], apart[-1]))
    elif unposed:
        text = (
            f"{len(unposed)} frames have no pose; the longest stretch is {{0}} to {{1}}. "
            "Move slower there, with more light and texture in view."
        )
        reasons.append(_about(system, ReasonCode.UNPOSED, Level.USABLE, text, *_longest(unposed)))
    return reasons


def _longest(numbers: list[int]) -> tuple[int, int]:
    """Return first and last of the longest run of neighbours among ascending numbers."""
    parts = np.split(np.array(numbers), np.flatnonzero(np.diff(numbers) > 1) + 1)
    longest = max(parts, key=len)
    return int(longest[0]), int(longest[-1])


# --- what is wrong


def _jumps(system: System, trajectories: Trajectories) -> list[Reason]:
    main = trajectories.main.in_time_order()
    steps = measure_steps(main.timestamps_s, main.T_world_cam[:, :3, 3])
    suspected = np.flatnonzero(steps.ratio > MAX_STEP_RATIO).tolist()
    depth = {n: _median_depth(system, trajectories, int(main.index[n])) for n in suspected}
    found = [n for n in suspected if steps.excess[n] > MIN_JUMP_DEPTHS * depth[n]]
    if not found:
        return []
    worst = max(found, key=lambda n: float(steps.ratio[n]))
    a, b = sorted(main.index[worst : worst + 2].tolist())
    text = (
        f"Between frames {a} and {b} the camera jumps: {steps.ratio[worst]:.0f} times its speed about there. "
        "Two places that look alike may have been joined. Do not trust where both sides lie to each other."
    )
    return [Reason(ReasonCode.JUMP, Level.DOUBTFUL, text, a, b)]


def _median_depth(system: System, trajectories: Trajectories, index: int) -> float:
    """Return the median depth of what a frame's keyframe sees, in the unit of the main map."""
    pose = system.poses[system.numbers.number_of(index)]
    submap = system.atlas.submaps[pose.submap_id]
    k = submap.keyframe_for(pose.keyframe_id)
    ids = submap.landmark_of[k]
    depths = submap.depths(ids[ids >= 0], se3.inverse(submap.T_submap_kf[k]))
    scale = float(sim3.scale(trajectories.S_world_submap[pose.submap_id]))
    return scale * float(np.median(depths)) if len(depths) else 0.0


def _photometric(system: System, trajectories: Trajectories) -> list[Reason]:
    def holds(sample: Sample) -> bool:
        """Whether the frame is still posed in the map that was compared, and that map is part of the main one."""
        pose = system.poses.get(sample.index)
        return pose is not None and pose.submap_id == sample.submap_id in trajectories.S_world_submap

    stretches = disagreeing_stretches(sample for sample in system.audit.samples if holds(sample))
    if not stretches:
        return []
    worst = max(stretches, key=lambda s: s.last - s.first)
    text = (
        f"From frame {{0}} to {{1}} the images disagree with the map: {100 * worst.agreement:.0f} % of the patches "
        "look as predicted. Something that moves may have been followed. Do not use the poses there; mask what moves."
    )
    return [_about(system, ReasonCode.PHOTOMETRIC, Level.DOUBTFUL, text, worst.first, worst.last)]


# --- camera and clock


def _focal(system: System) -> list[Reason]:
    sigma = system.log_focal_sigma
    if sigma is None or sigma < MAX_FOCAL_SIGMA:
        return []
    text = (
        f"The focal length is known to {100 * sigma:.0f} % only. "
        "Give a calibration with --camera, or record more sideways motion."
    )
    return [_about_all(system, ReasonCode.FOCAL, Level.USABLE, text)]


def _clock(system: System) -> list[Reason]:
    times_s: FloatArray = np.array([row.timestamp_s for row in system.rows.values()])
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
    text = f"{problem}. Check the clock or the unit of the timestamps: motion is predicted by them."
    return [_about_all(system, ReasonCode.CLOCK, Level.USABLE, text)]
