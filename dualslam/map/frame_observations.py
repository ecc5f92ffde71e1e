"""Observations of a frame when it was posed: with the same landmarks it can be posed again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import is_first
from dualslam.core.types import Features, FloatArray, IntArray
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

    def uv_rect_now_px(self) -> FloatArray:
        """Return (N, 2) rectified pixels, with what has become of them since."""
        if not self.changes:
            return self.uv_rect_px.astype(np.float64)
        nothing = np.zeros(len(self.landmark_ids))
        uv_px, uv_rect_px = self.uv_px.astype(np.float64), self.uv_rect_px.astype(np.float64)
        features = Features(
            uv_px, uv_rect_px, self.sigma_px.astype(np.float64), nothing, nothing.astype(np.int64), nothing, nothing
        )
        for change in self.changes:
            features = change(features)
        return features.uv_rect_px


def seen_now(frames: Sequence[FrameObservations], submap: Submap) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return what frames see of a submap as it is: of what is left, each landmark once in a frame.

    Frames (M,), ascending, landmarks (M,), rectified pixels (M, 2) and their sigmas (M,).
    """
    # Neighbours have mostly gone through the same changes, which cost more by the call than by the pixel.
    joined = [_joined(list(alike)) for _, alike in groupby(frames, attrgetter("changes"))]
    frame, nothing = np.repeat(np.arange(len(frames)), [len(each.landmark_ids) for each in frames]), np.zeros(0)
    ids = submap.current_ids(np.concatenate([nothing, *(each.landmark_ids for each in joined)]).astype(np.int64))
    rows = np.flatnonzero((ids != NO_LANDMARK) & is_first(frame * (len(submap.landmarks) + 1) + ids))
    uv_px = np.concatenate([np.zeros((0, 2)), *(each.uv_rect_now_px() for each in joined)])
    return frame[rows], ids[rows], uv_px[rows], np.concatenate([nothing, *(each.sigma_px for each in joined)])[rows]


def _joined(frames: list[FrameObservations]) -> FrameObservations:
    """Return the observations of frames of the same changes as if one had made them."""
    return replace(
        frames[0],
        landmark_ids=np.concatenate([each.landmark_ids for each in frames]),
        uv_px=np.concatenate([each.uv_px for each in frames]),
        uv_rect_px=np.concatenate([each.uv_rect_px for each in frames]),
        sigma_px=np.concatenate([each.sigma_px for each in frames]),
    )
