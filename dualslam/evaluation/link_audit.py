"""Is an accepted link true? Each similarity between two submaps against the one that ground truth gives.

A monocular map drifts, so that no single similarity takes the whole of it to the truth. What a link claims is local:
how the two maps lie to each other at their seam. Truth is taken there, from the frames of either map near it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dualslam.atlas import Atlas, Link, LinkKind
from dualslam.core.geometry import sim3, so3
from dualslam.core.submap import Submap
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate
from dualslam.trajectory import FramePose

WRONG_SCALE, WRONG_ROTATION_DEG, WRONG_POSITION = 0.05, 3.0, 0.05
"""Beyond any of these a link is wrong: relative, degrees, relative to the path that it links."""
MIN_FRAMES = 5
"""Fewer frames of a map with ground truth say nothing about it."""
CORRELATED_FRAMES = 8.0
"""So many neighbouring frames err alike: their number counts for so much less."""
MAX_REACH = 1000
"""Frames on either side of a seam beyond which truth is not looked for."""
CERTAIN_SIGMAS = 2.0
"""A link is surely wrong where it is so by more than this many standard deviations of the truth itself."""


@dataclass(frozen=True, slots=True)
class LinkAudit:
    """How far a link is from the truth.

    Attributes
    ----------
    old, new : int
        Submaps.
    scale : float
        Relative error: link over truth, less one.
    rotation_deg : float
    position_m : float
        Largest distance between where the link and where the truth puts the new map's frames near the seam.
    path_m : float
        Length of the true path over the frames that truth was taken from.
    scale_sigma, rotation_sigma_deg : float
        How well those frames fix the true similarity: an error that is no larger is none.
    n_old, n_new : int
        Frames of either map that truth was taken from.
    """

    old: int
    new: int
    scale: float
    rotation_deg: float
    position_m: float
    path_m: float
    scale_sigma: float
    rotation_sigma_deg: float
    n_old: int
    n_new: int

    @property
    def position(self) -> float:
        """Error of position relative to the path."""
        return self.position_m / max(self.path_m, 1e-9)

    @property
    def wrong(self) -> bool:
        """Whether the link is one that should never have been made, taking the truth at its word."""
        return self._is_wrong(0.0)

    @property
    def surely_wrong(self) -> bool:
        """Whether it is one also for all that is not known of the truth."""
        return self._is_wrong(CERTAIN_SIGMAS)

    def _is_wrong(self, sigmas: float) -> bool:
        scale = abs(self.scale) - sigmas * self.scale_sigma
        rotation_deg = self.rotation_deg - sigmas * self.rotation_sigma_deg
        return scale > WRONG_SCALE or rotation_deg > WRONG_ROTATION_DEG or self.position > WRONG_POSITION

    def as_dict(self) -> dict[str, Any]:
        """Return all fields, with `position`, `wrong` and `surely_wrong`."""
        return {**asdict(self), "position": self.position, "wrong": self.wrong, "surely_wrong": self.surely_wrong}


def audit_links(
    atlas: Atlas, poses: Iterable[FramePose], truth: Mapping[int, FloatArray], reach: int = 20
) -> list[LinkAudit | Failure]:
    """Audit all recovery links of an atlas, in order.

    Parameters
    ----------
    atlas : Atlas
    poses : iterable of FramePose
    truth : mapping of int to (4, 4)
        True ``T_world_cam`` by frame index, for the frames that have it.
    reach : int
        Truth is taken from the frames of either map among the keyframes that a link stands on, and so many before and
        after them (in counts of the source's index), or twice or four times as many and so on: whatever tells the scale
        best. Slow motion tells little of it, and what lies farther off has drifted away from the seam.
    """
    posed = list(poses)
    return [audit_link(atlas, link, posed, truth, reach) for link in atlas.links if link.kind is LinkKind.RECOVERY]


def audit_link(
    atlas: Atlas, link: Link, poses: list[FramePose], truth: Mapping[int, FloatArray], reach: int = 20
) -> LinkAudit | Failure:
    """Audit one link; a failure where ground truth says too little about either map. Parameters: see `audit_links`."""
    if not link.keyframes:
        return Failure(FailureReason.TOO_FEW_MATCHES, f"link {link.a}-{link.b} names no keyframes")
    known = [{i: T for i, T in _poses_in(atlas.submaps[m], poses).items() if i in truth} for m in (link.a, link.b)]
    # Slow motion tells little of scale, and far from the seam the maps have drifted: the reach that tells most.
    best: tuple[float, list[Side]] | None = None
    while best is None or reach <= MAX_REACH:
        sides = _truth_about(link, known, truth, reach)
        if isinstance(sides, Failure):
            return sides
        sigma = math.hypot(*(side.scale_sigma for side in sides))
        if best is None or sigma < best[0]:
            best = sigma, sides
        reach *= 2
    a, b = best[1]
    S_true = sim3.inverse(a.S_world_submap) @ b.S_world_submap
    S_link = link.S_a_b
    # In metres, where the truth of the old map puts them.
    moved = [sim3.act(a.S_world_submap @ S, b.centres) for S in (S_link, S_true)]
    R = sim3.rotation(S_true).T @ sim3.rotation(S_link)
    both = np.array([truth[int(i)][:3, 3] for i in np.union1d(a.ids, b.ids)])
    return LinkAudit(
        link.a,
        link.b,
        scale=float(sim3.scale(S_link) / sim3.scale(S_true)) - 1.0,
        rotation_deg=math.degrees(float(so3.rotation_angle(R))),
        position_m=float(np.linalg.norm(moved[0] - moved[1], axis=1).max()),
        path_m=float(np.linalg.norm(np.diff(both, axis=0), axis=1).sum()),
        scale_sigma=math.hypot(a.scale_sigma, b.scale_sigma),
        rotation_sigma_deg=math.degrees(math.hypot(a.rotation_sigma_rad, b.rotation_sigma_rad)),
        n_old=len(a.ids),
        n_new=len(b.ids),
    )


def _truth_about(
    link: Link, known: list[dict[int, FloatArray]], truth: Mapping[int, FloatArray], reach: int
) -> list[Side] | Failure:
    """Lay either map upon the truth by its frames near the seam: of the old one none that the link left behind."""
    first, handover = min(link.keyframes) - reach, max(link.keyframes)
    sides = []
    for m, T_est, last in ((link.a, known[0], handover), (link.b, known[1], handover + reach)):
        ids = np.array(sorted(i for i in T_est if first <= i <= last), np.int64)
        if len(ids) < MIN_FRAMES:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(ids)} frames of submap {m} have a true pose")
        sides.append(align_cameras(ids, np.array([T_est[int(i)] for i in ids]), np.array([truth[int(i)] for i in ids])))
    return sides


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A map laid upon the truth by some frames: the similarity, the centres (N, 3) in the map, how well they fix it."""

    ids: IntArray
    S_world_submap: FloatArray
    centres: FloatArray
    scale_sigma: float
    rotation_sigma_rad: float


def _poses_in(submap: Submap, poses: list[FramePose]) -> dict[int, FloatArray]:
    """Return ``T_submap_cam`` of all frames that a submap knows, keyframes first of all."""
    found = {p.index: submap.resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in poses if p.submap_id == submap.id}
    return found | {k: submap.resolve_anchor(k, np.eye(4)) for k in (*submap.anchors, *submap.keyframes)}


def align_cameras(ids: IntArray, T_submap_cam: FloatArray, T_world_cam: FloatArray) -> Side:
    """Lay cameras (N, 4, 4) upon true ones: the turn from their orientations, since a straight path leaves it open."""
    turns = T_world_cam[:, :3, :3] @ T_submap_cam[:, :3, :3].swapaxes(1, 2)
    R = so3.orthonormalise(turns.sum(0))
    off = so3.rotation_angle(R.T @ turns)
    est, true = T_submap_cam[:, :3, 3], T_world_cam[:, :3, 3]
    p, q = (est - est.mean(0)) @ R.T, true - true.mean(0)
    spread2 = max(float((p * p).sum()), 1e-300)
    s = float((p * q).sum()) / spread2
    if s <= 0:
        s = 1e-9  # a map that runs against the truth: any link with it comes out wrong
    error2 = float(((q - s * p) ** 2).sum())
    n = len(est)
    independent = max(n / CORRELATED_FRAMES, 2.0)
    return Side(
        ids,
        sim3.from_parts(s, R, true.mean(0) - s * R @ est.mean(0)),
        est,
        math.sqrt(error2 / spread2 / max(3 * independent - 4, 1.0)) / s,
        math.sqrt(float((off**2).mean()) / independent),
    )


def truth_by_frame(
    index: IntArray, timestamp_s: FloatArray, truth: Trajectory, max_dt_s: float = MAX_DT_S
) -> dict[int, FloatArray]:
    """Return the true pose of each frame (its index and time, (N,) each) that has one near in time."""
    row, near = associate(truth.timestamps_s, timestamp_s, max_dt_s)
    return {int(i): truth.T_world_cam[r] for i, r in zip(index[near], row[near], strict=True)}
