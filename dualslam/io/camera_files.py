"""Camera files: our own YAML or JSON, and those that other tools write.

Our own format is the dictionary of the camera's class as YAML or JSON::

    model: pinhole            # or radtan, kannala_brandt, fov, division, omni, eucm, double_sphere
    fx: 718.856
    fy: 718.856
    cx: 607.193
    cy: 185.216
    width: 1241
    height: 376

Pixel (0, 0) is the centre of the top-left pixel. The formats of other tools are listed in docs/calibration.md: files of
keys are read by `dualslam.io.camera_keys`, lines of numbers and COLMAP's cameras here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import CorrectedCamera, LensCorrection
from dualslam.core.camera.models import MODELS, FovCamera, PinholeCamera, RadTanCamera, camera_from_dict
from dualslam.core.errors import InputError
from dualslam.io.camera_build import (
    ANY,
    COEFFICIENTS,
    CORNER_PX,
    Size,
    build_camera,
    check_numbers,
    lens_of,
    make_camera,
    whole_size,
    with_y_down,
)
from dualslam.io.camera_dialects import in_common_keys
from dualslam.io.camera_keys import camera_of_mapping
from dualslam.io.camera_text import read_mappings
from dualslam.io.trajectory_files import read_text

CALIB_LINE = "fx fy cx cy [k1 k2 p1 p2 [k3]] [width height]"
COLMAP_MODELS = (
    ("SIMPLE_PINHOLE", "f cx cy"),
    ("PINHOLE", "fx fy cx cy"),
    ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    ("FOV", "fx fy cx cy omega"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    ("SIMPLE_DIVISION", "f cx cy k"),
    ("DIVISION", "fx fy cx cy k"),
    ("SIMPLE_FISHEYE", "f cx cy"),
    ("FISHEYE", "fx fy cx cy"),
    ("EUCM", "fx fy cx cy alpha beta"),
    ("EQUIRECTANGULAR", "w h"),
)
"""By their numbers in ``cameras.bin``."""
COLMAP_NAMES = dict(COLMAP_MODELS)
MAX_COLMAP_BYTES = 2**20


def read_camera_file(path: str | Path, images_px: Callable[[], Size] | None = None) -> Camera:
    """Read a camera file of any kind that docs/calibration.md lists.

    `images_px`: gives the size of the images, for files that do not say it, as some of ORB-SLAM.

    Raises `InputError` if the file is missing, of no known kind, says what is not read, or holds a calibration that
    makes no sense.
    """
    path = Path(path)
    if path.suffix.lower() == ".bin":
        return _one_of(path, _colmap_binary(path))
    text = read_text(path)
    lines = [words for line in text.splitlines() if (words := line.split("#", 1)[0].replace(",", " ").split())]
    if lines and all(len(words) > 3 and words[1] in COLMAP_NAMES for words in lines):
        return _one_of(path, [_of_colmap(words, f"{path}, camera {words[0]}") for words in lines])
    if _are_numbers(lines) or (path.suffix.lower() == ".txt" and ":" not in text and "[image]" not in text):
        if len(lines) in (3, 4) and all(len(line) == len(lines) for line in lines):
            return camera_of_mapping({"camera_matrix": [w for line in lines for w in line]}, str(path), images_px)
        return _of_line(path, lines[0], images_px) if len(lines) == 1 else read_tum_mono_camera(path)
    return _one_of(path, [_of_mapping(content, str(path), images_px) for content in read_mappings(path, text)])


def _one_of(path: Path, cameras: list[Camera]) -> Camera:
    different = list(dict.fromkeys(cameras))
    if len(different) != 1:
        raise InputError(f"{path} describes {len(different)} cameras; keep the one that took these images.")
    return different[0]


def _of_mapping(content: dict[str, Any], where: str, images_px: Callable[[], Size] | None) -> Camera:
    content = in_common_keys(content, where)
    if content.get("model") in COLMAP_NAMES and "params" in content:
        words = [content.get("camera_id", 1), content["model"], content.get("width"), content.get("height")]
        return _of_colmap([str(word) for word in (*words, *content["params"])], where)
    if content.get("model") not in (*MODELS, "corrected") or "fl_x" in content:
        return camera_of_mapping(content, where, images_px)
    if content["model"] in (PinholeCamera.model, RadTanCamera.model):
        content = with_y_down(content, where)
    camera = make_camera(where, lambda: camera_from_dict(content))
    # What one run has found is what another is given: that may correct it once more, and not take this correction off.
    return CorrectedCamera.over(camera, LensCorrection()) if isinstance(camera, CorrectedCamera) else camera


# --- COLMAP


def _of_colmap(words: list[str], where: str) -> Camera:
    """Return the camera of ``ID MODEL WIDTH HEIGHT PARAMS``; COLMAP counts pixels from the corner of the first."""
    model = words[1]
    lens = lens_of(model, where)
    try:
        width, height, *params = (float(word) for word in words[2:])
    except ValueError:
        raise InputError(f"{where}: {' '.join(words)[:60]!r} is not `ID MODEL WIDTH HEIGHT PARAMS`.") from None
    names = COLMAP_NAMES[model].split()
    if len(params) != len(names):
        raise InputError(f"{where}: {len(params)} parameters, but {model} has {len(names)} ({' '.join(names)}).")
    check_numbers(params, where)
    numbers = dict(zip(names, params, strict=True)) | {"width": width, "height": height}
    if "f" in numbers:
        numbers["fx"] = numbers["fy"] = numbers.pop("f")
    return build_camera(lens, numbers | {"cx": numbers["cx"] - CORNER_PX, "cy": numbers["cy"] - CORNER_PX}, where)


def _colmap_binary(path: Path) -> list[Camera]:
    """Read ``cameras.bin``: a count, then id, model, width, height and parameters of each."""
    try:
        data = path.read_bytes()[:MAX_COLMAP_BYTES]
    except OSError as e:
        raise InputError(f"{path} cannot be read: {e.strerror or e}.") from e
    cameras, at = [], 8
    try:
        (n,) = struct.unpack_from("<Q", data)
        for _ in range(n):
            number, model, width, height = struct.unpack_from("<iiQQ", data, at)
            name, parameters = COLMAP_MODELS[model]
            params = struct.unpack_from(f"<{len(parameters.split())}d", data, at + 24)
            at += 24 + 8 * len(params)
            words = [str(word) for word in (number, name, width, height, *params)]
            cameras.append(_of_colmap(words, f"{path}, camera {number}"))
    except (struct.error, IndexError):
        raise InputError(
            f"{path} is no cameras.bin of COLMAP, or its end is missing; export the model again."
        ) from None
    return cameras


# --- lines of numbers


def listed_camera(
    fxycxy: list[float],
    distortion: list[float],
    size: tuple[float, float],
    where: str,
    lens: str = RadTanCamera.model,
) -> Camera:
    """Make the camera of a lens and its coefficients in their common order; a pinhole if all of them are zero."""
    width, height = whole_size(size, where)
    numbers = dict(zip(("fx", "fy", "cx", "cy"), fxycxy, strict=True)) | {"width": width, "height": height}
    return build_camera(lens, numbers | dict(zip(COEFFICIENTS.get(lens, ()), distortion, strict=False)), where)


def _of_line(path: Path, words: list[str], images_px: Callable[[], Size] | None) -> Camera:
    """Read a line of ``fx fy cx cy [k1 k2 p1 p2 [k3]]``, with the size of the images or without."""
    numbers = [number for word in words if (number := _float(word)) is not None]
    if len(numbers) < len(words):
        raise InputError(f"{path} is not a line of numbers; write `{CALIB_LINE}`.")
    if len(numbers) not in (4, 6, 8, 9, 10, 11):
        raise InputError(f"{path} has {len(numbers)} numbers; write `{CALIB_LINE}`.")
    check_numbers(numbers, str(path))
    if len(numbers) in (4, 8, 9):
        content = {"model": "radtan", "camera_matrix": numbers[:4], "distortion_coefficients": numbers[4:]}
        return camera_of_mapping(content, str(path), images_px)
    *intrinsics, width, height = numbers
    return listed_camera(intrinsics[:4], intrinsics[4:], (width, height), str(path))


_DSO_COUNTS = {"fov": (5,), "pinhole": (4, 5), "radtan": (8,), "kannalabrandt": (8,), "equidistant": (8,)}


def read_tum_mono_camera(path: Path) -> Camera:
    """Read a TUM-Mono or DSO ``camera.txt``: ``[Model] fx fy cx cy ...`` and ``width height`` on the next line.

    Without a model's name five numbers are the FOV model (its omega 0: a pinhole), eight OpenCV's. Intrinsics with a
    principal point below 1 are relative to the image size.
    """
    lines = [line.split() for line in read_text(path).splitlines() if line.split("#", 1)[0].strip()]
    hint = "the first line should be `fx fy cx cy omega` (or `Pinhole`, `RadTan`, `KannalaBrandt`, `FOV` and numbers)"
    if len(lines) < 2:
        raise InputError(f"{path} has {len(lines)} lines; {hint}, the second `width height`.")
    named = _float(lines[0][0]) is None
    model = lines[0][0].lower() if named else "radtan" if len(lines[0]) == 8 else "fov"
    try:
        numbers = [float(word) for word in lines[0][named:]]
        size = float(lines[1][0]), float(lines[1][1])
    except (ValueError, IndexError):
        raise InputError(f"{path} is no TUM-Mono camera file; {hint}, the second `width height`.") from None
    if len(numbers) not in _DSO_COUNTS.get(model, ()):
        raise InputError(f"{path}: {model} with {len(numbers)} numbers is no known camera; {hint}.")
    check_numbers(numbers, str(path))
    width, height = whole_size(size, str(path))
    fx, fy, cx, cy = numbers[:4]
    if model == "fov":
        return make_camera(str(path), lambda: FovCamera.from_tum_mono(fx, fy, cx, cy, numbers[4], width, height))
    if cx < 1 and cy < 1:
        # Relative numbers count from the corner of the top-left pixel, ours from its centre.
        fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    lens = lens_of(model, str(path))
    if lens == ANY and any(numbers[4:]):
        raise InputError(f"{path}: the fifth number of a Pinhole is {numbers[4]:g}; it must be 0, as it has no lens.")
    return listed_camera([fx, fy, cx, cy], numbers[4:], size, str(path), lens)


def _are_numbers(lines: list[list[str]]) -> bool:
    """Whether a file is lines of numbers, the first behind the name of a model of DSO or not."""
    if not lines:
        return False
    named = lines[0][0].lower() in _DSO_COUNTS
    return None not in [_float(word) for word in lines[0][named:]]


def _float(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
