"""Judge whether the parts of a trajectory before and after a disturbance are joined, and joined rightly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualslam.core.geometry import sim3, so3
from dualslam.core.types import FloatArray, IntArray
from dualslam.lab.audits.link_audit import CERTAIN_SIGMAS, Side, align_cameras
from dualslam.lab.audits.silent_breaks import MAX_SCALE_RATIO

MIN_FRAMES = 10
"""Posed frames; with fewer on either side, the parts are not joined."""
MAX_FRAMES = 45
"""Posed frames nearest to the disturbance that stand for a side: enough for a scale, few enough to drift little."""
MAX_OFFSET = 0.05
"""Largest error of position of the part after the disturbance, relative to the true path; the limit of a wrong link."""
MAX_TURN_DEG = 5.0
"""Largest error of rotation between the parts. A true turn between them is often lost by a degree or two."""


class JoinOutcome(StrEnum):
    """How the parts before and after a disturbance lie to each other in the main map."""

    RIGHT = "right"
    WRONG = "wrong"
    NOT_JOINED = "not joined"


@dataclass(frozen=True, slots=True)
class JoinAudit:
    """The parts before and after a disturbance, compared with the truth.

    Attributes
    ----------
    outcome : JoinOutcome
    n_before, n_after : int
        Posed frames of the main map on either side.
    offset_m : float or None
        Distance between the part after and the truth, once the part before is aligned; None where not joined.
    scale_ratio : float or None
        Scale of the part after over that of the part before, both aligned by themselves.
    turn_deg : float or None
        Error of rotation between the parts.
    """

    outcome: JoinOutcome
    n_before: int
    n_after: int
    offset_m: float | None = None
    scale_ratio: float | None = None
    turn_deg: float | None = None


def audit_join(
    index: IntArray,
    T_world_cam: FloatArray,
    T_true: FloatArray,
    first: int,
    after: int,
    tolerance_m: float | None = None,
) -> JoinAudit:
    """Judge the join across the frames ``first <= index < after``.

    Parameters
    ----------
    index : (N,) int64
        Frames of the main map that have a true pose, ascending.
    T_world_cam, T_true : (N, 4, 4)
        Their estimated and true poses.
    first, after : int
        First disturbed frame, and the first one after the disturbance.
    tolerance_m : float, optional
        Largest offset of a right join; None: `MAX_OFFSET` of the true path over both parts, and what the error within
        the part before explains.

    Returns
    -------
    JoinAudit
    """
    before_rows, after_rows = np.flatnonzero(index < first), np.flatnonzero(index >= after)
    counts = len(before_rows), len(after_rows)
    if min(counts) < MIN_FRAMES:
        return JoinAudit(JoinOutcome.NOT_JOINED, *counts)
    near = before_rows[-MAX_FRAMES:], after_rows[:MAX_FRAMES]
    before, later = (align_cameras(index[rows], T_world_cam[rows], T_true[rows]) for rows in near)
    true = T_true[:, :3, 3]
    off = sim3.act(before.S_world_submap, later.centres) - true[near[1]]
    offset_m = float(np.median(np.linalg.norm(off, axis=1)))
    if tolerance_m is None:
        path = true[np.concatenate(near)]
        within = sim3.act(before.S_world_submap, before.centres) - true[near[0]]
        rms_m = math.sqrt(float((within**2).sum(axis=1).mean()))
        tolerance_m = MAX_OFFSET * float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) + 3.0 * rms_m
    ratio = float(sim3.scale(later.S_world_submap) / sim3.scale(before.S_world_submap))
    turn = sim3.rotation(later.S_world_submap).T @ sim3.rotation(before.S_world_submap)
    turn_deg = math.degrees(float(so3.rotation_angle(turn)))
    wrong = offset_m > tolerance_m or _scale_is_off(ratio, before, later) or turn_deg > MAX_TURN_DEG
    outcome = JoinOutcome.WRONG if wrong else JoinOutcome.RIGHT
    return JoinAudit(outcome, *counts, offset_m, ratio, turn_deg)


def _scale_is_off(ratio: float, before: Side, later: Side) -> bool:
    """Return whether a ratio of scales is off by more than its own uncertainty explains."""
    sigma = math.hypot(before.scale_sigma, later.scale_sigma)
    return abs(math.log(max(ratio, 1e-12))) - CERTAIN_SIGMAS * sigma > math.log(MAX_SCALE_RATIO)
