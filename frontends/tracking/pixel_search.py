"""Landmarks found by a pixel matcher where guided search finds too few."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np

from dualslam.core.arrays import concatenate, median
from dualslam.core.camera.base import Camera
from dualslam.core.errors import FrontendError
from dualslam.core.geometry import se3
from dualslam.core.interfaces import Frontend, PixelMatcher
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.noise_model import TINY
from dualslam.core.types import Failure, Features, FloatArray, FrameMethod, IntArray, Track, View
from dualslam.frontends.features.image_features import features_found
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.turning import find_as_read
from dualslam.map.submap import NO_LANDMARK, Submap

N_KEYFRAMES = 4
"""Keyframes that a matcher is given beside the last frame."""
THIN = 0.4
"""Share of the usual inliers below which they thin out. A view that turns away loses less from frame to frame."""
LEVEL_FRAMES = 15
"""Guided frames whose median is the usual number of inliers."""
MAX_CHAIN_S = 3.0
"""Time for which pixels alone pose frames. The keyframes that they are compared with show ever less."""


class PixelSearch:
    """Asks a pixel matcher for landmarks, and makes features of those that it finds.

    - `frontend`: the live one.
    - `camera`: the camera that rectifies the features now.
    - `model_sigma_px`: error of its model, see `CameraConfig.model_sigma_px`.
    """

    def __init__(
        self,
        matcher: PixelMatcher,
        images: KeyframeImages,
        frontend: Frontend,
        camera: Callable[[], Camera],
        model_sigma_px: float,
    ) -> None:
        self._matcher, self._images, self._frontend, self._camera = matcher, images, frontend, camera
        self._model_sigma_px = model_sigma_px
        self._usual: deque[int] = deque(maxlen=LEVEL_FRAMES)
        self._n_chain, self._guided_s = 0, 0.0

    def is_due(self, view: View, track: Track | Failure) -> bool:
        """Whether a frame's landmarks are too few by guided search, and the chain of such frames is short enough."""
        if self._n_chain and abs(view.timestamp_s - self._guided_s) > MAX_CHAIN_S:
            return False
        if isinstance(track, Failure):
            return True
        return bool(self._usual) and track.n_inliers < THIN * float(median(np.array(self._usual)))

    def note(self, track: Track) -> None:
        """Note how a frame was posed."""
        if track.method is FrameMethod.DIRECT:
            self._n_chain += 1
            return
        self._n_chain, self._guided_s = 0, track.view.timestamp_s
        self._usual.append(track.n_inliers)

    def extend(self, submap: Submap, last: Track, view: View, T_predicted: FloatArray) -> tuple[View, IntArray] | None:
        """Return a view with features found by pixels behind its own, and the landmark of each; None without any.

        Their noise grows with the chain of frames that pixels alone have posed: errors of neighbouring patches, and of
        one frame after the other, go together.
        """
        if view.image is None:
            return None
        camera = self._camera()
        references, described = self._references(submap, last, camera)
        if not references:
            return None
        found = checked_matches(self._matcher, self._matcher.find(references, view.image.pixels(), camera, T_predicted))
        row = np.flatnonzero(np.isin(found.landmark_ids, described.ids))
        if len(row) == 0:
            return None
        ids = found.landmark_ids[row]
        of, depth_mu = described.rows(ids)
        depth_new = submap.depths(ids, T_predicted)
        zoom = np.where(depth_new > 0, depth_mu / np.maximum(depth_new, TINY), 1.0)
        kept, features = features_found(
            of,
            found.uv_px[row],
            found.sigma_px[row] * np.sqrt(1.0 + self._n_chain),
            zoom,
            np.zeros(len(row)),
            self._frontend,
            camera,
            self._model_sigma_px,
            view.turn_rad,
        )
        landmark_ids = np.full(len(view.features), NO_LANDMARK, np.int64)
        extended = replace(view, features=concatenate([view.features, features]))
        return extended, np.concatenate([landmark_ids, ids[kept]])

    def _references(self, submap: Submap, last: Track, camera: Camera) -> tuple[tuple[PosedImage, ...], _Described]:
        """Return the last frame and the keyframes that show the same, with how each of their landmarks is described."""
        references, described = [], _Described()
        seen = last.seen_ids
        near = [int(k) for k in submap.covisible(seen)[0] if int(k) in self._images and int(k) != last.view.index]
        views = [(last.view, last.T_cam_submap, last.landmark_ids)]
        for k in sorted(near[:N_KEYFRAMES], reverse=True):
            keyframe, kept = submap.keyframes[k], self._images[k]
            view = View(k, keyframe.timestamp_s, keyframe.features, kept.image, kept.turn_rad)
            views.append((view, se3.inverse(submap.T_submap_kf[k]), submap.landmark_of[k]))
        for view, T_cam_submap, landmark_ids in views:
            row = np.flatnonzero(landmark_ids >= 0)
            depth_mu = submap.depths(landmark_ids[row], T_cam_submap)
            row, depth_mu = row[depth_mu > 0], depth_mu[depth_mu > 0]
            if view.image is None or len(row) == 0:
                continue
            features = view.features.take(row)
            uv_px = features.uv_px
            if view.turn_rad is not None:
                uv_px = find_as_read(uv_px, features.uv_rect_px, camera, view.turn_rad)
            ids = landmark_ids[row]
            references.append(PosedImage(view.index, view.image.pixels(), T_cam_submap, ids, uv_px, depth_mu))
            described.add(ids, features, depth_mu)
        return tuple(references), described


class _Described:
    """A feature and a depth for each landmark: those of the first reference that shows it."""

    def __init__(self) -> None:
        self.ids: IntArray = np.zeros(0, np.int64)
        self._features: list[Features] = []
        self._depth_mu: list[FloatArray] = []

    def add(self, ids: IntArray, features: Features, depth_mu: FloatArray) -> None:
        """Add the landmarks of a reference that those before it do not show."""
        new = ~np.isin(ids, self.ids)
        self.ids = np.concatenate([self.ids, ids[new]])
        self._features.append(features.take(new))
        self._depth_mu.append(depth_mu[new])

    def rows(self, ids: IntArray) -> tuple[Features, FloatArray]:
        """Return the features and depths of landmarks that are here."""
        order = np.argsort(self.ids)
        row = order[np.searchsorted(self.ids, ids, sorter=order)]
        return concatenate(self._features).take(row), np.concatenate(self._depth_mu)[row]


def checked_matches(matcher: PixelMatcher, found: object) -> PixelMatches:
    """Return what a pixel matcher found, if it is what it should be.

    Raises `FrontendError` if it is not `PixelMatches`, or its arrays do not belong together.
    """
    problem = None
    if not isinstance(found, PixelMatches):
        problem = f"a {type(found).__name__}, not dualslam.core.matchers.PixelMatches"
    else:
        n = len(found.landmark_ids)
        if np.shape(found.uv_px) != (n, 2) or np.shape(found.sigma_px) != (n,):
            problem = f"uv_px {np.shape(found.uv_px)} and sigma_px {np.shape(found.sigma_px)} for {n} landmarks"
        elif not (np.isfinite(found.uv_px).all() and (found.sigma_px > 0).all()):
            problem = "pixels that are not finite, or sigmas that are not above 0"
        elif len(np.unique(found.landmark_ids)) < n:
            problem = "a landmark twice"
    if problem is not None:
        raise FrontendError(
            f"pixel matcher '{type(matcher).__module__}:{type(matcher).__qualname__}': find returned {problem}; "
            "dualslam.testing.pixel_matching.check_matcher says all that is wrong with it."
        )
    return cast(PixelMatches, found)
