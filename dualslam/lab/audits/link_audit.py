"""Is an accepted link true? Each similarity between two submaps against the one that ground truth gives.

A monocular map drifts, so that no single similarity takes the whole of it to the truth. What a link claims is local:
how the two maps lie to each other at their overlap. Truth is taken there, from the frames of either map near it, and
from no more of them than it takes to tell: what drifts farther off, before or after, is not the link's doing.

With one exception. Reverse tracking leads from the new map's start to the overlap. A scale lost on the way makes a link
wrong for everything that comes after, however well it fits at the overlap. So the scale is judged a second time at the
new map's live end, by the first frames that the old map never saw.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import FramePose
from dualslam.core.geometry import sim3, so3
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.io.trajectory_files import MAX_DT_S, Trajectory, associate
from dualslam.map.submap import Submap

WRONG_SCALE, WRONG_ROTATION_DEG, WRONG_POSITION = 0.05, 3.0, 0.05
"""Beyond any of these a link is wrong: relative, degrees, relative to the path that it links."""
MIN_FRAMES = 5
"""Fewer frames of a map with ground truth say nothing about it."""
CORRELATED_FRAMES = 8.0
"""So many neighbouring frames err alike: their number counts for so much less."""
MAX_REACH = 1000
"""Frames on either side of an overlap beyond which truth is not looked for."""
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
        Largest distance between where the link and where the truth puts the new map's frames near the overlap.
    path_m : float
        Length of the true path over the frames that truth was taken from.
    scale_sigma, rotation_sigma_deg : float
        How well those frames fix the true similarity: an error that is no larger is none.
    n_old, n_new : int
        Frames of either map that truth was taken from.
    frames_old, frames_new : (int, int)
        The first and the last of those frames, in either map.
    live_scale, live_scale_sigma : float or None
        Relative error of the scale that the link gives the new map's live end, and the uncertainty of the truth there.
        None if the new map has no frames beyond the old one.
    frames_live : (int, int) or None
        The first and the last frame of that end.
    shared_scale : float or None
        Relative error of scale over the frames of the overlap that both maps pose, and over no others: the link's own,
        without what either map drifts beside its overlap; none where they are fewer than five.
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
    frames_old: tuple[int, int]
    frames_new: tuple[int, int]
    live_scale: float | None = None
    live_scale_sigma: float | None = None
    frames_live: tuple[int, int] | None = None
    shared_scale: float | None = None

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

    @property
    def worst_scale(self) -> float:
        """The error of scale at the overlap, or at the live end where it is surely wrong there and larger."""
        return self._live_error if abs(self._live_error) > abs(self.scale) else self.scale

    @property
    def _live_error(self) -> float:
        """Error at the live end, if it is surely wrong; slow motion tells too little there to count for less."""
        if self.live_scale is None or self.live_scale_sigma is None:
            return 0.0
        surely = abs(self.live_scale) - CERTAIN_SIGMAS * self.live_scale_sigma > WRONG_SCALE
        return self.live_scale if surely else 0.0

    def _is_wrong(self, sigmas: float) -> bool:
        scale = abs(self.scale) - sigmas * self.scale_sigma
        if self.live_scale is not None and self.live_scale_sigma is not None:
            scale = max(scale, abs(self.live_scale) - sigmas * self.live_scale_sigma)
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
        Truth comes from the frames of either map among the link's keyframes. `reach` more count before and after (in
        counts of the source's index). Where those do not tell whether the scale is wrong (slow motion tells little of
        it), twice or four times as many and so on: the fewest that do, or else those that tell most. The same at the
        live end.
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
    sides = _fewest_that_tell(lambda reach: _truth_about(link, known, truth, reach), reach)
    if isinstance(sides, Failure):
        return sides
    a, b = sides
    live = _fewest_that_tell(lambda reach: _truth_beyond(known, truth, reach), reach)
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
        frames_old=a.span,
        frames_new=b.span,
        shared_scale=_shared_scale(link, known, truth),
        **({} if isinstance(live, Failure) else _at_the_live_end(a, live[0], S_link)),
    )


@dataclass(frozen=True, slots=True)
class UnbrokenAudit:
    """The errors of scale that an audit finds where there is no link: one map, the same frames, the same truth.

    Attributes
    ----------
    scale : float
        Relative, as `LinkAudit.scale`.
    live_scale : float or None
        As `LinkAudit.live_scale`.
    """

    scale: float
    live_scale: float | None


def audit_unbroken(
    audit: LinkAudit, T_submap_cam: Mapping[int, FloatArray], truth: Mapping[int, FloatArray]
) -> UnbrokenAudit | Failure:
    """Audit a map that never broke at the places where a link was audited: the control of that audit.

    A map drifts, and truth itself may lie otherwise than the cameras do (7-Scenes: the poses of a depth camera). What
    is found here, too, is not the link's doing.

    Parameters
    ----------
    audit : LinkAudit
    T_submap_cam : mapping of int to (4, 4)
        Of the map that never broke, by frame index.
    truth : mapping of int to (4, 4)
        As for `audit_links`.
    """
    sides: list[Side] = []
    for span in (audit.frames_old, audit.frames_new, audit.frames_live):
        if span is None:
            continue
        side = _lay_upon_truth(T_submap_cam, truth, span, "of the unbroken map")
        if isinstance(side, Failure):
            return side
        sides.append(side)
    old, new, *live = (float(sim3.scale(side.S_world_submap)) for side in sides)
    return UnbrokenAudit(old / new - 1.0, old / live[0] - 1.0 if live else None)


def _fewest_that_tell(truth_within: Callable[[int], list[Side] | Failure], reach: int) -> list[Side] | Failure:
    """Widen the reach until truth tells a wrong scale from a right one; if it never does, where it tells most."""
    best: tuple[float, list[Side] | Failure] | None = None
    while best is None or (reach <= MAX_REACH and CERTAIN_SIGMAS * best[0] > WRONG_SCALE):
        sides = truth_within(reach)
        sigma = math.inf if isinstance(sides, Failure) else math.hypot(*(side.scale_sigma for side in sides))
        if best is None or sigma < best[0]:
            best = sigma, sides
        reach *= 2
    return best[1]


def _truth_beyond(
    known: list[dict[int, FloatArray]], truth: Mapping[int, FloatArray], reach: int
) -> list[Side] | Failure:
    """Lay the new map upon the truth by the first frames that the old one never saw."""
    last = max(known[0])
    first = min((i for i in known[1] if last < i), default=last + 1)
    live = _lay_upon_truth(known[1], truth, (first, first + reach), "beyond the old map")
    return live if isinstance(live, Failure) else [live]


def _at_the_live_end(old: Side, live: Side, S_link: FloatArray) -> dict[str, Any]:
    """Return the error of scale there, its sigma, and where it is."""
    S_true = sim3.inverse(old.S_world_submap) @ live.S_world_submap
    error = float(sim3.scale(S_link) / sim3.scale(S_true)) - 1.0
    sigma = math.hypot(old.scale_sigma, live.scale_sigma)
    return {"live_scale": error, "live_scale_sigma": sigma, "frames_live": live.span}


def _shared_scale(link: Link, known: list[dict[int, FloatArray]], truth: Mapping[int, FloatArray]) -> float | None:
    """Return the error of a link's scale over the frames of its overlap that both maps pose, if they are enough."""
    span = min(link.keyframes), max(link.keyframes)
    shared = known[0].keys() & known[1].keys()
    sides = [_lay_upon_truth({i: T[i] for i in shared}, truth, span, "of the overlap") for T in known]
    old, new = (None if isinstance(side, Failure) else float(sim3.scale(side.S_world_submap)) for side in sides)
    return None if old is None or new is None else float(sim3.scale(link.S_a_b)) * old / new - 1.0


def _truth_about(
    link: Link, known: list[dict[int, FloatArray]], truth: Mapping[int, FloatArray], reach: int
) -> list[Side] | Failure:
    """Lay either map upon the truth by its frames near the overlap: of the old one none that the link left behind."""
    first, handover = min(link.keyframes) - reach, max(link.keyframes)
    sides: list[Side] = []
    for m, T_est, last in ((link.a, known[0], handover), (link.b, known[1], handover + reach)):
        side = _lay_upon_truth(T_est, truth, (first, last), f"of submap {m}")
        if isinstance(side, Failure):
            return side
        sides.append(side)
    return sides


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A map laid upon the truth by some frames: the similarity, the centres (N, 3) in the map, how well they fix it."""

    ids: IntArray
    S_world_submap: FloatArray
    centres: FloatArray
    scale_sigma: float
    rotation_sigma_rad: float

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last frame."""
        return int(self.ids[0]), int(self.ids[-1])


def _lay_upon_truth(
    T_submap_cam: Mapping[int, FloatArray], truth: Mapping[int, FloatArray], span: tuple[int, int], where: str
) -> Side | Failure:
    """Lay a map upon the truth by its frames from the first to the last of a span that have a true pose."""
    ids = np.array(sorted(i for i in T_submap_cam if span[0] <= i <= span[1] and i in truth), np.int64)
    if len(ids) < MIN_FRAMES:
        return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(ids)} frames {where} have a true pose")
    return align_cameras(ids, *(np.array([poses[int(i)] for i in ids]) for poses in (T_submap_cam, truth)))


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
