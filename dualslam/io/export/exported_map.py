"""Common input of all exports: the main map of a run as flat arrays, in one frame and one unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.stored_map import StoredMap
from dualslam.atlas.trajectory import FramePose, compose
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.io.colours import padded
from dualslam.io.map_store import load_atlas

MIN_VIEWS = 2
"""Landmarks that fewer of the exported keyframes see are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportedMap:
    """The main map: V views, P points, R observations.

    A keyframe that two submaps share appears once, in the submap that its frame's pose belongs to. What a by-pass has
    marked invalid is left out.
    """

    frame: IntArray  # (V,): keyframes, by their number in the map, ascending
    timestamp_s: FloatArray  # (V,)
    camera: IntArray  # (V,): row of `K`
    K: FloatArray  # (C, 3, 3): pinhole intrinsics of rectified pixels: submaps may have been calibrated apart
    size_px: tuple[int, int]  # width and height
    T_world_cam: FloatArray  # (V, 4, 4): camera to world; the world is the frame of the main map's first submap
    xyz: FloatArray  # (P, 3): world, unit of the map; metres where the map has a metric scale
    colour: NDArray[np.uint8]  # (P, 3): red, green, blue; `GREY` where no colour is known
    # Rows of the views and the points, sorted by point, then by view.
    view: IntArray  # (R,)
    point: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2): rectified pixels; the centre of the first pixel is (0, 0)
    sigma_px: FloatArray  # (R,)
    feature: IntArray  # (R,): row of the observation among the features of its keyframe

    def reprojection_errors_px(self) -> FloatArray:
        """Return (R,) distances between observations and projections; NaN behind the camera."""
        T_cam_world = se3.inverse(self.T_world_cam)[self.view]
        p = np.einsum("rij,rj->ri", T_cam_world[:, :3, :3], self.xyz[self.point]) + T_cam_world[:, :3, 3]
        z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
        K = self.K[self.camera[self.view]]
        uv = np.stack([K[:, 0, 0] * p[:, 0] / z + K[:, 0, 2], K[:, 1, 1] * p[:, 1] / z + K[:, 1, 2]], 1)
        return np.asarray(np.linalg.norm(uv - self.uv_px, axis=1))

    def rows_by_index(self, numbers: Mapping[int, int]) -> dict[int, int]:
        """Return the views that are frames of a run, by their index in its source; `numbers` as of `read_numbers`."""
        row_of = {k: v for v, k in enumerate(self.frame.tolist())}
        return {index: row_of[number] for index, number in numbers.items() if number in row_of}

    def of_views(self, kept: BoolArray) -> ExportedMap:
        """Return what is left with some of the views (V,) alone: their observations, and points that enough see."""
        of_kept = kept[self.view]
        seen = np.bincount(self.point[of_kept], minlength=len(self.xyz)) >= MIN_VIEWS
        rows = of_kept & seen[self.point]
        return replace(
            self,
            frame=self.frame[kept],
            timestamp_s=self.timestamp_s[kept],
            camera=self.camera[kept],
            T_world_cam=self.T_world_cam[kept],
            xyz=self.xyz[seen],
            colour=self.colour[seen],
            view=(np.cumsum(kept) - 1)[self.view[rows]],
            point=(np.cumsum(seen) - 1)[self.point[rows]],
            uv_px=self.uv_px[rows],
            sigma_px=self.sigma_px[rows],
            feature=self.feature[rows],
        )

    def scaled(self, factor: float) -> ExportedMap:
        """Return the same map with all lengths times `factor`."""
        return replace(self, T_world_cam=se3.scaled(self.T_world_cam, factor), xyz=self.xyz * factor)


def read_stored(run: Path) -> StoredMap:
    """Read the map of a run folder, for `flatten`.

    Raises `InputError` if there is none, or it is damaged, or it has no submap.
    """
    stored = load_atlas(run)
    if not stored.main:
        raise InputError(f"{run} has no map to export: no frame was posed.")
    if stored.camera is None:
        raise InputError(f"{run} was written before maps kept their camera; run it again.")
    return stored


def flatten(stored: StoredMap) -> ExportedMap:
    """Return the main map as flat arrays."""
    atlas, main = stored.atlas, stored.main
    S_world = atlas.S_world_submap(main)
    owner = _owners(stored)
    frames = np.array(sorted(owner), np.int64)
    row_of = {k: i for i, k in enumerate(frames.tolist())}
    T_world_cam = np.array(
        [sim3.act_on_pose(S_world[owner[k]], atlas.submaps[owner[k]].T_submap_kf[k]) for k in row_of]
    )
    xyz, rows, rgb, n_points = [], [], [], 0
    for m in main:
        submap, obs = atlas.submaps[m], atlas.submaps[m].observations
        healthy = submap.landmarks["alive"] & ~submap.landmarks["condemned"]
        own = np.array([owner.get(k) == m for k in submap.keyframes], bool)
        kept = obs["alive"] & healthy[obs["landmark"]] & np.isin(obs["kf"], np.array(list(submap.keyframes))[own])
        kf, feature, landmark = (obs[name][kept] for name in ("kf", "feature", "landmark"))
        ids, point, n_views = np.unique(landmark, return_inverse=True, return_counts=True)
        enough = n_views >= MIN_VIEWS
        new_row = np.cumsum(enough) - 1
        seen = enough[point]
        features = {k: submap.keyframes[k].features for k in np.unique(kf).tolist()}
        pairs = list(zip(kf[seen].tolist(), feature[seen].tolist(), strict=True))
        rows.append(
            (
                np.array([row_of[k] for k, _ in pairs], np.int64),
                n_points + new_row[point[seen]],
                np.array([features[k].uv_rect_px[i] for k, i in pairs]).reshape(-1, 2),
                np.array([features[k].sigma_px[i] for k, i in pairs]),
                feature[seen],
            )
        )
        xyz.append(submap.landmarks["xyz_mu"][ids[enough]] @ S_world[m][:3, :3].T + S_world[m][:3, 3])
        rgb.append(padded(stored.colours, m, len(submap.landmarks))[ids[enough]])
        n_points += int(enough.sum())
    view, point, uv, sigma, feature = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.lexsort((view, point))
    camera = stored.camera
    assert camera is not None
    K = np.array([atlas.submaps[m].K for m in main])
    return ExportedMap(
        frame=frames,
        timestamp_s=np.array([atlas.submaps[owner[k]].keyframes[k].timestamp_s for k in row_of]),
        camera=np.array([main.index(owner[k]) for k in row_of], np.int64),
        K=K,
        size_px=camera.size_px,
        T_world_cam=T_world_cam,
        xyz=np.concatenate(xyz),
        colour=np.concatenate(rgb),
        view=view[order],
        point=point[order],
        uv_px=uv[order],
        sigma_px=sigma[order],
        feature=feature[order],
    )


def with_frames(exported: ExportedMap, stored: StoredMap, chosen: Iterable[int]) -> ExportedMap:
    """Return the map with more views: posed frames that are no keyframes, which observe no point.

    - `exported`: that of `flatten`, in the map's unit.
    - `chosen`: frames, by their number in the map. Those that are views already, have no pose in the main map, or hang
      on a keyframe that a by-pass has marked invalid are ignored.
    """
    atlas, main = stored.atlas, stored.main
    new = sorted(set(chosen) & stored.poses.keys() - set(exported.frame.tolist()))
    poses = [pose for pose in map(stored.poses.__getitem__, new) if pose.submap_id in main and _holds(pose, atlas)]
    if not poses:
        return exported
    T_world_cam = compose(poses, atlas, atlas.S_world_submap(main)).T_world_cam
    frame = np.concatenate([exported.frame, [pose.index for pose in poses]])
    order = np.argsort(frame)
    place = np.argsort(order)
    return replace(
        exported,
        frame=frame[order],
        timestamp_s=np.concatenate([exported.timestamp_s, [pose.timestamp_s for pose in poses]])[order],
        camera=np.concatenate([exported.camera, [main.index(pose.submap_id) for pose in poses]])[order],
        T_world_cam=np.concatenate([exported.T_world_cam, T_world_cam])[order],
        view=place[exported.view],
    )


def _holds(pose: FramePose, atlas: Atlas) -> bool:
    submap = atlas.submaps[pose.submap_id]
    return submap.keyframe_for(pose.keyframe_id) not in submap.condemned


def _owners(stored: StoredMap) -> dict[int, int]:
    """Return the submap that each keyframe of the main map is exported from."""
    owner: dict[int, int] = {}
    atlas: Atlas = stored.atlas
    for m in stored.main:
        for k in atlas.submaps[m].keyframes:
            if k in atlas.submaps[m].condemned:
                continue
            posed_in = stored.poses[k].submap_id if k in stored.poses else m
            if k not in owner or posed_in == m:
                owner[k] = m
    return owner
