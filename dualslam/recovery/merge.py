"""Merging of reverse tracking's additions to a snapshot into the submap as it has become meanwhile.

Three states of one submap: the snapshot (`base`), the snapshot with what the walk added (`grown`), and the submap that
went on (`live`). That one may have been solved again, changed its camera, or been archived. Landmarks older than the
snapshot have the same ids in all three. Rows of observations keep theirs from the snapshot to the grown one; in the
live submap they are identified by keyframe, feature and landmark. What the walk added are observations; its poses and
points are initial values for the next solution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.arrays import is_first
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import Anchor
from dualslam.map.frame_observations import Change
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.map.submap_change import change_of_frame


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """A submap with what reverse tracking added, not solved yet."""

    submap: Submap  # a copy of the live one with the additions
    moved: Submap  # the walk's own state of it, in the frame and unit of the live one
    S_live_grown: FloatArray  # (4, 4): from the frame in which the walk has ended to the live one's
    id_of: IntArray  # (L,): of each landmark of the walk's own state the one that it is in the submap, or `NO_LANDMARK`


def merge_recovery(live: Submap, base: Submap, grown: Submap, change: Change | None = None) -> Merged:
    """Put the additions of reverse tracking into a copy of the live submap.

    - `live`, `base`, `grown`: three states of one submap, see above. The keyframes of its gauge stand in all of them.
    - `change`: gives features of the walk the pixels of the camera that the live submap has now, if it is another.
    """
    S_live_grown = change_of_frame(grown, live, base.keyframes, len(base.landmarks))
    moved = grown.copy()
    moved.transform(
        float(sim3.scale(S_live_grown)), se3.from_parts(sim3.rotation(S_live_grown), sim3.translation(S_live_grown))
    )
    merged = live.copy()
    _add_keyframes(merged, base, moved, change)
    _remove_rejected(merged, base, moved)
    id_of = _identify(merged, base, moved)
    id_of = _add_landmarks(merged, base, moved, id_of)
    merged.add_observations(*_new_rows(merged, base, moved, id_of))
    _add_counts(merged, base, moved)
    return Merged(merged, moved, S_live_grown, _heirs_in(merged, moved, id_of))


def _add_keyframes(merged: Submap, base: Submap, moved: Submap, change: Change | None) -> None:
    """The walk's keyframes stand before the live ones, oldest first: the last in order stay the live end's newest."""
    new = sorted(k for k in moved.keyframes if k not in base.keyframes and k not in merged.keyframes)
    added = {k: moved.keyframes[k] for k in new}
    if change is not None:
        added = {k: replace(keyframe, features=change(keyframe.features)) for k, keyframe in added.items()}
    merged.keyframes = added | merged.keyframes
    for k, keyframe in added.items():
        merged.T_submap_kf[k] = moved.T_submap_kf[k]
        merged.landmark_of[k] = np.full(len(keyframe.features), NO_LANDMARK, np.int64)
    for k, anchor in moved.anchors.items():
        if k not in merged.keyframes and k not in merged.anchors:
            merged.anchors[k] = Anchor(anchor.keyframe_id, anchor.T_kf_cam)
    for k, known in moved.relative_poses.items():
        if k in added and known.keyframe_id in merged.keyframes:
            merged.relative_poses[k] = known


def _remove_rejected(merged: Submap, base: Submap, moved: Submap) -> None:
    """Drop the observations that the walk's solver found to disagree."""
    n = len(base.observations)
    died = np.flatnonzero(base.observations["alive"] & ~moved.observations["alive"][:n])
    kf, feature, landmark = (base.observations[name][died] for name in ("kf", "feature", "landmark"))
    heir = moved.current_ids(landmark)
    # Those of merged landmarks went over to another one, and those of culled keyframes went with them.
    judged = ((heir == landmark) | (heir == NO_LANDMARK)) & np.isin(kf, list(moved.keyframes))
    merged.remove_observations(merged.find_observations(kf[judged], feature[judged], landmark[judged]))
    touched = np.unique(landmark[judged])
    merged.remove_landmarks(touched[merged.n_observations(touched) < 2])


def _identify(merged: Submap, base: Submap, moved: Submap) -> IntArray:
    """Return for each landmark of the walk the one that it is in the merged submap, if that is known already.

    An older one than the snapshot is the same. A newer one is that which the live submap has given one of its features.
    """
    n = len(base.landmarks)
    id_of = np.full(len(moved.landmarks), NO_LANDMARK, np.int64)
    heir = moved.current_ids(np.arange(n))
    for j in np.flatnonzero((heir != np.arange(n)) & (heir != NO_LANDMARK) & merged.landmarks["alive"][:n]).tolist():
        h = int(heir[j])
        if h >= n and id_of[h] == NO_LANDMARK:
            id_of[h] = j
            continue
        kept = merged.current_id(h if h < n else int(id_of[h]))
        if merged.landmarks["alive"][kept]:
            merged.merge_landmarks(np.array([kept]), np.array([j]))
    id_of[:n] = merged.current_ids(np.arange(n))
    id_of[n:] = merged.current_ids(id_of[n:])
    kf, feature, landmark = _rows_with_a_place(merged, base, moved)
    for k in np.unique(kf).tolist():
        here = (kf == k) & (landmark >= n)
        there = merged.landmark_of[k][feature[here]]
        same = (there != NO_LANDMARK) & (id_of[landmark[here]] == NO_LANDMARK)
        id_of[landmark[here][same]] = there[same]
    return id_of


def _add_landmarks(merged: Submap, base: Submap, moved: Submap, id_of: IntArray) -> IntArray:
    """Append the walk's landmarks that are new and still seen by two keyframes; return the completed `id_of`."""
    n = len(base.landmarks)
    _, _, landmark = _rows_with_a_place(merged, base, moved)
    seen = np.bincount(landmark, minlength=len(moved.landmarks))
    new = np.flatnonzero((id_of == NO_LANDMARK) & moved.landmarks["alive"] & (seen >= 2))
    new = new[new >= n]
    id_of = id_of.copy()
    id_of[new] = merged.copy_landmarks(moved, new)
    return id_of


def _heirs_in(merged: Submap, moved: Submap, id_of: IntArray) -> IntArray:
    """Complete `id_of`: a landmark that the walk has merged into another has the other's id, dead ones have none."""
    return merged.current_ids(np.where(id_of != NO_LANDMARK, id_of, moved.by_heirs(id_of)))


def _new_rows(merged: Submap, base: Submap, moved: Submap, id_of: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return keyframe, feature and landmark of the walk's observations that have a place in the merged submap."""
    kf, feature, landmark = _rows_with_a_place(merged, base, moved)
    ids = id_of[landmark]
    free = ids != NO_LANDMARK
    for k in np.unique(kf[free]).tolist():
        here = np.flatnonzero(free & (kf == k))
        there = merged.landmark_of[k]
        ok = (there[feature[here]] == NO_LANDMARK) & ~np.isin(ids[here], there)
        ok &= is_first(ids[here]) & is_first(feature[here])
        free[here] = ok
    return kf[free], feature[free], ids[free]


def _add_counts(merged: Submap, base: Submap, moved: Submap) -> None:
    """How often tracking should have seen a landmark, and did, holds for both ends."""
    n = len(base.landmarks)
    own = np.flatnonzero(moved.landmarks["alive"][:n] & merged.landmarks["alive"][:n])
    for name in ("n_visible", "n_found"):
        merged.landmarks[name][own] += moved.landmarks[name][own] - base.landmarks[name][own]


def _rows_with_a_place(merged: Submap, base: Submap, moved: Submap) -> tuple[IntArray, IntArray, IntArray]:
    """Keyframe, feature and landmark of what the walk observed and still holds, where `merged` has that feature too."""
    obs, n = moved.observations, len(base.observations)
    rows = n + np.flatnonzero(obs["alive"][n:])
    kf, feature, landmark = obs["kf"][rows], obs["feature"][rows], obs["landmark"][rows]
    n_common = {
        k: merged.keyframes[k].features.n_common(moved.keyframes[k].features)
        for k in np.unique(kf).tolist()
        if k in merged.keyframes
    }
    held = feature < np.array([n_common.get(k, 0) for k in kf.tolist()], np.int64)
    return kf[held], feature[held], landmark[held]
