"""A map that is whole: what one run leaves on the disk, and the next one continues, tidied, or joins to its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.trajectory import FramePose
from dualslam.atlas.warp import Warp
from dualslam.core.camera.base import Camera
from dualslam.core.types import FloatArray, Keyframe
from dualslam.map.submap import NO_LANDMARK, Submap

MAX_EARLIER_FRAMES = 100_000
"""Frames of earlier runs whose poses a map keeps, the newest: an hour of 30 Hz, 16 MB. All are in the run folders."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """Submaps with their links, and where each frame stands: what `save_atlas` writes and `load_atlas` reads."""

    atlas: Atlas
    poses: dict[int, FramePose]
    camera: Camera | None = None
    """By which the features are rectified, with what was found out about it; None in maps of before it was kept."""
    colours: Mapping[int, NDArray[np.uint8]] = field(default_factory=dict)
    """mapping of int to (N, 3) uint8: of each submap's landmarks; none where the map was saved without."""

    @property
    def next_id(self) -> int:
        """The first number that no frame of the map has: the count of frames goes on there."""
        kept = (k for m in self.atlas.submaps.values() for k in (*m.keyframes, *m.anchors))
        return 1 + max([*self.poses, *kept], default=-1)

    @property
    def main(self) -> list[int]:
        """The linked set of submaps with most posed frames: its first one's frame is the world of the saved run."""
        return self.atlas.largest(Counter(pose.submap_id for pose in self.poses.values()))


def tidy(atlas: Atlas, poses: Mapping[int, FramePose]) -> dict[int, FramePose]:
    """Take out of all submaps what is dead; return the frames' poses, relative to keyframes that are there.

    No pose and no landmark moves; landmarks have other ids afterwards.

    `atlas`: between two runs: no graph and no front end knows its rows.
    """
    newest = sorted(poses)[-MAX_EARLIER_FRAMES:]
    kept = {i: _re_anchored(poses[i], atlas.submaps[poses[i].submap_id]) for i in newest}
    for m, submap in atlas.submaps.items():
        _compact(submap)
        joints = [link for link in atlas.links if m in (link.a, link.b)]
        named = {k for link in joints for k in (*link.keyframes, link.keyframe_a, link.keyframe_b)}
        _drop_anchors(submap, {*named, *submap.gauge})
    return kept


def _re_anchored(pose: FramePose, submap: Submap) -> FramePose:
    if pose.keyframe_id in submap.keyframes:
        return pose
    return pose.at(submap.anchored(pose.keyframe_id, submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)))


def _compact(submap: Submap) -> None:
    """Leave only the rows that live, in their order."""
    alive = submap.landmarks["alive"]
    new_id = np.where(alive, np.cumsum(alive) - 1, NO_LANDMARK)
    submap.keep_observations(np.flatnonzero(submap.observations["alive"]))
    submap.observations["landmark"][:] = new_id[submap.observations["landmark"]]
    for k, ids in submap.landmark_of.items():
        submap.landmark_of[k] = np.where(ids >= 0, new_id[ids], NO_LANDMARK)
    submap.landmarks = submap.landmarks.taken(np.flatnonzero(alive))


def _drop_anchors(submap: Submap, wanted: Collection[int]) -> None:
    """Forget the culled keyframes that nothing asks for; the others stand on keyframes that are there."""
    for k, anchor in list(submap.anchors.items()):
        if k in wanted:
            submap.anchors[k] = submap.anchored(k, submap.resolve_anchor(anchor.keyframe_id, anchor.T_kf_cam))
        else:
            del submap.anchors[k]


def renumbered(
    atlas: Atlas, poses: Mapping[int, FramePose], first_submap: int, first_frame: int, shift_s: float
) -> tuple[Atlas, dict[int, FramePose]]:
    """Return an atlas and its frames with offsets added to all ids and times; the submaps given become the new ones.

    - `first_submap`, `first_frame`: added to ids of submaps, and to those of frames and keyframes.
    - `shift_s`: added to all times.
    """
    new = Atlas()
    for m, submap in atlas.submaps.items():
        _renumber(submap, m + first_submap, first_frame, shift_s)
        new.add(submap)
    new.links = [_link(link, first_submap, first_frame) for link in atlas.links]
    new.placement = {m + first_submap: S for m, S in atlas.placement.items()}
    new.warps = {m + first_submap: Warp(warp.index + first_frame, warp.S) for m, warp in atlas.warps.items()}
    new.held = {m + first_submap: frozenset(k + first_frame for k in ids) for m, ids in atlas.held.items()}
    moved = (
        FramePose(
            p.index + first_frame,
            p.timestamp_s + shift_s,
            p.submap_id + first_submap,
            p.keyframe_id + first_frame,
            p.T_kf_cam,
        )
        for p in poses.values()
    )
    return new, {pose.index: pose for pose in moved}


def _renumber(submap: Submap, submap_id: int, by: int, shift_s: float) -> None:
    submap.id = submap_id
    submap.keyframes = {
        k + by: Keyframe(k + by, kf.timestamp_s + shift_s, kf.features) for k, kf in submap.keyframes.items()
    }
    submap.T_submap_kf = {k + by: T for k, T in submap.T_submap_kf.items()}
    submap.landmark_of = {k + by: ids for k, ids in submap.landmark_of.items()}
    submap.anchors = {k + by: replace(a, keyframe_id=a.keyframe_id + by) for k, a in submap.anchors.items()}
    submap.relative_poses = {
        k + by: replace(r, keyframe_id=r.keyframe_id + by) for k, r in submap.relative_poses.items()
    }
    submap.gauge = (_moved(submap.gauge[0], by), _moved(submap.gauge[1], by))
    submap.condemned = {k + by for k in submap.condemned}
    submap.landmarks["first_kf"][:] += by
    submap.observations["kf"][:] += by


def _link(link: Link, submaps: int, frames: int) -> Link:
    return replace(
        link,
        a=link.a + submaps,
        b=link.b + submaps,
        keyframes=tuple(k + frames for k in link.keyframes),
        keyframe_a=_moved(link.keyframe_a, frames),
        keyframe_b=_moved(link.keyframe_b, frames),
    )


def _moved(keyframe_id: int, by: int) -> int:
    """Return an id with an offset; one below 0 is none."""
    return keyframe_id + by if keyframe_id >= 0 else keyframe_id


def bring_to_pixels(submap: Submap, K: FloatArray, scale_factor: float) -> None:
    """Bring a submap's features to the rectified pixels of other intrinsics: its map and its rays stay.

    Sizes of image patches, and the pyramid levels that they belong to, change with the focal length.

    - `K` (3, 3).
    - `scale_factor`: between two levels of the front end's pyramid.
    """
    own = submap.K
    if np.array_equal(own, K):
        return
    zoom = np.array([K[0, 0] / own[0, 0], K[1, 1] / own[1, 1]])
    factor = float(np.sqrt(zoom.prod()))
    levels = round(float(np.log(factor) / np.log(scale_factor)))
    for k, kf in submap.keyframes.items():
        f = kf.features
        features = replace(
            f,
            uv_rect_px=(f.uv_rect_px - own[:2, 2]) * zoom + K[:2, 2],
            sigma_px=f.sigma_px * factor,
            scale=f.scale * factor,
            octave=np.maximum(f.octave + levels, 0),
        )
        submap.keyframes[k] = Keyframe(kf.id, kf.timestamp_s, features)
    submap.landmarks["scale"][:] *= factor
    submap.K = np.array(K, float)
