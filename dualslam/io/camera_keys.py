"""Cameras of files of keys, as OpenCV, ROS, Kalibr, ORB-SLAM, nerfstudio and others write them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import DivisionCamera, FovCamera, KannalaBrandtCamera, RadTanCamera
from dualslam.core.camera.sphere import EucmCamera
from dualslam.core.errors import InputError
from dualslam.io.camera_build import BEFORE_FOCAL, COEFFICIENTS, CORNER_PX, Size, build_camera
from dualslam.io.camera_table import CameraTable

REQUIRED = {
    KannalaBrandtCamera.model: ("k1",),
    FovCamera.model: ("omega",),
    DivisionCamera.model: ("k",),
} | BEFORE_FOCAL
MAX_SKEW_PX = 0.1
"""Of a matrix's second number: below it, it moves no pixel of the image by as much."""


def camera_of_mapping(content: dict[str, Any], where: str, images_px: Callable[[], Size] | None = None) -> Camera:
    """Return the camera that a mapping of another tool describes.

    - `where`: the file, for messages.
    - `images_px`: gives the size of the images, for a file that does not say it.

    Raises `InputError`: names the key that is missing, wrong, or not read.
    """
    said = CameraTable.of(content, where)
    lens = said.lens()
    if "projectiontype" in said.own or ("f" in said.own and {"projection", "class"} & said.own):
        numbers = _of_photogrammetry(said, lens, images_px)
    else:
        numbers = _numbers(said, lens, images_px)
    for name in REQUIRED.get(lens, ()):
        if name not in numbers and (lens, name) != (EucmCamera.model, "beta"):
            raise InputError(f"{where} has no {name}, which the model {lens!r} needs; add it.")
    said.refuse_rest()
    return build_camera(lens, numbers, where)


def _numbers(said: CameraTable, lens: str, images_px: Callable[[], Size] | None) -> dict[str, float]:
    """Return the numbers of a camera in pixels: a matrix, a list, or a key for each."""
    numbers: dict[str, float] = {}
    listed = said.numbers("matrix")
    before = BEFORE_FOCAL.get(lens, ())
    if listed and len(listed) == 9:
        numbers |= _of_matrix(listed, said)
    elif listed:
        names = (*before, "fx", "fy", "cx", "cy")
        if len(listed) != len(names):
            raise InputError(f"{said.key('matrix')} has {len(listed)} numbers; it should be {' '.join(names)}.")
        numbers |= dict(zip(names, listed, strict=True))
    elif said.has("focals") and said.has("principal"):
        for name, keys in (("focals", ("fx", "fy")), ("principal", ("cx", "cy"))):
            pair = said.numbers(name) or []
            if len(pair) != 2:
                raise InputError(f"{said.key(name)} has {len(pair)} numbers; it should be two, in pixels.")
            numbers |= dict(zip(keys, pair, strict=True))
    elif said.has("angle") and not said.has("fx"):
        numbers["width"] = said.size(numbers, images_px)[0]
        numbers["fx"] = 0.5 * numbers["width"] / math.tan(0.5 * said.number("angle"))
    else:
        numbers["fx"] = said.number("fx")
    opengl = said.has("angle") or "flx" in said.own
    said.take("angle")
    for name in ("fx", "fy", "cx", "cy"):
        if name not in numbers and (said.has(name) or not opengl):
            numbers[name] = said.number(name) - (CORNER_PX if opengl and name[0] == "c" else 0.0)
    numbers |= dict(zip(("width", "height"), said.size(numbers, images_px), strict=True))
    numbers.setdefault("fy", numbers["fx"])
    numbers.setdefault("cx", 0.5 * (numbers["width"] - 1))
    numbers.setdefault("cy", 0.5 * (numbers["height"] - 1))
    return numbers | _coefficients(said, lens)


def _of_matrix(K: list[float], said: CameraTable) -> dict[str, float]:
    if K[2] == 0.0 and K[5] == 0.0 and K[6] != 0.0:  # by columns, as ARKit and Open3D write it
        K = [K[i] for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    if abs(K[1]) > MAX_SKEW_PX or any(K[i] != 0.0 for i in (3, 6, 7)) or K[8] != 1.0:
        raise InputError(f"{said.key('matrix')} is not fx 0 cx, 0 fy cy, 0 0 1: a skew is not read; calibrate without.")
    return {"fx": K[0], "cx": K[2], "fy": K[4], "cy": K[5]}


def _coefficients(said: CameraTable, lens: str) -> dict[str, float]:
    """Return the named coefficients of a lens, from keys of their own or from a list of them."""
    names = COEFFICIENTS.get(lens, COEFFICIENTS[RadTanCamera.model])
    found: dict[str, float] = {}
    if lens == KannalaBrandtCamera.model and "mu" in said.own:  # camodocal counts from k2
        return {f"k{i - 1}": said.number(f"k{i}") for i in range(2, 6)}
    listed = said.numbers("list")
    if listed is not None:
        if any(listed[len(names) :]):
            raise InputError(
                f"{said.key('list')} has {len(listed)} distortion coefficients; {' '.join(names) or 'none'} "
                f"of them are supported{' for this model' if lens else ''}."
            )
        if lens == KannalaBrandtCamera.model and 0 < len(listed) < 4:
            raise InputError(f"{said.key('list')} has {len(listed)} distortion coefficients; a fisheye camera has 4.")
        found |= dict(zip(names, listed, strict=False))
    for name in (*names, *BEFORE_FOCAL.get(lens, ())):
        if said.has(name):
            value = said.number(name)
            if found.get(name, value) != value:
                raise InputError(f"{said.key(name)} is {value:g}, and {found[name]:g} in the list of coefficients.")
            found[name] = value
    return found


def _of_photogrammetry(said: CameraTable, lens: str, images_px: Callable[[], Size] | None) -> dict[str, float]:
    """Return the numbers of a camera of OpenSfM (in units of the longer side) or Metashape (from the middle)."""
    width, height = said.size({}, images_px)
    numbers: dict[str, float] = {"width": width, "height": height}
    middle = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
    if "projectiontype" in said.own:
        unit = float(max(width, height))
        for name in ("fx", "fy"):
            numbers[name] = unit * said.number("focal" if said.has("f") else f"focal{name[1]}")
        numbers |= {name: middle[name] + unit * said.optional(name) for name in middle}
        return numbers | _coefficients(said, lens)
    f = said.number("f")
    numbers |= {"fx": f + said.optional("b1"), "fy": f}
    numbers |= {name: middle[name] + said.optional(name) for name in middle}
    lensed = {name: said.optional(name) for name in ("k1", "k2", "k3", "k4")}
    # Its tangential terms are OpenCV's in the other order.
    return numbers | lensed | {"p1": said.optional("p2"), "p2": said.optional("p1")}
