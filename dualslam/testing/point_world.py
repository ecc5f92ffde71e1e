"""Points with descriptors of their own before a moving camera: what a front end would find, with nothing to render."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dualslam.build import build_system
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3, so3
from dualslam.core.schedule import Policy
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Frame, View
from dualslam.system.system import System

CAMERA = PinholeCamera(640, 480, 450.0, 450.0, 319.5, 239.5)
SIZE_PX = (CAMERA.width, CAMERA.height)
RATE_HZ = 20.0
GIVEN_UP_S = 0.375
"""With the ninth frame without a pose a map is given up, by default."""
SCALE_FACTOR = 1.2
UNIT_DISTANCE_M = 12.0
"""A patch at this distance is seen at the finest octave, a nearer one at a coarser."""


@dataclass(frozen=True)
class PointWorld:
    """Truth, and the features that each frame has of it.

    Attributes
    ----------
    xyz : (P, 3), T_world_cam : (F, 4, 4)
    noise_px : float
        At the finest octave.
    covered : set of int
        Frames in which only random corners with random descriptors are found.
    unreadable : set of int
    """

    xyz: FloatArray
    T_world_cam: FloatArray
    noise_px: float = 0.4
    seed: int = 0
    covered: frozenset[int] = frozenset()
    unreadable: frozenset[int] = frozenset()
    descriptors: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        words = np.random.default_rng([self.seed, 1]).integers(0, 256, (len(self.xyz), 32), np.uint8)
        object.__setattr__(self, "descriptors", words)

    def features(self, i: int) -> Features:
        """Return what a front end finds in frame `i`: the same whenever it is asked."""
        rng = np.random.default_rng([self.seed, 2, i])
        if i in self.covered:
            return random_features(rng)
        T = self.T_world_cam[i]
        p = (self.xyz - T[:3, 3]) @ T[:3, :3]
        seen = p[:, 2] > 0.5
        uv = np.full((len(p), 2), np.nan)
        uv[seen] = CAMERA.project(p[seen])
        octave = np.rint(np.log(UNIT_DISTANCE_M / np.linalg.norm(p, axis=1)) / np.log(SCALE_FACTOR))
        octave = np.clip(octave, 0, 7).astype(np.int64)
        sigma = self.noise_px * SCALE_FACTOR**octave
        uv += sigma[:, None] * rng.normal(size=uv.shape)
        seen &= (uv > 0).all(1) & (uv < SIZE_PX).all(1)
        flips = np.packbits(rng.random((int(seen.sum()), 256)) < 0.05, axis=1)
        return make_features(uv[seen], sigma[seen], octave[seen], self.descriptors[seen] ^ flips)

    def view(self, i: int) -> View:
        """Return frame `i` with its features."""
        return View(i, i / RATE_HZ, self.features(i))

    def views(self) -> list[View]:
        """Return all frames with their features."""
        return [self.view(i) for i in range(len(self.T_world_cam))]

    def frames(self) -> list[Frame]:
        """Return all frames without images, for a system of `system_in`."""
        return [Frame(i, i / RATE_HZ, None) for i in range(len(self.T_world_cam))]


def make_features(uv: FloatArray, sigma: FloatArray, octave: np.ndarray, descriptors: np.ndarray) -> Features:
    """Return features of an undistorted image at pixels (N, 2), with their noise (sigma, px) and octave (N,)."""
    return Features(uv, uv, sigma, SCALE_FACTOR ** octave.astype(float), octave, np.zeros(len(uv)), descriptors)


def random_features(rng: np.random.Generator, n: int = 300) -> Features:
    """Return features that belong to nothing: random places, random descriptors."""
    uv = rng.uniform([0, 0], SIZE_PX, (n, 2))
    words = rng.integers(0, 256, (n, 32), np.uint8)
    return make_features(uv, np.full(n, 0.5), np.zeros(n, np.int64), words)


def cloud(n: int = 900, seed: int = 0, length_m: float = 0.0) -> FloatArray:
    """Points all around a way of `length_m` to the right."""
    rng = np.random.default_rng([seed, 3])
    return rng.uniform([-8, -5, 3], [8 + length_m, 5, 12], (int(n * (1 + length_m / 16)), 3))


def path(n: int, step_m: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Steady motion: so much a frame, in world axes."""
    i = np.arange(n)[:, None]
    return se3.from_parts(so3.exp(i * np.asarray(turn_rad, float)), i * np.asarray(step_m, float))


def hand_held(n: int, speed: float = 1.0) -> FloatArray:
    """A camera that sways to all sides and looks about."""
    s = 0.04 * speed * np.arange(n)
    R = so3.exp(np.column_stack([0.1 * np.sin(3 * s), 0.3 * np.sin(2 * s), 0.1 * np.sin(2.5 * s)]))
    return se3.from_parts(R, np.column_stack([1.2 * np.sin(2.5 * s), 0.4 * np.sin(3.5 * s), 0.6 * np.sin(1.5 * s)]))


def system_in(world: PointWorld, schedule: Policy | None = None, **settings: object) -> System:
    """Build the real system, with the world's features instead of those of an image; no other ones are to be had.

    `schedule`: when answers of background work are used; all of it is done in this process then.
    The pace's clock stands still: how busy the machine is does not count.
    """
    recovery: Any = settings.get("recovery", {"enabled": False})
    fixed = {"camera": {"model_sigma_px": 0.0}, "calibration": {"refine": False}}
    fixed["tracking"] = {"max_lost_s": GIVEN_UP_S}
    config = Config.model_validate(fixed | settings | {"recovery": {"attempts": ["live"]} | recovery})
    system = build_system(config, CAMERA, schedule=schedule, in_process=schedule is not None)

    def view_of(frame: Frame) -> View | Failure:
        if frame.index in world.unreadable:
            return Failure(FailureReason.UNREADABLE, "torn")
        return world.view(frame.index)

    system._state.parts = replace(system._state.parts, view_of=view_of)
    system.pace.clock = lambda: 0.0
    return system


def pose_errors(T_est: FloatArray, T_true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Translations (N,) and angles (N,) of ``inv(T_est) @ T_true``, both relative to their first pose.

    The estimate's unit is chosen so that the distances from the first camera agree on the whole.
    """
    est, true = se3.inverse(T_est[0]) @ T_est, se3.inverse(T_true[0]) @ T_true
    scale = np.linalg.norm(true[:, :3, 3]) / np.linalg.norm(est[:, :3, 3])
    error = se3.inverse(se3.from_parts(est[:, :3, :3], scale * est[:, :3, 3])) @ true
    return np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(so3.log(error[:, :3, :3]), axis=1)
