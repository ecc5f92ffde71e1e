"""Tracks of a front end that is not the live one, through frames whose poses in a submap are known.

It holds no landmarks of the submap and none of its descriptors. It holds pixels of its own features, matched by
themselves. Each frame's pose is relative to a keyframe of the submap, so that its points move with the submap's graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.core.camera.base import Camera, rectify
from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry import se3
from dualslam.core.geometry.triangulation import in_front, triangulate_n_view
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MAX_DEPTH_SIGMA
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, FloatArray, IntArray, Matches, View
from dualslam.frontends.features.image_features import ImageFeatures
from dualslam.frontends.tracking.turning import correct_shutter
from dualslam.map.submap import Submap

NO_TRACK = -1


@dataclass(frozen=True, slots=True, eq=False)
class TrackViews:
    """N tracks in V frames."""

    T_cam_submap: FloatArray  # (V, 4, 4)
    uv_px: FloatArray  # (N, V, 2): rectified; zero where not visible
    sigma_px: FloatArray  # (N, V)
    visible: BoolArray  # (N, V)


class AuxiliaryMap:
    """Features of another front end in some frames, and which of them belong together.

    `submap`: only the poses of its keyframes are read.
    """

    def __init__(self, submap: Submap) -> None:
        self._submap = submap
        self._features: dict[int, Features] = {}
        self._track_of: dict[int, IntArray] = {}
        self._place: dict[int, tuple[int, FloatArray]] = {}
        self._n_tracks = 0

    @property
    def frames(self) -> list[int]:
        """Frames with features and a pose, in the order in which they were posed."""
        return [index for index in self._place if index in self._features]

    @property
    def posed(self) -> list[int]:
        """Frames with a pose, with or without features, in the order in which they were posed."""
        return list(self._place)

    def has_features(self, index: int) -> bool:
        """Whether a frame's features were taken in."""
        return index in self._features

    def features(self, index: int) -> Features:
        """Return the features of a frame."""
        return self._features[index]

    def T_cam_submap(self, index: int) -> FloatArray:
        """Return where a frame stands by the submap's current poses."""
        return se3.inverse(self._submap.resolve_anchor(*self._place[index]))

    def add(self, index: int, features: Features, matches: Mapping[int, Matches]) -> None:
        """Take a frame's features in.

        `matches`: rows of an earlier frame's features, rows of `features`; where two earlier frames disagree, the first
        holds.
        """
        self._features[index] = features
        self._track_of[index] = np.full(len(features), NO_TRACK, np.int64)
        for other, found in matches.items():
            self._extend(other, index, found.index)

    def drop(self, index: int) -> None:
        """Forget a frame that found no pose, or no features."""
        for of in (self._features, self._track_of, self._place):
            of.pop(index, None)

    def put(self, index: int, reference_id: int, T_cam_submap: FloatArray) -> None:
        """Say where a frame stands, relative to a keyframe of the submap (which may be the frame itself)."""
        T_submap_kf = self._submap.resolve_anchor(reference_id, se3.IDENTITY)
        self._place[index] = reference_id, se3.inverse(T_submap_kf) @ se3.inverse(T_cam_submap)

    def rows_with_track(self, index: int) -> IntArray:
        """Return the features of a frame that an earlier or later frame was found to see too."""
        return np.flatnonzero(self._track_of[index] != NO_TRACK)

    def views(self, tracks_of: int, rows: IntArray, frames: list[int]) -> TrackViews:
        """Return the pixels, in `frames`, of the tracks of some features of frame `tracks_of`.

        - `rows` (N,): features that have a track.
        - `frames`: with a pose.
        """
        wanted = self._track_of[tracks_of][rows]
        n, n_views = len(wanted), len(frames)
        uv, sigma, visible = np.zeros((n, n_views, 2)), np.ones((n, n_views)), np.zeros((n, n_views), bool)
        for v, index in enumerate(frames):
            row_of = np.full(self._n_tracks, NO_TRACK)
            has = self.rows_with_track(index)
            row_of[self._track_of[index][has]] = has
            row = row_of[wanted]
            visible[:, v] = row >= 0
            uv[visible[:, v], v] = self._features[index].uv_rect_px[row[row >= 0]]
            sigma[visible[:, v], v] = self._features[index].sigma_px[row[row >= 0]]
        T = se3.stack([self.T_cam_submap(index) for index in frames])
        return TrackViews(T, uv, sigma, visible)

    def _extend(self, other: int, index: int, pairs: IntArray) -> None:
        """Let matched features share a track, at most one feature of each frame on a track."""
        a, b = self._track_of[other], self._track_of[index]
        rows_a, rows_b = pairs[:, 0], pairs[:, 1]
        new = (a[rows_a] == NO_TRACK) & (b[rows_b] == NO_TRACK)
        ids = self._n_tracks + np.arange(int(new.sum()))
        a[rows_a[new]] = b[rows_b[new]] = ids
        self._n_tracks += len(ids)
        onwards = (a[rows_a] != NO_TRACK) & (b[rows_b] == NO_TRACK) & ~np.isin(a[rows_a], b)
        b[rows_b[onwards]] = a[rows_a[onwards]]
        back = (a[rows_a] == NO_TRACK) & (b[rows_b] != NO_TRACK) & ~np.isin(b[rows_b], a)
        a[rows_a[back]] = b[rows_b[back]]


def triangulate(views: TrackViews, K: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return points (N, 3) in the submap, and which are well enough known to find a pose by."""
    n_seen = views.visible.sum(axis=1)
    xyz = np.full((len(views.visible), 3), np.nan)
    good = np.zeros(len(xyz), bool)
    seen = np.flatnonzero(n_seen >= 2)
    if len(seen) == 0:
        return xyz, good
    visible = views.visible[seen]
    points = triangulate_n_view(views.uv_px[seen], K, views.T_cam_submap, visible)
    xyz[seen] = points.xyz
    sigma = views.sigma_px[seen]
    fits = ((points.error2 < CHI2_95[2] * sigma**2) | ~visible).all(axis=1)
    # Depth is off by about its pixel's noise over the parallax.
    parallax_rad = np.arccos(np.clip(points.min_cos_parallax, -1.0, 1.0))
    certain = parallax_rad * K[0, 0] * MAX_DEPTH_SIGMA > np.where(visible, sigma, 0.0).max(axis=1)
    good[seen] = fits & certain & in_front(points.depth) & np.isfinite(points.xyz).all(axis=1)
    return xyz, good


class OwnFeatures:
    """Those that the live front end has found: it is its own auxiliary front end."""

    def of(self, view: View) -> Features | Failure:
        """Return the view's own features."""
        return view.features

    def prefetch(self, views: Iterable[View]) -> None:
        """Do nothing: they are there."""


class BufferedFeatures:
    """Features that another front end finds in the buffered images."""

    def __init__(self, images: ImageFeatures, model_sigma_px: float, camera: Camera) -> None:
        self._images = images
        self._model_sigma_px = model_sigma_px
        self._camera = camera

    def of(self, view: View) -> Features | Failure:
        """Return the features of a view; a failure where its image is gone."""
        if view.image is None:
            return Failure(FailureReason.UNREADABLE, "its image is no longer buffered")
        features = rectify(self._images.of(view.image), self._camera, self._model_sigma_px)
        return features if view.turn_rad is None else correct_shutter(features, self._camera, view.turn_rad)

    def prefetch(self, views: Iterable[View]) -> None:
        """Say which views will be asked for next, in this order: their features may be found beforehand."""
        self._images.prefetch(view.image for view in views if view.image is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Auxiliary:
    """A front end that poses frames, and where its features come from."""

    frontend: Frontend
    features: OwnFeatures | BufferedFeatures
