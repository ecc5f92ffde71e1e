"""Camera files whose keys mean other things than those of other tools, in keys that `camera_keys` reads."""

from __future__ import annotations

import re
from typing import Any

from dualslam.core.errors import InputError

_OF_THEIA = {
    "focal_length": "fx",
    "principal_pt_x": "cx",
    "principal_pt_y": "cy",
    "radial_distortion_": "k",
    "tangential_distortion_": "p",
}
STRETCH = "input_horizontal_stretch"


def in_common_keys(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return a file with keys of its own (Theia's, KITTI's, ...) in those of other tools, and any other as it is.

    Raises `InputError` if its images are stretched, or its projections are of several cameras.
    """
    if isinstance(content.get("intrinsics"), dict) and "intrinsic_type" in content:
        return _of_theia(content)
    if isinstance(content.get("fisheye_params"), dict) and isinstance(content.get("calib_dimension"), dict):
        return _of_gyroflow(content, where)
    if "cam_model" in content and "cam_fx" in content:
        return _of_vikit(content)
    if "P0" in content and "P1" in content:
        return _of_kitti(content, where)
    if isinstance(content.get("calibration"), list):
        return _of_mast3r_slam(content)
    if isinstance(data := content.get("Dataset"), dict) and isinstance(data.get("Calibration"), dict):
        return _of_monogs(data["Calibration"])
    return content


def _of_theia(content: dict[str, Any]) -> dict[str, Any]:
    """Read Theia's intrinsics, as OpenImuCameraCalibrator and the pipelines of hand-held grippers write them."""
    found = {"model": content["intrinsic_type"]}
    for key, value in content["intrinsics"].items():
        name, number = re.fullmatch(r"(.*?)(\d*)", str(key)).groups()  # type: ignore[union-attr]
        found[_OF_THEIA.get(name, name) + number] = value
    aspect, fx = found.pop("aspect_ratio", 1.0), found.get("fx")
    if all(isinstance(n, int | float) for n in (aspect, fx)):
        found["fy"] = aspect * fx
    return found | {key: content[key] for key in ("image_width", "image_height") if key in content}


def _of_gyroflow(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Read a lens profile of Gyroflow: of a fisheye, unless it names another model."""
    if content.get(STRETCH, 1) not in (0, 1):
        raise InputError(f"{where}: {STRETCH} is {content[STRETCH]}; give the calibration of the images as they are.")
    lens, size = content["fisheye_params"], content["calib_dimension"]
    found = {key: lens[key] for key in ("camera_matrix", "distortion_coeffs") if key in lens}
    model = content.get("distortion_model") or "opencv_fisheye"
    return found | {"model": model, "width": size.get("w"), "height": size.get("h")}


def _of_vikit(content: dict[str, Any]) -> dict[str, Any]:
    """Read the settings of rpg_vikit, as SVO and FAST-LIVO have them: ``cam_fx``, and ``cam_d0`` to ``cam_d3``."""
    found = {str(key).removeprefix("cam_"): value for key, value in content.items() if str(key).startswith("cam_")}
    lens = [found.pop(f"d{i}") for i in range(len(found)) if f"d{i}" in found]
    return found | {"distortion_coefficients": lens}


def _of_mast3r_slam(content: dict[str, Any]) -> dict[str, Any]:
    """Read MASt3R-SLAM's ``intrinsics.yaml``: fx, fy, cx, cy, and OpenCV's coefficients behind them."""
    numbers, rest = content["calibration"], {key: value for key, value in content.items() if key != "calibration"}
    return rest | {"lens_model": "radtan", "camera_matrix": numbers[:4], "distortion_coefficients": numbers[4:]}


def _of_monogs(content: dict[str, Any]) -> dict[str, Any]:
    """Read the calibration of a data set of MonoGS, whose coefficients count if the images are distorted."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    lens = ("k1", "k2", "p1", "p2", "k3") if content.get("distorted") else ()
    return {"lens_model": "radtan"} | {name: content[name] for name in (*names, *lens) if name in content}


def _of_kitti(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Read KITTI's ``calib.txt``: projections of rectified cameras ``P0`` to ``P3``, which differ by their places."""
    found = []
    for name in ("P0", "P1", "P2", "P3"):
        words = str(content.get(name, content["P0"])).split()
        found.append([word for i, word in enumerate(words) if i % 4 != 3])
    if any(matrix != found[0] for matrix in found):
        raise InputError(f"{where}: P0 to P3 are of cameras that differ; write fx fy cx cy of the one that is meant.")
    return {"camera_matrix": found[0]}
