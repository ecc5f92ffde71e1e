"""The landmarks that tracking looks for: those of the keyframes that see what the camera sees now."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import quantile
from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.interfaces import Frontend
from dualslam.core.matchers import CELLS, Sighting
from dualslam.core.noise_model import MAJORITY, PROOF_VIEWS, TINY
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.matching import FeatureGrid, match_projected
from dualslam.map.submap import Submap

VIEW_COSINE_MIN = 0.5  # a patch seen from more than 60 degrees off its mean direction does not look the same
SAFE = 2
"""With fewer proven landmarks than so many times the inliers that are asked for, or than the majority, all are used."""
NEARER, NEAREST = 0.5, 0.05
"""Too near is nearer than so many times the depth of the nearest proven points (this share of them)."""


def covering_keyframes(submap: Submap, at_most: int, min_new: int) -> list[int]:
    """Return few keyframes that together show most of the map.

    Each shows the most landmarks that those before it do not (ties: lower id), and `min_new` of them at least.
    """
    seen = np.zeros(len(submap.landmarks), bool)
    left = {k: submap.seen_in(k) for k in sorted(submap.keyframes)}
    chosen: list[int] = []
    while left and len(chosen) < at_most:
        n_new = {k: np.count_nonzero(~seen[ids]) for k, ids in left.items()}
        best = max(n_new, key=lambda k: n_new[k])
        if n_new[best] < min_new:
            break
        seen[left.pop(best)] = True
        chosen.append(best)
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where landmarks should be seen: rows of the local map, rectified pixels, and the octave of their patch."""

    rows: IntArray
    uv_px: FloatArray
    octave: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """A snapshot of landmarks, as contiguous arrays (N rows), that lives until the next keyframe."""

    landmark_ids: IntArray  # (N,)
    xyz_mu: FloatArray  # (N, 3)
    normal: FloatArray  # (N, 3)
    reference_mu: FloatArray
    """(N,): distance times patch scale where the landmark was described: the distance at which its patch has scale 1.
    """
    descriptors: NDArray[np.generic]  # (N, D)

    @classmethod
    def of_keyframes(cls, submap: Submap, keyframe_ids: IntArray | list[int]) -> LocalMap:
        """Take a snapshot of the landmarks that any of the keyframes sees."""
        return cls.of_landmarks(submap, submap.landmarks_of_keyframes(keyframe_ids))

    @classmethod
    def of_landmarks(cls, submap: Submap, landmark_ids: IntArray) -> LocalMap:
        """Take a snapshot of the given landmarks."""
        lm = submap.landmarks
        return cls(
            landmark_ids,
            lm["xyz_mu"].take(landmark_ids, axis=0),
            lm["normal"].take(landmark_ids, axis=0),
            lm["distance_mu"][landmark_ids] * lm["scale"][landmark_ids],
            lm["descriptor"].take(landmark_ids, axis=0),
        )

    def take(self, rows: NDArray[np.generic]) -> LocalMap:
        """Return the rows given by index or mask."""
        return LocalMap(
            self.landmark_ids[rows],
            self.xyz_mu[rows],
            self.normal[rows],
            self.reference_mu[rows],
            self.descriptors[rows],
        )

    def __len__(self) -> int:
        return len(self.landmark_ids)

    def predict(
        self, T_cam_submap: FloatArray, K: FloatArray, camera: Camera, scale_factor: float, n_octaves: int
    ) -> Prediction:
        """Project into a camera and keep what it can see: in front, in the image, from a like side and distance.

        - `T_cam_submap` (4, 4), `K` (3, 3).
        - `camera`: as it was given: what self-calibration corrects moves the rim of its image by little.
        - `scale_factor`, `n_octaves`: the front end's pyramid.
        """
        R, t = se3.rotation(T_cam_submap), se3.translation(T_cam_submap)
        uv, _ = project_points(K, T_cam_submap, self.xyz_mu)
        rows = np.flatnonzero(camera.shows(uv))  # NaN, behind the camera, is in no image
        to_camera = -R.T @ t - self.xyz_mu.take(rows, axis=0)
        distance = np.sqrt(np.einsum("ij,ij->i", to_camera, to_camera))
        cosine = np.einsum("ij,ij->i", to_camera, self.normal.take(rows, axis=0)) / np.maximum(distance, TINY)
        scale = self.reference_mu[rows] / np.maximum(distance, TINY)
        coarsest = scale_factor ** (n_octaves - 1)
        # One octave beyond the pyramid at either end.
        ok = (cosine > VIEW_COSINE_MIN) & (scale > 1 / scale_factor) & (scale < coarsest * scale_factor)
        octave = np.clip(np.rint(np.log(scale[ok]) / np.log(scale_factor)), 0, n_octaves - 1).astype(np.int64)
        return Prediction(rows[ok], uv.take(rows[ok], axis=0), octave)

    def search(
        self,
        frontend: Frontend,
        camera: Camera,
        T_cam_submap: FloatArray,
        K: FloatArray,
        features: Features,
        radius_px: float,
        max_distance: float | None = None,
    ) -> tuple[Prediction, Matches]:
        """Look for the landmarks in an image, so far at most from where they should be seen under a pose.

        - `radius_px`: at octave 0.

        Returns what should be seen, and matches: rows of that, and features.
        """
        seen = self.predict(T_cam_submap, K, camera, frontend.scale_factor, frontend.n_octaves)
        return seen, match_projected(
            frontend,
            FeatureGrid.build(features.uv_rect_px),
            features,
            seen.uv_px,
            radius_px * frontend.scale_factor**seen.octave,
            self.descriptors[seen.rows],
            octave=seen.octave,
            max_distance=max_distance,
        )


def trusted(submap: Submap, ids: IntArray, T_cam_submap: FloatArray, min_inliers: int) -> BoolArray:
    """Return which landmarks a pose is estimated from: not unproven ones right before the camera."""
    proven = np.asarray(submap.n_observations(ids) >= PROOF_VIEWS)
    if np.count_nonzero(proven) < max(SAFE * min_inliers, MAJORITY * len(ids)):
        return np.ones(len(ids), np.bool_)
    return ~nearer_than_proven(submap.depths(ids, T_cam_submap), proven)


def nearer_than_proven(depth: FloatArray, proven: BoolArray) -> BoolArray:
    """Return which points (N,) of depths (N,) are unproven, and nearer than any proof reaches; none where nothing is
    proven.

    On a scene that repeats itself wrong matches lie on the epipolar line, too, at any depth. Near ones weigh most: they
    hold the camera where it is, and a turn takes the place of its motion. Where true points are near, some are proven.
    """
    if not proven.any():
        return np.zeros(len(depth), np.bool_)
    return ~proven & stands_before(depth, depth[proven])


def stands_before(depth: FloatArray, others: FloatArray) -> BoolArray:
    """Return which points (N,) stand far before all but a few others (M,)."""
    return np.asarray(depth <= NEARER * quantile(others, NEAREST))


def look(
    frontend: Frontend,
    camera: Camera,
    submap: Submap,
    landmark_ids: IntArray,
    T_cam_submap: FloatArray,
    K: FloatArray,
    features: Features,
    radius_px: float,
) -> Sighting:
    """Look for landmarks of a submap in an image, about where they should be under a pose: see `Look`."""
    local = LocalMap.of_landmarks(submap, landmark_ids)
    seen, matches = local.search(frontend, camera, T_cam_submap, K, features, radius_px)
    feature = np.full(len(seen.rows), -1, np.int64)
    feature[matches.index[:, 0]] = matches.index[:, 1]
    part = np.clip(camera.unrectify(seen.uv_px) / camera.size_px * CELLS, 0, CELLS - 1).astype(np.int64)
    return Sighting(local.landmark_ids[seen.rows], feature, CELLS * part[:, 1] + part[:, 0])
