"""Whether a place that pixels have verified can be where it is: beside others, by the drift, by the camera's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import Path, compose
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.linking.motion import DRIFT, join_slack, refuse_seams
from dualslam.places.sightings import SAME_WITHIN, same_pose, turn_between
from dualslam.places.verification import PlaceMatch

MAX_DRIFT, MAX_DRIFT_DEG, MAX_DRIFT_LOG_SCALE = 0.5, 60.0, float(np.log(3.0))
"""What a map that was never lost between two places can have drifted at most: a share of the way, a turn, a scale. Half
the way is what lies between two copies of a thing that stand next to each other; the largest drift that was seen on a
real sequence is 47 % in scale."""
MAX_SLIP = 0.1
"""Share of the way that a map can have lost beyond what its drift in turn and scale explains: what these have undone
again. Right loops lost 3 % in all at most, and none of it beyond (32 on HoloLens, TUM, 7-Scenes and a phone); the copy
of a thing lies at a whole period, turned and scaled as the thing itself."""


def can_have_drifted(share_of_way: float, turn_deg: float, log_scale: float) -> bool:
    """Whether a map that was never lost can have drifted by so much between two places.

    A place is displaced by the turn and the scale that were lost before it: at most by what was lost in the end, as if
    that had been so all the way.

    Parameters
    ----------
    share_of_way : float
        Distance between where the map and where the pixels put a place, over the length of the way.
    turn_deg, log_scale : float
        Between the two, as well.
    """
    if share_of_way > MAX_DRIFT or turn_deg > MAX_DRIFT_DEG or abs(log_scale) > MAX_DRIFT_LOG_SCALE:
        return False
    return share_of_way <= MAX_SLIP + float(np.radians(turn_deg) + np.expm1(abs(log_scale)))


def agree(atlas: Atlas, first: PlaceMatch, second: PlaceMatch) -> bool:
    """Whether two matches put the newer keyframe at one place of one submap."""
    if first.place[0] != second.place[0]:
        return False
    T_q = atlas.submaps[second.query[0]].T_submap_kf[second.query[1]]
    poses = [sim3.act_on_pose(match.S_place_query, T_q) for match in (first, second)]
    return same_pose(poses[0], poses[1], SAME_WITHIN * _depth(atlas, *second.place))


def contradict(atlas: Atlas, one: PlaceMatch, other: PlaceMatch) -> bool:
    """Whether two matches of one keyframe put it at two places of one map."""
    m = one.place[0]
    if m == other.place[0]:
        return not agree(atlas, one, other)
    component = atlas.component_of(m)
    if other.place[0] not in component:
        return False  # two maps that are not joined may well show one place
    S_world = atlas.S_world_submap(component)
    T_q = atlas.submaps[one.query[0]].T_submap_kf[one.query[1]]
    centres = [sim3.act_on_pose(S_world[each.place[0]] @ each.S_place_query, T_q)[:3, 3] for each in (one, other)]
    apart = np.linalg.norm(centres[0] - centres[1])
    return bool(apart > float(sim3.scale(S_world[m])) * _depth(atlas, *one.place))


def plausible(record: Record, match: PlaceMatch) -> PlaceMatch | Failure:
    """Refuse a place that no drift explains: the map that leads to it cannot have lost that much.

    These are the bounds of what drift can be at all, and not of what the chain says of its own: pixels that prove
    the place are believed over any chi-square. A street of identical houses is refused here, as each house is a
    whole way off from the next, or off by much of it, and yet neither turned nor of another size.
    """
    (a, k_a), (b, k_b) = match.place, match.query
    atlas = record.atlas
    component = atlas.component_of(b)
    if a not in component:
        return reachable(record, match)
    S_world = atlas.S_world_submap(component)
    S_a_b = sim3.inverse(S_world[a]) @ S_world[b]
    T_b_cam = atlas.submaps[b].T_submap_kf[k_b]
    by_chain, by_pixels = sim3.act_on_pose(S_a_b, T_b_cam), sim3.act_on_pose(match.S_place_query, T_b_cam)
    log_scale = float(np.log(sim3.scale(match.S_place_query) / sim3.scale(S_a_b)))
    way = _way(atlas, component, S_world, k_a, k_b) / float(sim3.scale(S_world[a]))
    apart = float(np.linalg.norm(by_chain[:3, 3] - by_pixels[:3, 3]))
    numbers = {"drift_rot_deg": float(np.degrees(turn_between(by_chain, by_pixels))), "drift_log_scale": log_scale}
    numbers |= {"drift": apart / max(way, 1e-12)}
    match.numbers.update(numbers)
    if not can_have_drifted(numbers["drift"], numbers["drift_rot_deg"], log_scale):
        detail = (
            f"the map would have drifted by {numbers['drift']:.0%} of the way, {numbers['drift_rot_deg']:.0f} deg"
            f" and {np.expm1(log_scale):+.0%} in scale"
        )
        return Failure(FailureReason.CONTRADICTION, detail, match.numbers)
    return match


def reachable(record: Record, match: PlaceMatch) -> PlaceMatch | Failure:
    """Refuse to join two maps of this run where the camera cannot have come from one to the other (`recovery/motion`).

    The maps are joined with all that each is linked with. Between the place and the seam both may have drifted.
    """
    (a, k_a), (b, k_b) = match.place, match.query
    atlas, S_a = record.atlas, dict[int, FloatArray]()
    for m, S_a_m in ((a, np.eye(4)), (b, match.S_place_query)):
        component = atlas.component_of(m)
        S_world = atlas.S_world_submap(component)
        S_a |= {other: S_a_m @ sim3.inverse(S_world[m]) @ S_world[other] for other in component}
    path = Path.of_trajectory(compose(record.own_poses(), atlas, S_a))
    path = replace(path, refound=record.are_refound(path.index.tolist()))
    of_place = set(atlas.component_of(a))
    is_old = np.array([record.poses[i].submap_id in of_place for i in path.index.tolist()], bool)
    old, new = path.take(is_old), path.take(~is_old)

    def slack(i: int, j: int) -> float:
        at_old, at_new = (i, j) if i in old.index else (j, i)
        way = old.way_between(k_a, at_old) + new.way_between(k_b, at_new)
        return DRIFT * way + join_slack(match.S_place_query, match.covariance, new.centres[new.index == at_new][0])

    refused = refuse_seams(old, new, slack)
    return match if refused is None else refused


def _depth(atlas: Atlas, submap_id: int, keyframe_id: int) -> float:
    """Return the median depth of what a keyframe sees, in its submap's unit."""
    submap = atlas.submaps[submap_id]
    ids = submap.landmark_of[keyframe_id]
    return float(np.median(submap.depths(ids[ids >= 0], se3.inverse(submap.T_submap_kf[keyframe_id]))))


def _way(atlas: Atlas, component: list[int], S_world: dict[int, FloatArray], first: int, last: int) -> float:
    """Return the length of the path between two keyframes, in the unit of the world."""
    first, last = min(first, last), max(first, last)
    centres: dict[int, FloatArray] = {}
    for m in component:
        for k, T in atlas.submaps[m].T_submap_kf.items():
            if first <= k <= last and k not in centres:
                centres[k] = sim3.act(S_world[m], T[None, :3, 3])[0]
    ordered = np.array([centres[k] for k in sorted(centres)])
    return float(np.linalg.norm(np.diff(ordered, axis=0), axis=1).sum())
