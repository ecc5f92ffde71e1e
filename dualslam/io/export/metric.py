"""Metres per unit of a map: from a known distance, the camera's height over the ground, or a marker of known size."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, Frame
from dualslam.io.atomic import write_text
from dualslam.io.export.exported_map import ExportedMap
from dualslam.io.export.images import undistorted
from dualslam.io.run_folder import MAP

MAX_TILT_DEG = 15.0
"""Of the ground against the image's rows: a camera that is mounted level, on a road that may slope."""
GROUND_REACH = 12.0
"""Ground is looked for up to so many heights ahead: depths further off tell heights by a fifth of a pixel."""
MIN_GROUND_POINTS = 12
N_PLANES = 300
"""Planes through three points that are tried in a keyframe."""
THICKNESS = 0.03
"""Half of how thick ground may be, of the camera's height over it."""
MIN_KEYFRAMES = 5
"""Keyframes over ground that a height needs: a roof or a hedge may stand for it in one."""
MAD_SIGMAS = 1.4826
"""Of a normal distribution, over its median absolute deviation."""
MIN_MARKER_VIEWS = 3
DICTIONARIES = {
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "aruco_4x4": cv2.aruco.DICT_4X4_250,
    "aruco_5x5": cv2.aruco.DICT_5X5_250,
    "aruco_6x6": cv2.aruco.DICT_6X6_250,
    "aruco_original": cv2.aruco.DICT_ARUCO_ORIGINAL,
}
SCALE = "scale.json"


@dataclass(frozen=True, slots=True)
class MetricScale:
    """How long a unit of a map is."""

    metres_per_unit: float
    sigma_rel: float | None  # of it, relative, by how its measurements differ; None where there is one
    words: str  # what it is from


def by_distance(exported: ExportedMap, numbers: Mapping[int, int], a: int, b: int, metres: float) -> MetricScale:
    """Return the scale by the true distance between two views, named by their indices in the source.

    `numbers`: of the run's frames, as `read_numbers` gives them.

    Raises `InputError` if one of them is no frame of the run, or no view, or they do not lie apart.
    """
    row_of = exported.rows_by_index(numbers)
    continued = bool(set(exported.frame.tolist()) - set(numbers.values()))
    for index in (a, b):
        if index not in numbers:
            those = "; those of the saved map cannot be named here" if continued else ""
            raise InputError(
                f"--distance: frame {index} is none of the run's, which are {min(numbers)} to {max(numbers)}{those}."
            )
        if not row_of:
            raise InputError("--distance: no frame of this run has a pose in the main map.")
        if index not in row_of:
            nearest = min(row_of, key=lambda i: abs(i - index))
            raise InputError(
                f"--distance: frame {index} has no pose in the main map; the nearest that has one is {nearest}."
            )
    p, q = (exported.T_world_cam[row_of[i], :3, 3] for i in (a, b))
    length = float(np.linalg.norm(p - q))
    if not length > 0 or not metres > 0:
        raise InputError("--distance: give two frames that lie apart, and a distance above 0.")
    return MetricScale(metres / length, None, f"{metres:g} m between frames {a} and {b}")


def by_height(exported: ExportedMap, metres: float) -> MetricScale:
    """Return the scale by the camera's height over flat ground, the median over the keyframes that see some.

    In each keyframe a plane is sought among the points that it sees below itself, by RANSAC, level to within
    `MAX_TILT_DEG` of the image's rows: the lowest that enough points lie on, as nothing is seen below the ground.

    Raises `InputError` if hardly any keyframe sees ground.
    """
    T_cam_world = se3.inverse(exported.T_world_cam)
    heights = []
    rng = np.random.default_rng(0)
    # A keyframe alone has few points on the road: what its neighbours see of it lies on the same plane.
    for v in range(len(exported.frame)):
        near = (exported.view >= v - 3) & (exported.view <= v + 3)
        ids = np.unique(exported.point[near])
        p = exported.xyz[ids] @ T_cam_world[v, :3, :3].T + T_cam_world[v, :3, 3]
        height = _height_over_ground(p[(p[:, 1] > 0) & (p[:, 2] > 0)], rng)
        if height is not None:
            heights.append(height)
    if len(heights) < MIN_KEYFRAMES:
        raise InputError(
            f"--height: {len(heights)} keyframes see level ground below the camera, {MIN_KEYFRAMES} are needed; "
            "give --distance or --marker."
        )
    found = np.array(heights)
    height = float(np.median(found))
    sigma = MAD_SIGMAS * float(np.median(np.abs(found - height))) / np.sqrt(len(found))
    words = f"the camera {metres:g} m over the ground, in {len(found)} of {len(exported.frame)} keyframes"
    return MetricScale(metres / height, sigma / height, words)


def _height_over_ground(p: FloatArray, rng: np.random.Generator) -> float | None:
    """Return how far below the camera the plane lies on which most points (N, 3) of the camera's frame do."""
    if len(p) < MIN_GROUND_POINTS:
        return None
    triples = p[rng.integers(0, len(p), (N_PLANES, 3))]
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 0] / length[length > 0, None]
    normal *= np.sign(normal[:, 1])[:, None]
    height = np.einsum("ni,ni->n", normal, triples[length > 0, 0])
    level = (normal[:, 1] > np.cos(np.radians(MAX_TILT_DEG))) & (height > 0)
    if not level.any():
        return None
    normal, height = normal[level], height[level]
    below = normal @ p.T  # (planes, points)
    reached = np.linalg.norm(p, axis=1)[None] < GROUND_REACH * height[:, None]
    on = (np.abs(below - height[:, None]) < THICKNESS * height[:, None]) & reached
    under = (below > (1 + 2 * THICKNESS) * height[:, None]) & reached
    # What lies under a plane speaks against it: there is nothing under the ground.
    votes = on.sum(axis=1) - 2 * under.sum(axis=1)
    best = int(votes.argmax())
    if votes[best] < MIN_GROUND_POINTS:
        return None
    middle = p[on[best]].mean(axis=0)  # of the plane of least squares
    return abs(float(np.linalg.svd(p[on[best]] - middle)[2][2] @ middle))


def by_marker(
    exported: ExportedMap,
    camera: Camera,
    frames: Iterable[Frame],
    numbers: Mapping[int, int],
    metres: float,
    dictionary: str,
) -> MetricScale:
    """Return the scale by markers of a known size, each triangulated from the keyframes that show it.

    - `camera`: as in the saved map: it knows the lens.
    - `frames`: of the source that the run was made of; those that are no keyframes are passed over.
    - `numbers`: of the run's frames, as `read_numbers` gives them.
    - `metres`: side of the black square. Different markers of one number would be taken for one.
    - `dictionary`: one of `DICTIONARIES`.

    Raises `InputError` if no marker is seen by enough keyframes.
    """
    corners = _marker_corners(exported, camera, frames, numbers, dictionary)
    sides, sigmas, n_views = [], [], 0
    for seen in corners.values():
        if len(seen) < MIN_MARKER_VIEWS:
            continue
        xyz = np.array([_triangulate(exported, [(v, uv[i]) for v, uv in seen]) for i in range(4)])
        around = np.linalg.norm(xyz - np.roll(xyz, 1, axis=0), axis=1)
        sides.append(float(around.mean()))
        sigmas.append(float(around.std(ddof=1) / 2))
        n_views += len(seen)
    if not sides:
        most = max(map(len, corners.values()), default=0)
        raise InputError(
            f"--marker: no marker of {dictionary} is seen by {MIN_MARKER_VIEWS} keyframes ({most} at most); "
            "name another --dictionary, or give --distance or --height."
        )
    side = float(np.median(sides))
    sigma_rel = float(np.median(sigmas)) / side / np.sqrt(len(sides))
    words = f"{len(sides)} markers of {metres:g} m in {n_views} views"
    return MetricScale(metres / side, sigma_rel, words)


def _marker_corners(
    exported: ExportedMap, camera: Camera, frames: Iterable[Frame], numbers: Mapping[int, int], dictionary: str
) -> dict[int, list[tuple[int, FloatArray]]]:
    """Return for each marker the views that show it, with its corners there (4, 2) in rectified pixels."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]), parameters)
    found: dict[int, list[tuple[int, FloatArray]]] = {}
    for v, image, _ in undistorted(exported, camera, frames, numbers):
        corners, ids, _ = detector.detectMarkers(image)
        for marker, uv in zip([] if ids is None else ids.ravel().tolist(), corners, strict=True):
            found.setdefault(marker, []).append((v, np.asarray(uv, float).reshape(4, 2)))
    return found


def _triangulate(exported: ExportedMap, seen: list[tuple[int, FloatArray]]) -> FloatArray:
    """Return the point (3,) nearest to the rays of all views."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for v, uv in seen:
        T = exported.T_world_cam[v]
        ray = T[:3, :3] @ np.linalg.inv(exported.K[int(exported.camera[v])]) @ np.array([*uv, 1.0])
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        A += across
        b += across @ T[:3, 3]
    return np.asarray(np.linalg.solve(A, b), np.float64)


def write_scale(run: Path, metres_per_unit: float, sigma_rel: float | None, words: str) -> None:
    """Keep the scale of a run's map.

    - `run`: run folder with a map.
    - `sigma_rel`: of it, relative.
    - `words`: what it is from.
    """
    content = {"metres_per_unit": metres_per_unit, "sigma_rel": sigma_rel, "from": words}
    write_text(run / MAP / SCALE, json.dumps(content, indent=1) + "\n")


def read_scale(run: Path) -> float | None:
    """Return the metres per unit of a run's map, or None if unknown.

    Raises `InputError` if the file is damaged.
    """
    path = run / MAP / SCALE
    if not path.is_file():
        return None
    try:
        metres = float(json.loads(path.read_text())["metres_per_unit"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged; run dualslam scale again.") from error
    if not metres > 0:
        raise InputError(f"{path} says that a unit is {metres:g} m long; run dualslam scale again.")
    return metres
