"""The camera of a lens and its numbers, and what the field's tools call the lenses."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import (
    MODELS,
    DivisionCamera,
    FovCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    RadTanCamera,
)
from dualslam.core.camera.sphere import DoubleSphereCamera, EucmCamera, OmniCamera
from dualslam.core.errors import InputError

log = logging.getLogger(__name__)

Size = tuple[int, int]

COEFFICIENTS: dict[str, tuple[str, ...]] = {
    RadTanCamera.model: ("k1", "k2", "p1", "p2", "k3"),
    KannalaBrandtCamera.model: ("k1", "k2", "k3", "k4"),
    FovCamera.model: ("omega",),
    DivisionCamera.model: ("k",),
    OmniCamera.model: ("k1", "k2", "p1", "p2"),
    EucmCamera.model: (),
    DoubleSphereCamera.model: (),
}
"""Of each model, in the order in which tools list them as distortion."""
BEFORE_FOCAL = {
    OmniCamera.model: ("xi",),
    EucmCamera.model: ("alpha", "beta"),
    DoubleSphereCamera.model: ("xi", "alpha"),
}
"""Parameters before fx, fy, cx, cy in Kalibr's list of intrinsics."""
ANY, NONE = "", "none"
_SAID: dict[str, str] = {
    ANY: "pinhole simplepinhole linearpinhole perspective rectified",
    NONE: "none nodistortion undistorted distortionnone",
    RadTanCamera.model: (
        "radtan radialtangential plumbbob brown brownconrady rationalpolynomial opencv fullopencv frame simpleradial "
        "radial pinholeradialtangential opencvstandard"
    ),
    KannalaBrandtCamera.model: (
        "kannalabrandt kannala kannalabrandt8 kannalabrandt4 kb kb4 equidistant equi fisheye opencvfisheye "
        "fisheyeopencv simpleradialfisheye radialfisheye simplefisheye"
    ),
    FovCamera.model: "fov atan",
    DivisionCamera.model: "division radialdivision simpledivision",
    OmniCamera.model: "omni omnidirectional mei unifiedprojection",
    EucmCamera.model: "eucm ucm extendedunified",
    DoubleSphereCamera.model: "doublesphere ds",
}
LENSES = {word: lens for lens, words in _SAID.items() for word in words.split()} | {"": ANY}
"""Lens of each model name, in small letters without signs."""
KNOWN = (
    "pinhole, radial-tangential (plumb_bob), kannala_brandt (equidistant, fisheye), fov, division, omni (MEI), eucm, "
    "double_sphere (ds)"
)
"""For messages."""

CORNER_PX = 0.5
"""Where COLMAP, nerfstudio and Metashape have the centre of the first pixel."""


def plain(word: object) -> str:
    """Return a key or a name in small letters, without signs."""
    return re.sub(r"[^a-z0-9]", "", str(word).lower())


def lens_of(name: str, where: str) -> str:
    """Return the lens that a model's name says, or refuse it by this name."""
    # Python prints RealSense's as `distortion.brown_conrady`.
    word = plain(name.rsplit(".", 1)[-1])
    if word not in LENSES:
        raise InputError(f"{where}: the camera model {name!r} is not one of those that are read: {KNOWN}.")
    return LENSES[word]


def build_camera(lens: str, numbers: dict[str, float], where: str) -> Camera:
    """Return the camera of a lens of `COEFFICIENTS`, or `ANY`, of named numbers; what is missing is zero."""
    numbers = {name: value for name, value in numbers.items() if value != 0.0 or name in ("cx", "cy", "fx", "fy")}
    for name in ("width", "height"):
        if not float(numbers.get(name, 0.0)).is_integer() or numbers.get(name, 0.0) < 1:
            raise InputError(f"{where}: {name} is {numbers.get(name)}; it must be a whole number of pixels.")
    numbers = with_y_down(numbers, where)
    if lens == ANY:
        lens = RadTanCamera.model
    if lens == NONE or (lens == RadTanCamera.model and not set(numbers) & set(COEFFICIENTS[lens])):
        lens = PinholeCamera.model
    known = {*COEFFICIENTS.get(lens, ()), *BEFORE_FOCAL.get(lens, ()), *("fx", "fy", "cx", "cy", "width", "height")}
    if odd := [name for name in numbers if name not in known]:
        reads = " ".join(COEFFICIENTS.get(lens, ())) or "no distortion"
        raise InputError(f"{where}: {odd[0]} is {numbers[odd[0]]:g}, but the model {lens!r} has {reads}; correct it.")
    width, height = int(numbers.pop("width")), int(numbers.pop("height"))
    return make_camera(where, lambda: MODELS[lens](width, height, **numbers))


def with_y_down(numbers: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the same calibration with its y-axis down: a negative fy (ICL-NUIM's is -480) says that it points up."""
    fy = numbers.get("fy")
    if not isinstance(fy, int | float) or fy >= 0:
        return numbers
    log.info("%s: fy is negative, so its y-axis points up; here it points down", where)
    return numbers | {"fy": -fy} | ({"p1": -numbers["p1"]} if numbers.get("p1") else {})


def make_camera(where: str, build: Callable[[], Camera]) -> Camera:
    """Build a camera, which checks itself; what is wrong with it is said with the name of the file."""
    try:
        return build()
    except InputError as e:
        raise InputError(f"{where}: {str(e).removeprefix('camera: ').rstrip('.')}; correct the calibration.") from e


def whole_size(size: tuple[float, float], where: str) -> Size:
    """Return an image size as whole numbers."""
    if not all(float(n).is_integer() and n >= 1 for n in size):
        raise InputError(f"{where}: the image size is {size[0]} x {size[1]}; it must be two whole numbers of pixels.")
    return int(size[0]), int(size[1])


def check_numbers(numbers: list[float], where: str) -> None:
    """Refuse a calibration that holds NaN or infinity."""
    if not np.isfinite(numbers).all():
        raise InputError(f"{where} holds a number that is not finite; calibrate again or correct it.")
