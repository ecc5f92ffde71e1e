"""From the overlap, where a link is measured, to the new map's live end: its scale, and the bend by a wrong camera.

A wrong camera bends a map wherever it turns: it may agree with another map of that camera on all that both have seen,
and say nothing of the scale beyond. How sure the pixels contradict the camera does not decide, as matches with common
errors do so too. The test compares the map with the one under the preferred camera. Both are solved from the same
observations alone: other ties would count as an effect of the camera.

Chance has its share: a correction at a squared distance of d2 makes a change of at most sqrt(d2) of that change's
standard deviations, in any direction (Cauchy-Schwarz). So chance makes at least the part 1 / d2 of the change's square
on average. The rest counts.

A camera that was estimated is itself known to a covariance only. What the map changes under a camera that is one
standard deviation off, in each independent direction, counts beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.estimates import PreferredCamera
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.noise_model import GROUP, LEAST
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.linking.estimate import LinkEstimate, LinkRefusal
from dualslam.linking.join_test import JoinGate, LinkEvidence, live_scale_gate
from dualslam.linking.scale_observability import scale_sigma_between
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 60
"""Of a larger map so many keyframes are asked, at even spaces."""


@dataclass(frozen=True, slots=True)
class Bend:
    """How one end of a map would lie to the other under another camera."""

    log_scale: float  # logarithm of its scale there over the current one
    rotation_rad: float

    def beyond_chance(self, distance2: float) -> Bend:
        """Return what counts of it, if the pixels ask for the other camera by this squared distance."""
        share = math.sqrt(max(0.0, 1.0 - 1.0 / distance2)) if distance2 > 0 else 0.0
        return Bend(share * self.log_scale, share * self.rotation_rad)

    def beside(self, others: Sequence[Bend]) -> Bend:
        """Return the root of the sum of squares of it and others, which are independent of it."""
        every = (self, *others)
        return Bend(math.hypot(*(b.log_scale for b in every)), math.hypot(*(b.rotation_rad for b in every)))


def measure_bend(T_now: FloatArray, T_other: FloatArray, here: IntArray, there: IntArray) -> Bend:
    """Return by what a place of a map turns and grows relative to another, between two states of its poses.

    - `T_now`, `T_other` (K, 4, 4): each in a frame and unit of its own.
    - `here`, `there` (A,), (B,): rows of the two places, two at least in each.
    """
    log_scale = _log_spread(T_other, there) - _log_spread(T_now, there)
    log_scale -= _log_spread(T_other, here) - _log_spread(T_now, here)
    R_there, R_here = (_mean_turn(T_now[rows], T_other[rows]) for rows in (there, here))
    return Bend(log_scale, float(np.linalg.norm(so3.log(R_here.T @ R_there))))


def add_camera(
    link: LinkEstimate,
    new: Submap,
    live_since: int,
    find: Callable[[Submap, IntArray], PreferredCamera | None],
    config: LinkingConfig,
) -> LinkEstimate | Failure:
    """Add to a link's covariance by what the camera may have bent the new map, and refuse it where that is too much.

    - `link`: carried to the live end.
    - `new`, `live_since`: as in `propagate_to_live_end`.
    - `find`: asks keyframes of the submap about the camera.

    Returns LinkEstimate or Failure: unchanged where the pixels say nothing of the camera. The numbers have the camera's
    share of the scale, `sigma_scale_camera`. The reason of a refusal is the camera if it is contradicted beyond chance.
    Otherwise it is the scale, which more keyframes may decide.
    """
    ids = np.array(sorted(new.keyframes), np.int64)
    here, there = _places(ids, link.agreeing_keyframes, live_since)
    ids = ids[(ids >= min(here[0], there[0])) & (ids <= max(here[-1], there[-1]))]
    if len(ids) > MAX_KEYFRAMES:
        ids = ids[np.linspace(0, len(ids) - 1, MAX_KEYFRAMES).astype(np.int64)]
    found = find(new, ids)
    if found is None:
        return link
    rows = [np.flatnonzero(np.isin(ids, place)) for place in (here, there)]
    bend = Bend(math.inf, math.inf)
    if min(len(each) for each in rows) >= 2:
        bend = measure_bend(found.T_now, found.T_preferred, *rows).beyond_chance(found.distance2)
        bend = bend.beside([measure_bend(found.T_preferred, T, *rows) for T in found.T_off])
    turn_deg = math.degrees(bend.rotation_rad)
    says, reason = "hardly knows", FailureReason.SCALE
    if found.beyond_chance:
        says, reason = "contradicts", FailureReason.CAMERA
    detail = f"the new map {says} its camera: focal length {found.log_focal:+.1%}, known to {found.log_focal_sigma:.1%}"
    detail += f", would bend it by {bend.log_scale:.1%} and {turn_deg:.1f} deg"
    evidence = LinkEvidence(
        (
            live_scale_gate(math.hypot(link.sigma_scale, bend.log_scale), detail, reason, config),
            JoinGate.at_most("bend_deg", turn_deg, config.max_live_rotation_deg, reason, detail),
        )
    )
    by_camera = {"sigma_scale_camera": bend.log_scale}
    numbers = evidence.numbers | by_camera | {"log_focal": found.log_focal, "distance2": found.distance2}
    refused = LinkRefusal(reason, detail, numbers, gates=evidence.comparisons)
    return _carry(link, new, bend, by_camera, evidence, refused)


def _places(ids: IntArray, agreeing: IntArray, live_since: int) -> tuple[IntArray, IntArray]:
    """Return, of a map's keyframes, those of the overlap, and those of the live end or next to it; ascending."""
    live = ids[ids >= live_since]
    return ids[np.isin(ids, agreeing)], live if len(live) >= GROUP else ids[-GROUP:]


def _log_spread(T: FloatArray, rows: IntArray) -> float:
    centres = T[rows, :3, 3]
    return math.log(max(float(((centres - centres.mean(axis=0)) ** 2).sum()), LEAST)) / 2


def _mean_turn(T_now: FloatArray, T_other: FloatArray) -> FloatArray:
    """Return the mean rotation from the current keyframes to where they would be."""
    turns = se3.rotation(T_other) @ se3.rotation(T_now).swapaxes(1, 2)
    middle = turns[len(turns) // 2]
    mean = np.mean([so3.log(middle.T @ turn) for turn in turns], axis=0)
    return np.asarray(middle @ so3.exp(mean), np.float64)


HOPELESS = 3.0
"""Times the bound: more keyframes at the far end make the walk's share smaller, down to what it lost on the way."""
SETTLED_KEYFRAMES, SETTLED = 12, 1.3
"""With so many of them the share is nearly down there: from 12 to 43 it went from 3.5 to 2.9 % (a rendered street), on
a HoloLens walk from 22 to 43 it stayed at 7.0 %. So many times the bound is then as hopeless, until the live end, which
is what is known badly, has grown."""


def propagate_to_live_end(
    link: LinkEstimate, new: Submap, live_since: int, config: LinkingConfig
) -> LinkEstimate | Failure:
    """Add to a link's covariance what reverse tracking has lost of the scale, and refuse it where that is too much.

    - `new`: as the walk has left it.
    - `live_since`: the keyframe that the walk set out from: it and those after it are the live end.

    Returns LinkEstimate or Failure: with its `sigma_scale` at the live end. The numbers have the walk's share of it,
    `sigma_scale_reverse`.
    """
    live = np.array([k for k in new.keyframes if k >= live_since], np.int64)
    walk = scale_sigma_between(new, link.agreeing_keyframes, live)
    sigma = math.hypot(link.sigma_scale, walk)
    detail = "nothing holds the scale between the overlap and the live end"
    if math.isfinite(walk):
        detail = f"scale known to {sigma:.1%} at the live end, {walk:.1%} of it by the walk"
    settled = len(link.agreeing_keyframes) >= SETTLED_KEYFRAMES
    hopeless = walk > (SETTLED if settled else HOPELESS) * config.max_live_scale_sigma
    reason = FailureReason.SCALE_LOST if hopeless else FailureReason.SCALE
    evidence = LinkEvidence((live_scale_gate(sigma, detail, reason, config),))
    by_walk = {"sigma_scale_reverse": walk}
    numbers = evidence.numbers | by_walk
    refused = LinkRefusal(reason, detail, numbers, walk_sigma=walk, gates=evidence.comparisons)
    return _carry(link, new, Bend(walk, 0.0), by_walk, evidence, refused)


def _carry(
    link: LinkEstimate, new: Submap, lost: Bend, share: dict[str, float], evidence: LinkEvidence, refused: LinkRefusal
) -> LinkEstimate | LinkRefusal:
    """Return a link with what the new map may have lost on the way to its live end, or its refusal."""
    if not evidence.is_accepted:
        return refused
    held = [k for k in link.agreeing_keyframes.tolist() if k in new.keyframes]
    about = sim3.adjoint(se3.from_parts(so3.IDENTITY, se3.translation(new.keyframe_poses(held)).mean(0)))
    C = np.diag([lost.rotation_rad**2] * 3 + [0.0] * 3 + [lost.log_scale**2])
    sigma = math.hypot(link.sigma_scale, lost.log_scale)
    carried = replace(
        link,
        covariance=link.covariance + about @ C @ about.T,
        sigma_scale=sigma,
        numbers=link.numbers | share | {"sigma_scale": sigma},
        gates=(*link.gates, *evidence.comparisons),
    )
    return carried if evidence.is_sure else replace(refused, unsure=carried)
