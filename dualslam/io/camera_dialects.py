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
    """Return a file of Theia or Gyroflow in the keys of other tools, and any other as it is.

    Raises `InputError` if its images are stretched.
    """
    if isinstance(content.get("intrinsics"), dict) and "intrinsic_type" in content:
        return _of_theia(content)
    if isinstance(content.get("fisheye_params"), dict) and isinstance(content.get("calib_dimension"), dict):
        return _of_gyroflow(content, where)
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
