"""From the overlap, where a link is measured, to the new map's live end: its scale, and the bend by a wrong camera.

A wrong camera bends a map wherever it turns: it may agree with another map of that camera on all that both have seen,
and say nothing of the scale beyond. How sure the pixels contradict the camera does not decide. Matches with common
errors look like a wrong camera beyond their noise, although the map's shape hardly changes with it. A short map may
hardly know its camera, and be bent. So the test compares the map with the one under the preferred camera. Both are
solved from the same observations alone: other ties would count as an effect of the camera.

Of that, chance has its share: pixels of an exact camera ask for another one, too. A correction at a squared distance of
d2 makes a change of at most sqrt(d2) of that change's standard deviations, in any direction (Cauchy-Schwarz). So chance
makes at least the part 1 / d2 of the change's square on average. The rest counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.estimates import PreferredCamera
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.linking.estimate import LinkEstimate, LinkRefusal
from dualslam.linking.join_test import LinkEvidence, live_scale_gate
from dualslam.linking.scale_observability import scale_sigma_between
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 60
"""Of a larger map so many keyframes are asked, at even spaces."""


@dataclass(frozen=True, slots=True)
class Bend:
    """How one end of a map would lie to the other under another camera."""

    log_scale: float = 0.0  # logarithm of its scale there over the current one
    rotation_rad: float = 0.0
    doubt: Failure | None = None  # why a link is not to be relied on with it

    def beyond_chance(self, distance2: float) -> Bend:
        """Return what counts of it, if the pixels ask for the other camera by this squared distance."""
        share = math.sqrt(max(0.0, 1.0 - 1.0 / distance2)) if distance2 > 0 else 0.0
        return Bend(share * self.log_scale, share * self.rotation_rad)


NO_BEND = Bend()


def measure_bend(T_now: FloatArray, T_other: FloatArray, here: IntArray, there: IntArray) -> Bend:
    """Return by what a place of a map turns and grows relative to another, between two states of its poses.

    - `T_now`, `T_other` (K, 4, 4): each in a frame and unit of its own.
    - `here`, `there` (A,), (B,): rows of the two places, two at least in each.
    """
    log_scale = _log_spread(T_other, there) - _log_spread(T_now, there)
    log_scale -= _log_spread(T_other, here) - _log_spread(T_now, here)
    R_there, R_here = (_mean_turn(T_now[rows], T_other[rows]) for rows in (there, here))
    return Bend(log_scale, float(np.linalg.norm(so3.log(R_here.T @ R_there))))


def check_camera(
    submap: Submap,
    link: LinkEstimate,
    live_since: int,
    find: Callable[[Submap, IntArray], PreferredCamera | None],
    config: LinkingConfig,
) -> Bend | Failure:
    """Return the bend that the camera may have made in a new map, none where its pixels say nothing of it.

    - `submap`: as the walk has left it.
    - `link`: carried to the live end.
    - `live_since`: the keyframe that the walk set out from.
    - `find`: asks keyframes of the submap about the camera.

    Returns Bend or Failure: a failure if the link with this bend is too unsure to join the maps. A bend with a `doubt`
    if it joins them, but is too unsure to rely on. The reason is the camera if it is contradicted beyond chance.
    Otherwise it is the scale, which more keyframes may decide.
    """
    ids = np.array(sorted(submap.keyframes), np.int64)
    here, there = _places(ids, link.agreeing_keyframes, live_since)
    ids = ids[(ids >= min(here[0], there[0])) & (ids <= max(here[-1], there[-1]))]
    if len(ids) > MAX_KEYFRAMES:
        ids = ids[np.linspace(0, len(ids) - 1, MAX_KEYFRAMES).astype(np.int64)]
    found = find(submap, ids)
    if found is None:
        return NO_BEND
    rows = [np.flatnonzero(np.isin(ids, place)) for place in (here, there)]
    bend = Bend(math.inf, math.inf)
    if min(len(each) for each in rows) >= 2:
        bend = measure_bend(found.T_now, found.T_preferred, *rows).beyond_chance(found.distance2)
    turn_deg = math.degrees(bend.rotation_rad)
    sigma = math.hypot(link.sigma_scale, bend.log_scale)
    turns = turn_deg > config.max_live_rotation_deg
    if sigma <= config.max_live_scale_sigma and not turns:
        return bend
    numbers = {
        "log_focal": found.log_focal,
        "distance2": found.distance2,
        "bend_scale": bend.log_scale,
        "bend_deg": turn_deg,
    }
    by = f"focal length {found.log_focal:+.1%}, known to {found.log_focal_sigma:.1%}"
    by += f", would bend it by {abs(bend.log_scale):.1%} and {turn_deg:.1f} deg"
    why = Failure(FailureReason.SCALE, f"the new map hardly knows its camera: {by}", numbers)
    if found.beyond_chance:
        why = Failure(FailureReason.CAMERA, f"the new map contradicts its camera: {by}", numbers)
    return why if turns or sigma > config.max_joined_scale_sigma else replace(bend, doubt=why)


def _places(ids: IntArray, agreeing: IntArray, live_since: int) -> tuple[IntArray, IntArray]:
    """Return, of a map's keyframes, those of the overlap, and those of the live end or next to it; ascending."""
    live = ids[ids >= live_since]
    return ids[np.isin(ids, agreeing)], live if len(live) >= GROUP else ids[-GROUP:]


def _log_spread(T: FloatArray, rows: IntArray) -> float:
    centres = T[rows, :3, 3]
    return 0.5 * math.log(max(float(((centres - centres.mean(axis=0)) ** 2).sum()), 1e-300))


def _mean_turn(T_now: FloatArray, T_other: FloatArray) -> FloatArray:
    """Return the mean rotation from the current keyframes to where they would be."""
    turns = T_other[:, :3, :3] @ T_now[:, :3, :3].swapaxes(1, 2)
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
    link: LinkEstimate, new: Submap, live_since: int, config: LinkingConfig, bend: Bend = NO_BEND
) -> LinkEstimate | Failure:
    """Add to a link's covariance what reverse tracking has lost of the scale, and refuse it where that is too much.

    So does what the map may be bent by its camera.

    - `new`: as the walk has left it.
    - `live_since`: the keyframe that the walk set out from: it and those after it are the live end.
    - `bend`: of the new map, under the camera that its pixels ask for.

    Returns LinkEstimate or Failure: with its `sigma_scale` at the live end. The numbers have the walk's share of it,
    `sigma_scale_reverse`, and the camera's, `sigma_scale_camera`, where there is one.
    """
    live = np.array([k for k in new.keyframes if k >= live_since], np.int64)
    walk = scale_sigma_between(new, link.agreeing_keyframes, live)
    sigma = math.hypot(link.sigma_scale, walk, bend.log_scale)
    numbers = {"sigma_scale": sigma, "sigma_scale_reverse": walk}
    if bend.log_scale:
        numbers["sigma_scale_camera"] = abs(bend.log_scale)
    detail = "nothing holds the scale between the overlap and the live end"
    if math.isfinite(walk):
        detail = f"scale known to {sigma:.1%} at the live end, {walk:.1%} of it by the walk"
    settled = len(link.agreeing_keyframes) >= SETTLED_KEYFRAMES
    hopeless = walk > (SETTLED if settled else HOPELESS) * config.max_live_scale_sigma
    reason = FailureReason.SCALE_LOST if hopeless else FailureReason.SCALE
    evidence = LinkEvidence((live_scale_gate(sigma, detail, reason, config),))
    compared = evidence.comparisons
    if not evidence.is_accepted:
        return LinkRefusal(reason, detail, numbers, walk_sigma=walk, gates=compared)
    # The live end grows and shrinks about the place where the maps overlap.
    held = [k for k in link.agreeing_keyframes.tolist() if k in new.keyframes]
    about = sim3.adjoint(se3.from_parts(np.eye(3), new.keyframe_poses(held)[:, :3, 3].mean(0)))
    lost = np.diag([bend.rotation_rad**2] * 3 + [0.0] * 3 + [walk**2 + bend.log_scale**2])
    covariance = link.covariance + about @ lost @ about.T
    known = link.numbers | numbers
    carried = replace(link, covariance=covariance, sigma_scale=sigma, numbers=known, gates=(*link.gates, *compared))
    if evidence.is_sure:
        return carried
    return LinkRefusal(reason, detail, numbers, walk_sigma=walk, unsure=carried, gates=compared)
