"""Whether frames are of the camera that they are said to be of: a saved map tells, by where its points are seen."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from dualslam.atlas.stored_map import StoredMap
from dualslam.build import build_system
from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import CorrectedCamera
from dualslam.core.camera.mapped import MappedCamera, camera_for_map, own_camera
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.geometry.so3 import exp
from dualslam.core.interfaces import Sequence
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, Frame, Track
from dualslam.io.map_store import load_atlas, load_camera
from dualslam.io.reduced import resized_frames

log = logging.getLogger(__name__)

LOOKED_AT = 60
"""Frames, at most, that are looked for: two seconds."""
N_POSED = 12
"""Frames after which the answer is sure enough: each has some hundred points."""
TOLERANCE, N_SIGMAS = 0.01, 4.0
"""Of the log focal length: below the first, poses move by less than a hundredth of the depth, as a link's may. The
second keeps frames of a flat scene from counting."""
LOG_ZOOMS = tuple(round(0.1 * step, 1) for step in range(-7, 8))
"""Factors on the focal length, from a half to two. Near the true one, frames match most points of the map. Far from it
they match those that fit the wrong focal length, and these say that little is wrong."""
FAR_ZOOM = 0.3
"""Log factor beyond which frames of the map may not be found at all by the wrong focal length."""
N_TRIES = 6
"""Refinements of the best factor, to within its sigma: each takes a part of what is left."""
N_ITERATIONS = 20
HUBER = 2.0
"""Sigmas. The frames were matched by the wrong focal length, so that many residuals are larger."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame's observations of a submap: its pose, points, pixels from the principal point, over f; sigma, over f."""

    T_cam_submap: FloatArray
    xyz: FloatArray
    xy: FloatArray
    sigma: FloatArray


def camera_that_fits(config: Config, frames: Iterable[Frame], camera: Camera, saved_map: str | Path) -> Camera:
    """Return the camera by which frames fit a saved map: the given one, or one of another focal length.

    - `frames`: the first ones are looked for in the map, which is not changed.
    - `camera`: as it was given.
    - `saved_map`: of its run folder.

    Raises `InputError` if the frames fit the map with no focal length.
    """
    known = load_camera(saved_map)
    if known is None:
        return camera
    config, saved = config.with_section("recovery", workers=0), load_atlas(saved_map)
    as_given = log_focal_of(_frames_in_map(config, frames, camera, saved))
    if as_given is not None and _agrees(*as_given):
        return camera

    def seen_with(log_zoom: float) -> tuple[Camera, list[_Seen]]:
        try:
            tried = MappedCamera.of(zoomed(camera_for_map(known, camera), log_zoom), known.K)
        except InputError:  # the lens was calibrated for a narrower view
            return camera, []
        return tried, _frames_in_map(config, frames, tried, saved)

    zooms = [log_zoom for log_zoom in LOG_ZOOMS if as_given is not None or abs(log_zoom) >= FAR_ZOOM]
    tries = {log_zoom: seen_with(log_zoom) for log_zoom in zooms}
    zoom = max(zooms, key=lambda log_zoom: sum(len(s.xyz) for s in tries[log_zoom][1]))
    for _ in range(N_TRIES):
        tried, seen = tries[zoom] if zoom in tries else seen_with(zoom)
        found = log_focal_of(seen)
        if found is None or abs(found[0]) <= found[1]:
            break
        zoom += found[0]
    if found is not None and _agrees(*found):
        log.warning(
            "the frames fit the saved map with a focal length of %.0f px, not %.0f: it is taken for theirs",
            own_focal_px(tried),
            own_focal_px(camera),
        )
        return tried
    if as_given is None:
        log.info("the saved map is not seen in the first frames: nothing tells whether their camera is right")
        return camera
    raise InputError(
        "The frames do not fit the saved map with any focal length: their camera is another one than "
        "they are said to be of; give its calibration (--camera)."
    )


def _agrees(log_focal: float, sigma: float) -> bool:
    return abs(log_focal) <= max(TOLERANCE, N_SIGMAS * sigma)


def in_size_of_map(sequence: Sequence, saved_map: str | Path) -> Sequence:
    """Return a sequence with its images in the size of a saved map's, where they are of the same shape."""
    known = load_camera(saved_map)
    if known is None:
        return sequence
    (width, height), was = own_camera(known).size_px, sequence.camera.size_px
    if (width, height) == was or width * was[1] != height * was[0]:
        return sequence
    log.warning("%s: its images are resized to those of the map, %d x %d", sequence.name, width, height)
    return resized_frames(sequence, (width, height))


def own_focal_px(camera: Camera) -> float:
    """Return the focal length of a camera's own pixels."""
    return float(camera.base.K[0, 0] if isinstance(camera, MappedCamera) else camera.K[0, 0])


def zoomed(camera: Camera, log_zoom: float) -> Camera:
    """Return a camera with its focal length times e^`log_zoom`."""
    if isinstance(camera, MappedCamera):
        return zoomed(camera.base, log_zoom)
    if isinstance(camera, CorrectedCamera):
        correction = replace(camera.correction, log_focal=camera.correction.log_focal + log_zoom)
        return CorrectedCamera.over(camera.base, correction)
    factor = math.exp(log_zoom)
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def _frames_in_map(config: Config, frames: Iterable[Frame], camera: Camera, saved: StoredMap) -> list[_Seen]:
    """Pose the first frames in a saved map by its points; return what they saw of it."""
    system = build_system(config, camera, saved=saved, localise=True)
    tracks: list[Track] = []
    seen = []
    system.on_pose = tracks.append
    with closing(system.desk):
        for frame in islice(frames, LOOKED_AT):
            tracks.clear()
            result = system.step(frame)
            if not tracks or result.T_submap_cam is None or result.submap_id is None:
                continue
            submap, track = system.atlas.submaps[result.submap_id], tracks[-1]
            rows = np.flatnonzero(track.landmark_ids >= 0)
            features, K = track.view.features, submap.K
            focal = (K[0, 0], K[1, 1])
            seen.append(
                _Seen(
                    track.T_cam_submap,
                    submap.landmarks["xyz_mu"][track.landmark_ids[rows]],
                    (features.uv_rect_px[rows] - K[:2, 2]) / focal,
                    features.sigma_px[rows] / focal[0],
                )
            )
            if len(seen) == N_POSED:
                break
    return seen


def log_focal_of(seen: list[_Seen]) -> tuple[float, float] | None:
    """Return the logarithm of the factor on the focal length that explains frames best, and its sigma; None of none.

    Each frame's pose is free. Gauss-Newton with Huber weights; the poses are eliminated.
    """
    if not seen:
        return None
    poses = [s.T_cam_submap.copy() for s in seen]
    a, information = 0.0, 0.0
    for _ in range(N_ITERATIONS):
        information, gradient, parts = 0.0, 0.0, []
        for T, s in zip(poses, seen, strict=True):
            p = s.xyz @ T[:3, :3].T + T[:3, 3]
            front = p[:, 2] > 1e-6
            p, w = p[front], 1.0 / s.sigma[front]
            x = p[:, :2] / p[:, 2:]
            residual = (s.xy[front] - math.exp(a) * x) * w[:, None]
            weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(residual, axis=1), 1e-9)))
            J = np.zeros((len(p), 2, 7))
            along = np.zeros((len(p), 2, 3))
            along[:, 0, 0] = along[:, 1, 1] = 1.0 / p[:, 2]
            along[:, :, 2] = -x / p[:, 2:]
            turn = np.zeros((len(p), 3, 3))
            turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = p[:, 2], -p[:, 1], p[:, 0]
            turn -= turn.transpose(0, 2, 1).copy()
            J[:, :, :3], J[:, :, 3:6], J[:, :, 6] = along, along @ turn, x
            J *= (math.exp(a) * w * weight)[:, None, None]
            rows, r = J.reshape(-1, 7), (residual * weight[:, None]).ravel()
            H, g = rows.T @ rows + 1e-9 * np.eye(7), rows.T @ r
            solved = np.linalg.solve(H[:6, :6], np.column_stack([H[:6, 6], g[:6]]))
            information += H[6, 6] - H[6, :6] @ solved[:, 0]
            gradient += g[6] - H[6, :6] @ solved[:, 1]
            parts.append(solved)
        step = gradient / max(information, TINY)
        a += step
        for T, solved in zip(poses, parts, strict=True):
            d = solved[:, 1] - solved[:, 0] * step
            R = exp(d[3:])
            T[:3, :3], T[:3, 3] = R @ T[:3, :3], R @ T[:3, 3] + d[:3]
        if abs(step) < 1e-6:
            break
    return a, 1.0 / math.sqrt(max(information, TINY))
