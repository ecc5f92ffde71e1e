"""How two places are compared: the front end's wide matching, and a search for what should be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.interfaces import Frontend
from dualslam.core.matchers import CELLS, Sighting
from dualslam.core.types import Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.matching import FeatureGrid, match_projected
from dualslam.frontends.tracking.local_map import LocalMap
from dualslam.map.submap import Submap


class FrontendPlaceMatcher:
    """A front end as the verification of places asks it (`dualslam.core.matchers.PlaceMatcher`)."""

    def __init__(self, frontend: Frontend, camera: Camera) -> None:
        self._frontend = frontend
        self._camera = camera
        self.max_distance = frontend.max_distance
        self.max_distance_strict = frontend.max_distance_strict

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Distance of paired descriptors."""
        return self._frontend.distance(a, b)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Match without a geometric guide, one to one."""
        return self._frontend.match_wide(a, b)

    def look(
        self,
        submap: Submap,
        landmark_ids: IntArray,
        T_cam_submap: FloatArray,
        K: FloatArray,
        features: Features,
        radius_px: float,
    ) -> Sighting:
        """Look for landmarks of a submap in an image, about where they should be under a pose."""
        frontend = self._frontend
        local = LocalMap.of_landmarks(submap, landmark_ids)
        seen = local.predict(T_cam_submap, K, self._camera, frontend.scale_factor, frontend.n_octaves)
        feature = np.full(len(seen.rows), -1, np.int64)
        if len(features) and len(seen.rows):
            matches = match_projected(
                frontend,
                FeatureGrid.build(features.uv_rect_px),
                features,
                seen.uv_px,
                radius_px * frontend.scale_factor**seen.octave,
                local.descriptors[seen.rows],
                octave=seen.octave,
            )
            feature[matches.index[:, 0]] = matches.index[:, 1]
        part = np.clip(self._camera.unrectify(seen.uv_px) / self._camera.size_px * CELLS, 0, CELLS - 1).astype(np.int64)
        return Sighting(local.landmark_ids[seen.rows], feature, CELLS * part[:, 1] + part[:, 0])
