"""Ending of a submap: its last estimate, an event, and frames that change to the next submap."""

from __future__ import annotations

import logging
from dataclasses import replace

from dualslam.atlas.record import Record
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.interfaces import SubmapGraph
from dualslam.map.split import shared_landmarks, take_out
from dualslam.map.submap import Submap

log = logging.getLogger(__name__)


def archive(record: Record, submap: Submap, graph: SubmapGraph, why: str) -> None:
    """Take the last estimate of a submap's graph, and note that the submap is archived."""
    try:
        final = graph.full_estimate(submap)
        submap.apply_estimate(*final.values)
    except SolverError:
        log.warning("submap %d is archived as it stands: its graph gives no estimate", submap.id)
    # A submap that rolled over and was lost at once has no frame of its own: its newest keyframe stands for it, and the
    # newest frame where all its keyframes are of earlier runs.
    posed = {pose.index for pose in record.own_poses() if pose.submap_id == submap.id}
    last = max(posed or submap.keyframes.keys() & record.rows.keys() or record.rows)
    record.event(
        EventKind.ARCHIVED,
        record.rows[last],
        submap.id,
        why=why,
        keyframes=len(submap.keyframes),
        landmarks=int(submap.landmarks["alive"].sum()),
    )


def hand_frames_over(record: Record, old: Submap, new: Submap) -> None:
    """Let the frames that are posed relative to keyframes which both submaps hold take their pose from the new one."""
    anchored = {p.index: old.keyframe_for(p.keyframe_id) for p in record.poses.values() if p.submap_id == old.id}
    id_of = shared_landmarks(old, new)
    for i, k in anchored.items():
        if k in new.keyframes:
            pose = record.poses[i]
            T_submap_cam = old.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
            record.poses[i] = replace(pose.at(old.anchored(k, T_submap_cam)), submap_id=new.id)
            if i in record.observations and record.observations[i].submap_id == old.id:
                record.observations[i] = record.observations[i].in_submap(new.id, id_of)
            if i in record.rows:  # it may be another run's
                record.rows[i].submap = new.id


def part_off(record: Record, old: Submap, part: Submap, anchor: int) -> None:
    """Take a submap into the atlas that was made of some keyframes of another, which gives them and their frames up.

    `anchor`: the keyframe of the old one that they are anchored to there.
    """
    hand_frames_over(record, old, part)
    take_out(old, list(part.keyframes), anchor)
    record.atlas.add(part)
