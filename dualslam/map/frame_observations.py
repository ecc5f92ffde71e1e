"""Observations of a frame when it was posed: with the same landmarks it can be posed again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import is_first
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import settle_pose
from dualslam.core.types import Failure, Features, FloatArray, IntArray
from dualslam.map.submap import NO_LANDMARK, Submap

Change = Callable[[Features], Features]


@dataclass(frozen=True, slots=True, eq=False)
class FrameObservations:
    """A frame's observations of a submap. In single precision: a run keeps thousands."""

    submap_id: int
    landmark_ids: NDArray[np.int32]  # (N,)
    # As in `Features`.
    uv_px: NDArray[np.float32]  # (N, 2)
    uv_rect_px: NDArray[np.float32]  # (N, 2)
    sigma_px: NDArray[np.float32]  # (N,)
    changes: tuple[Change, ...] = ()
    """What has become of the submap's pixels since, another camera or another shutter: made when asked for."""

    @classmethod
    def of(cls, features: Features, landmark_ids: IntArray, submap_id: int) -> FrameObservations:
        """Return what a frame saw; `landmark_ids` (N,): the landmark of each of its features, or `NO_LANDMARK`."""
        rows = np.flatnonzero(landmark_ids != NO_LANDMARK)
        return cls(
            submap_id,
            landmark_ids[rows].astype(np.int32),
            features.uv_px.take(rows, axis=0).astype(np.float32),
            features.uv_rect_px.take(rows, axis=0).astype(np.float32),
            features.sigma_px[rows].astype(np.float32),
        )

    def in_submap(self, submap_id: int, id_of: IntArray) -> FrameObservations:
        """Return the same of another state of the submap: `id_of` each landmark's number there, or `NO_LANDMARK`."""
        ids = id_of[self.landmark_ids]
        known = ids != NO_LANDMARK
        return replace(
            self,
            submap_id=submap_id,
            landmark_ids=ids[known].astype(np.int32),
            uv_px=self.uv_px[known],
            uv_rect_px=self.uv_rect_px[known],
            sigma_px=self.sigma_px[known],
        )

    def with_change(self, change: Change) -> FrameObservations:
        """Return the same in the pixels of another camera or shutter."""
        return replace(self, changes=(*self.changes, change))

    def pose(self, submap: Submap, T_submap_cam: FloatArray, shape: float, min_inliers: int) -> FloatArray | None:
        """Return (4, 4) ``T_submap_cam`` by the current landmarks; None where they do not fix it.

        - `T_submap_cam` (4, 4): to begin with.
        - `shape`, `min_inliers`: see `settle_pose`.
        """
        ids, uv_px, sigma_px = self.seen_now(submap)
        pose = settle_pose(
            submap.K,
            se3.inverse(T_submap_cam),
            submap.landmarks["xyz_mu"][ids],
            uv_px,
            sigma_px,
            shape=shape,
            min_inliers=min_inliers,
        )
        return None if isinstance(pose, Failure) else se3.inverse(pose)

    def seen_now(self, submap: Submap) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return landmarks (M,), rectified pixels (M, 2) and their sigmas (M,): of what is left, each landmark once."""
        ids = submap.current_ids(self.landmark_ids.astype(np.int64))
        rows = np.flatnonzero((ids != NO_LANDMARK) & is_first(ids))
        return ids[rows], self.uv_rect_now_px()[rows], self.sigma_px[rows].astype(np.float64)

    def uv_rect_now_px(self) -> FloatArray:
        """Return (N, 2) rectified pixels, with what has become of them since."""
        if not self.changes:
            return self.uv_rect_px.astype(np.float64)
        n = len(self.landmark_ids)
        nothing = np.zeros(n)
        uv_px, uv_rect_px = self.uv_px.astype(np.float64), self.uv_rect_px.astype(np.float64)
        features = Features(
            uv_px, uv_rect_px, self.sigma_px.astype(np.float64), nothing, nothing.astype(np.int64), nothing, nothing
        )
        for change in self.changes:
            features = change(features)
        return features.uv_rect_px
