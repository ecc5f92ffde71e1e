"""Whether a place that pixels have verified can be where it is: beside others, by the drift, by the camera's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import Path, compose
from dualslam.core.geometry import se3, sim3
from dualslam.core.noise_model import MAX_SLIP, SAME_WITHIN, TINY
from dualslam.core.types import Failure, FloatArray
from dualslam.linking.join_test import LinkEvidence, drift_gate, judge_motion
from dualslam.linking.motion import join_slack, seam_motions
from dualslam.places.sightings import same_pose, turn_between
from dualslam.places.verification import PlaceMatch


def agree(atlas: Atlas, first: PlaceMatch, second: PlaceMatch) -> bool:
    """Whether two matches put the newer keyframe at one place of one submap."""
    if first.place[0] != second.place[0]:
        return False
    T_q = atlas.submaps[second.query[0]].T_submap_kf[second.query[1]]
    poses = [sim3.act_on_pose(match.S_place_query, T_q) for match in (first, second)]
    return same_pose(poses[0], poses[1], SAME_WITHIN * _depth(atlas, second))


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
    centres = [
        se3.translation(sim3.act_on_pose(S_world[each.place[0]] @ each.S_place_query, T_q)) for each in (one, other)
    ]
    apart = np.linalg.norm(centres[0] - centres[1])
    return bool(apart > float(sim3.scale(S_world[m])) * _depth(atlas, one))


def plausible(record: Record, match: PlaceMatch) -> PlaceMatch | Failure:
    """Refuse a place that no drift explains: the map that leads to it cannot have lost that much.

    These are the bounds of what drift can be at all: pixels that prove the place are believed over any chi-square. In a
    street of identical houses each is a large part of the way off from the next, and neither turned nor of another
    size.
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
    apart = float(np.linalg.norm(se3.translation(by_chain) - se3.translation(by_pixels)))
    turn_deg = float(np.degrees(turn_between(by_chain, by_pixels)))
    evidence = LinkEvidence((drift_gate(apart / max(way, TINY), turn_deg, log_scale),))
    match.numbers.update(evidence.numbers)
    refused = evidence.refusal(match.numbers)
    return match if refused is None else refused


def reachable(record: Record, match: PlaceMatch) -> PlaceMatch | Failure:
    """Refuse to join two maps of this run where the camera cannot have come from one to the other (`linking/motion`).

    The maps are joined with all that each is linked with. Between the place and the seam both may have drifted.
    """
    (a, k_a), (b, k_b) = match.place, match.query
    atlas, S_a = record.atlas, dict[int, FloatArray]()
    for m, S_a_m in ((a, se3.IDENTITY), (b, match.S_place_query)):
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
        return MAX_SLIP * way + join_slack(match.S_place_query, match.covariance, new.centres[new.index == at_new][0])

    refused = judge_motion(seam_motions(old, new, slack)).refusal()
    return match if refused is None else refused


def _depth(atlas: Atlas, match: PlaceMatch) -> float:
    """Return the median depth of what a place's keyframe sees, in its submap's unit."""
    return float(np.median(atlas.submaps[match.place[0]].depths_in(match.place[1])))


def _way(atlas: Atlas, component: list[int], S_world: dict[int, FloatArray], first: int, last: int) -> float:
    """Return the length of the path between two keyframes, in the unit of the world."""
    first, last = min(first, last), max(first, last)
    centres: dict[int, FloatArray] = {}
    for m in component:
        for k, T in atlas.submaps[m].T_submap_kf.items():
            if first <= k <= last and k not in centres:
                centres[k] = sim3.act(S_world[m], se3.translation(T[None]))[0]
    ordered = np.array([centres[k] for k in sorted(centres)])
    return float(np.linalg.norm(np.diff(ordered, axis=0), axis=1).sum())
