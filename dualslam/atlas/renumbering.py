"""The map of another run with numbers of its own: submaps, keyframes and frames counted on from an offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.trajectory import FramePose
from dualslam.atlas.warp import Warp
from dualslam.core.types import FloatArray, Keyframe
from dualslam.map.submap import Submap


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
