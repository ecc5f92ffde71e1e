"""Whether a wrong camera bends the new map between the overlap, where a link is measured, and its live end.

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
from dualslam.core.geometry import so3
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.linking.estimate import LinkEstimate
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 60
"""Of a larger map so many keyframes are asked, at even spaces."""
MIN_PLACE = 5
"""Keyframes whose positions tell the scale of a place."""


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
    return ids[np.isin(ids, agreeing)], live if len(live) >= MIN_PLACE else ids[-MIN_PLACE:]


def _log_spread(T: FloatArray, rows: IntArray) -> float:
    centres = T[rows, :3, 3]
    return 0.5 * math.log(max(float(((centres - centres.mean(axis=0)) ** 2).sum()), 1e-300))


def _mean_turn(T_now: FloatArray, T_other: FloatArray) -> FloatArray:
    """Return the mean rotation from the current keyframes to where they would be."""
    turns = T_other[:, :3, :3] @ T_now[:, :3, :3].swapaxes(1, 2)
    middle = turns[len(turns) // 2]
    mean = np.mean([so3.log(middle.T @ turn) for turn in turns], axis=0)
    return np.asarray(middle @ so3.exp(mean), np.float64)
