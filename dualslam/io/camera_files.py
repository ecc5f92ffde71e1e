"""Camera files: our own YAML or JSON, and those that other tools write.

Our own format is the dictionary of the camera's class as YAML or JSON::

    model: pinhole            # or radtan, kannala_brandt, fov, division: see dualslam.core.camera.models
    fx: 718.856
    fy: 718.856
    cx: 607.193
    cy: 185.216
    width: 1241
    height: 376

Pixel (0, 0) is the centre of the top-left pixel. Recognised besides: OpenCV FileStorage YAML (``camera_matrix``,
``distortion_coefficients``, ``image_width``), ROS ``camera_info`` YAML, ORB-SLAM settings (``Camera.fx``), the one line
of a ``calib.txt`` and the ``camera.txt`` of TUM-Mono.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import (
    MODELS,
    FovCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    RadTanCamera,
    camera_from_dict,
)
from dualslam.core.errors import InputError
from dualslam.io.trajectory_files import read_text

log = logging.getLogger(__name__)

CALIB_LINE = "fx fy cx cy [k1 k2 p1 p2 [k3]] width height"
_MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M1")
_DISTORTION_KEYS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "D1")
_FISHEYE = ("equidistant", "fisheye", "kannala", "kannalabrandt8")
_COMMON = (
    *("", "none", "pinhole", "perspective", "rectified", "opencv"),
    *("plumb_bob", "plumb bob", "radtan", "radial-tangential", "brown_conrady", "rational_polynomial"),
)
"""Names of cameras whose lens is k1 k2 p1 p2 [k3], or has none of it."""


def read_camera_file(path: str | Path) -> Camera:
    """Read a camera file of any kind that the module names.

    Raises
    ------
    InputError
        If the file is missing, of no known kind, or holds a calibration that makes no sense.
    """
    path = Path(path)
    text = read_text(path)
    if path.suffix.lower() == ".txt":
        lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
        lines = [line for line in lines if line]
        return read_calib_line(path) if len(lines) == 1 else read_tum_mono_camera(path)
    content = _parse(path, text)
    if any(str(key).startswith("Camera.") for key in content):
        return _from_orb_slam(content, str(path))
    if any(key in content for key in _MATRIX_KEYS):
        return _from_matrix(content, str(path))
    if "model" not in content:
        raise InputError(
            f"{path} does not say which camera it is: add `model: pinhole` (or {', '.join(list(MODELS)[1:])}) to "
            "fx, fy, cx, cy, width and height, or give a file that OpenCV, ROS or ORB-SLAM reads."
        )
    if content.get("model") in (PinholeCamera.model, RadTanCamera.model) and _is_negative(content.get("fy")):
        log.info("%s: fy is negative, so its y-axis points up; here it points down", path)
        content = {**content, "fy": -content["fy"]} | ({"p1": -content["p1"]} if content.get("p1") else {})
    return make_camera(str(path), lambda: camera_from_dict(content))


def _is_negative(value: object) -> bool:
    return isinstance(value, int | float) and value < 0


def make_camera(where: str, build: Callable[[], Camera]) -> Camera:
    """Build a camera, which checks itself; what is wrong with it is said with the name of the file."""
    try:
        return build()
    except InputError as e:
        raise InputError(f"{where}: {str(e).removeprefix('camera: ').rstrip('.')}; correct the calibration.") from e


P1 = 2
"""Its place among the coefficients k1 k2 p1 p2 k3: it is odd in y."""


def radtan_camera(fxycxy: list[float], distortion: list[float], size: tuple[float, float], where: str) -> Camera:
    """Make a pinhole camera, or a radial-tangential one where any of k1 k2 p1 p2 [k3] is not zero.

    A negative fy (ICL-NUIM's is -480) says that y points up in the calibration's camera frame. The image is the same;
    here y points down.
    """
    pixels = whole_size(size, where)
    if fxycxy[1] < 0:
        log.info("%s: fy is negative, so its y-axis points up; here it points down", where)
        fxycxy = [fxycxy[0], -fxycxy[1], *fxycxy[2:]]
        distortion = [-d if i == P1 else d for i, d in enumerate(distortion)]
    if any(d != 0 for d in distortion):
        return make_camera(where, lambda: RadTanCamera(*pixels, *fxycxy, *distortion))
    return make_camera(where, lambda: PinholeCamera(*pixels, *fxycxy))


def whole_size(size: tuple[float, float], where: str) -> tuple[int, int]:
    """Return an image size as whole numbers."""
    if not all(float(n).is_integer() and n >= 1 for n in size):
        raise InputError(f"{where}: the image size is {size[0]} x {size[1]}; it must be two whole numbers of pixels.")
    return int(size[0]), int(size[1])


def read_calib_line(path: Path) -> Camera:
    """Read the one line ``fx fy cx cy [k1 k2 p1 p2 [k3]] width height`` of a ``calib.txt``."""
    words = [word for line in read_text(path).splitlines() for word in line.split("#", 1)[0].split()]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{path} is not a line of numbers; write `{CALIB_LINE}`.") from None
    if len(numbers) not in (6, 10, 11):
        raise InputError(f"{path} has {len(numbers)} numbers; write `{CALIB_LINE}`.")
    check_numbers(numbers, str(path))
    *intrinsics, width, height = numbers
    return radtan_camera(intrinsics[:4], intrinsics[4:], (width, height), str(path))


def read_tum_mono_camera(path: Path) -> Camera:
    """Read a TUM-Mono or DSO ``camera.txt``: ``[Model] fx fy cx cy ...`` and ``width height`` on the next line.

    Without a model's name five numbers are the FOV model (its omega 0: a pinhole). Intrinsics with a principal point
    below 1 are relative to the image size.
    """
    lines = [line.split() for line in read_text(path).splitlines() if line.split("#", 1)[0].strip()]
    hint = "the first line should be `fx fy cx cy omega` (or `Pinhole`, `RadTan`, `KannalaBrandt`, `FOV` and numbers)"
    if len(lines) < 2:
        raise InputError(f"{path} has {len(lines)} lines; {hint}, the second `width height`.")
    model = "fov" if _is_number(lines[0][0]) else lines[0][0].lower()
    try:
        numbers = [float(word) for word in (lines[0] if _is_number(lines[0][0]) else lines[0][1:])]
        size = float(lines[1][0]), float(lines[1][1])
    except (ValueError, IndexError):
        raise InputError(f"{path} is no TUM-Mono camera file; {hint}, the second `width height`.") from None
    counts = {"fov": (5,), "pinhole": (4, 5), "radtan": (8,), "kannalabrandt": (8,), "equidistant": (8,)}
    if len(numbers) not in counts.get(model, ()):
        raise InputError(f"{path}: {model} with {len(numbers)} numbers is no known camera; {hint}.")
    check_numbers(numbers, str(path))
    width, height = whole_size(size, str(path))
    fx, fy, cx, cy = numbers[:4]
    if model == "fov":
        return make_camera(str(path), lambda: FovCamera.from_tum_mono(fx, fy, cx, cy, numbers[4], width, height))
    if cx < 1 and cy < 1:
        # Relative numbers count from the corner of the top-left pixel, ours from its centre.
        fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    distortion = [] if model == "pinhole" else numbers[4:]
    model = "fisheye" if model in ("kannalabrandt", "equidistant") else model
    return distorted_camera(model, [fx, fy, cx, cy], distortion, (width, height), str(path))


def check_numbers(numbers: list[float], where: str) -> None:
    """Refuse a calibration that holds NaN or infinity."""
    if not np.isfinite(numbers).all():
        raise InputError(f"{where} holds a number that is not finite; calibrate again or correct it.")


# --- YAML and JSON of others


class _FileStorageLoader(yaml.SafeLoader):
    """YAML as OpenCV writes it, with its own tag for matrices. A key that stands there twice is a slip."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        for position, key in enumerate(keys):
            if key in keys[:position]:
                problem = f"the key {key!r} stands there twice"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.value[position][0].start_mark)
        return super().construct_mapping(node, deep)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> Any:
    return loader.construct_mapping(node, deep=True)


_FileStorageLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def parse_yaml(path: Path, text: str) -> dict[str, Any]:
    """Parse YAML, OpenCV's dialect included (its ``%YAML:1.0`` is not a directive that YAML knows)."""
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    try:
        content = yaml.load("\n".join(lines), _FileStorageLoader)  # a SafeLoader
    except yaml.YAMLError as e:
        where, problem = getattr(e, "problem_mark", None), getattr(e, "problem", None)
        line = f", line {where.line + 1}" if where else ""
        raise InputError(f"{path}{line} is not valid YAML{f': {problem}' if problem else ''}; correct it.") from e
    if not isinstance(content, dict):
        raise InputError(f"{path} is not a camera file: it should hold fields such as fx, fy, cx, cy, width, height.")
    return content


def _parse(path: Path, text: str) -> dict[str, Any]:
    if path.suffix.lower() != ".json":
        return parse_yaml(path, text)

    def each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        for key, n in Counter(key for key, _ in pairs).items():
            if n > 1:
                raise InputError(f"{path}: the key {key!r} stands there twice; correct it.")
        return dict(pairs)

    try:
        content = json.loads(text, object_pairs_hook=each_once)
    except json.JSONDecodeError as e:
        raise InputError(f"{path}, line {e.lineno} is not valid JSON; correct it.") from e
    if not isinstance(content, dict):
        raise InputError(f"{path} is not a camera file: it should hold fields such as fx, fy, cx, cy, width, height.")
    return content


def _from_matrix(content: Mapping[str, Any], where: str) -> Camera:
    """Make a camera of OpenCV's or ROS's ``camera_matrix`` and ``distortion_coefficients``."""
    K = _numbers(content, next(k for k in _MATRIX_KEYS if k in content), where)
    if len(K) != 9:
        raise InputError(f"{where}: the camera matrix has {len(K)} numbers; it must be 3 x 3.")
    key = next((k for k in _DISTORTION_KEYS if k in content), None)
    distortion = [] if key is None else _numbers(content, key, where)
    size = _size(content, where)
    fxycxy = [K[0], K[4], K[2], K[5]]
    model = str(content.get("distortion_model", content.get("camera_model", ""))).lower()
    return distorted_camera(model, fxycxy, distortion, size, where)


def distorted_camera(
    model: str, fxycxy: list[float], distortion: list[float], size: tuple[float, float], where: str
) -> Camera:
    """Make the camera of a named distortion model with its coefficients as OpenCV and ROS order them."""
    check_model(model, (*_COMMON, *_FISHEYE), where)
    if model in _FISHEYE:
        pixels = whole_size(size, where)
        if len(distortion) != 4:
            raise InputError(f"{where}: {len(distortion)} distortion coefficients; a fisheye camera has 4.")
        return make_camera(where, lambda: KannalaBrandtCamera(*pixels, *fxycxy, *distortion))
    if len(distortion) not in (0, 4, 5) and any(d != 0 for d in distortion[5:]):
        raise InputError(f"{where}: {len(distortion)} distortion coefficients; k1 k2 p1 p2 [k3] are supported.")
    return radtan_camera(fxycxy, distortion[:5], size, where)


def check_model(model: str, known: tuple[str, ...], where: str) -> None:
    """Refuse a camera of another kind: its numbers would be taken for something else."""
    if model not in known:
        names = ", ".join(name for name in known if name)
        raise InputError(f"{where}: the camera model {model!r} is not one of those that are read: {names}.")


def _from_orb_slam(content: Mapping[str, Any], where: str) -> Camera:
    prefix = "Camera."
    fields = {str(k)[len(prefix) :]: v for k, v in content.items() if str(k).startswith(prefix)}
    fxycxy = [_number(fields, name, where) for name in ("fx", "fy", "cx", "cy")]
    size = _number(fields, "width", where), _number(fields, "height", where)
    model = str(fields.get("type", "")).lower()
    check_model(model, (*_COMMON, *_FISHEYE), where)
    if model in _FISHEYE:
        names = ("k1", "k2", "k3", "k4")
        return distorted_camera("fisheye", fxycxy, [_number(fields, n, where) for n in names], size, where)
    fields = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0) | fields
    distortion = [_number(fields, name, where) for name in ("k1", "k2", "p1", "p2", "k3")]
    return radtan_camera(fxycxy, distortion, size, where)


def _size(content: Mapping[str, Any], where: str) -> tuple[float, float]:
    for width, height in (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height")):
        if width in content and height in content:
            return _number(content, width, where), _number(content, height, where)
    raise InputError(f"{where} does not say the size of the images; add image_width and image_height.")


def _numbers(content: Mapping[str, Any], key: str, where: str) -> list[float]:
    value = content[key]
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.asarray(data, float).ravel().tolist()
    except (TypeError, ValueError):
        raise InputError(f"{where}: {key} is not a list of numbers.") from None
    check_numbers(numbers, f"{where}: {key}")
    return [float(n) for n in numbers]


def _number(fields: Mapping[str, Any], name: str, where: str) -> float:
    try:
        number = float(fields[name])
    except KeyError:
        raise InputError(f"{where} has no {name}; add it.") from None
    except (TypeError, ValueError):
        raise InputError(f"{where}: {name} is {fields[name]!r}, not a number.") from None
    check_numbers([number], f"{where}: {name}")
    return number


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
