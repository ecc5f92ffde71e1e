"""Synthetic submaps with known truth: a camera travels past random points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.types import Features, FloatArray, IntArray, Keyframe
from dualslam.map.submap import Submap

K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 190.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 1200, 380
OCTAVE_SIGMAS = 1.2 ** np.arange(8)


def look_along(forward: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the pose of a level camera (y down) at `centre` that looks along `forward`."""
    z = forward / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = centre
    return T


@dataclass
class GraphScene:
    """A corridor of points, cameras along a winding path through it.

    Attributes
    ----------
    T_true : (K, 4, 4) camera to submap, xyz_true : (P, 3)
    seen : list of (n,) int64
        For each keyframe the points that it sees; feature i of keyframe k is point ``seen[k][i]``.
    features : list of Features
    """

    T_true: FloatArray
    xyz_true: FloatArray
    seen: list[IntArray]
    features: list[Features]

    def keyframe(self, k: int) -> Keyframe:
        """Return keyframe `k` with its features."""
        return Keyframe(k, 0.1 * k, self.features[k])


def make_scene(
    n_keyframes: int, per_view: int = 250, noise_px: float = 1.0, seed: int = 0, step: float = 0.12
) -> GraphScene:
    """Make a path of `n_keyframes`, each seeing about `per_view` points at depths around 1."""
    rng = np.random.default_rng(seed)
    s = step * np.arange(n_keyframes)
    centre = np.column_stack([1.5 * np.sin(0.15 * s), 0.05 * np.sin(0.7 * s), s])
    forward = np.column_stack([0.225 * np.cos(0.15 * s), np.zeros_like(s), np.ones_like(s)])
    T = np.array([look_along(f, c) for f, c in zip(forward, centre, strict=True)])
    length = s[-1] + 4.0
    n_points = int(per_view * 1.1 * length / 1.3)
    along = rng.uniform(0.2, length, n_points)
    side = rng.choice([-1.0, 1.0], n_points) * rng.uniform(0.35, 1.1, n_points)
    xyz = np.column_stack([1.5 * np.sin(0.15 * along) + side, rng.uniform(-0.3, 0.25, n_points), along])
    seen, features = [], []
    for pose in T:
        cam = (xyz - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = cam[:, :2] / cam[:, 2:] * 700.0 + K[:2, 2]
        ok = (cam[:, 2] > 0.25) & (cam[:, 2] < 2.2)
        ok &= (uv[:, 0] > 0) & (uv[:, 0] < WIDTH) & (uv[:, 1] > 0) & (uv[:, 1] < HEIGHT)
        ids: IntArray = np.flatnonzero(ok)
        ids = np.sort(ids[rng.permutation(len(ids))[:per_view]]) if len(ids) > per_view else ids
        octave = rng.integers(0, 4, len(ids))
        sigma = np.asarray(OCTAVE_SIGMAS[octave], np.float64)
        noisy = uv[ids] + noise_px * sigma[:, None] * rng.normal(size=(len(ids), 2))
        seen.append(ids)
        features.append(make_features(noisy, sigma, octave))
    return GraphScene(T, xyz, seen, features)


def make_features(uv: FloatArray, sigma: FloatArray, octave: IntArray | None = None) -> Features:
    """Return features at pixels (N, 2) with their noise (sigma, px); their descriptors are all zero."""
    n = len(uv)
    octave = np.zeros(n, np.int64) if octave is None else octave
    return Features(uv, uv, sigma, sigma, octave, np.zeros(n), np.zeros((n, 4), np.uint8))


class Feeder:
    """Plays a tracker: puts a scene's keyframes into a submap one by one, from noisy guesses.

    A point becomes a landmark when the second keyframe sees it, in its true place but for `point_noise` of its depth.
    """

    def __init__(self, scene: GraphScene, seed: int = 1, pose_noise: float = 0.001, point_noise: float = 0.01) -> None:
        self.scene = scene
        self.rng = np.random.default_rng(seed)
        self.pose_noise, self.point_noise = pose_noise, point_noise
        self.submap = Submap(0, K, np.zeros(4, np.uint8))
        self.landmark_of_point = np.full(len(scene.xyz_true), -1)
        self.first_view: dict[int, tuple[int, int]] = {}

    def point_of_landmark(self) -> IntArray:
        """Return the scene's point of each landmark (L,), -1 where it has none."""
        points = np.full(len(self.submap.landmarks), -1)
        has = np.flatnonzero(self.landmark_of_point >= 0)
        points[self.landmark_of_point[has]] = has
        return points

    def add(self, k: int, exact: bool = False) -> None:
        """Put keyframe `k` into the submap, with its landmarks; `exact`: at its true pose."""
        scene, submap = self.scene, self.submap
        # Where the drift of the neighbouring keyframe puts this one, as a tracker would find it.
        near = min(submap.keyframes, key=lambda other: abs(other - k), default=None)
        drift = np.eye(4) if near is None else submap.T_submap_kf[near] @ np.linalg.inv(scene.T_true[near])
        T = drift @ scene.T_true[k]
        if not exact:
            T[:3, 3] += self.pose_noise * self.rng.normal(size=3)
        submap.add_keyframe(scene.keyframe(k), T)
        points = scene.seen[k]
        known = self.landmark_of_point[points]
        old = known >= 0
        submap.add_observations(k, np.flatnonzero(old), known[old])
        new_feature, new_point, first = [], [], []
        for f in np.flatnonzero(~old).tolist():
            p = int(points[f])
            if p in self.first_view and self.first_view[p][0] in submap.keyframes:
                new_feature.append(f)
                new_point.append(p)
                first.append(self.first_view[p])
            else:
                self.first_view[p] = (k, f)
        if not new_point:
            return
        n = len(new_point)
        xyz = scene.xyz_true[new_point] @ drift[:3, :3].T + drift[:3, 3]
        # Triangulation errs along the ray.
        xyz += self.point_noise * self.rng.normal(size=(n, 1)) * (xyz - T[:3, 3])
        ids = submap.add_landmarks(xyz, np.zeros((n, 4), np.uint8), np.ones(n), k)
        self.landmark_of_point[new_point] = ids
        kfs, feats = np.array(first).T
        submap.add_observations(kfs, feats, ids)
        submap.add_observations(k, np.array(new_feature), ids)


def guessed_submap(scene: GraphScene, pose_noise: float = 0.01, point_noise: float = 0.02, seed: int = 1) -> Submap:
    """Return a submap of all the scene's keyframes and points, off their true places.

    The first and the last keyframe are its gauge, and true: what a graph makes of it is in the truth's frame and unit.

    Parameters
    ----------
    scene : GraphScene
    pose_noise : float
        Standard deviation of each coordinate of the camera's centre.
    point_noise : float
        Of a point's distance, relative to it.
    seed : int
    """
    feeder, rng = Feeder(scene, seed, point_noise=point_noise), np.random.default_rng(seed)
    n = len(scene.features)
    for k in range(n):
        feeder.add(k, exact=True)
    for k in range(1, n - 1):
        feeder.submap.T_submap_kf[k][:3, 3] += pose_noise * rng.normal(size=3)
    feeder.submap.gauge = (0, n - 1)
    return feeder.submap


def pose_errors(T_est: FloatArray, T_true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return translation norms and angles (rad) of ``inv(T_est) @ T_true``."""
    off = np.linalg.inv(T_est) @ T_true
    cosine = np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)
    return np.linalg.norm(off[:, :3, 3], axis=1), np.arccos(cosine)
