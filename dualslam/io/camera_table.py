"""A camera file as a flat table of keys: which of them describe one camera, and which of them were used.

Those of `NAMES` are used. Any other key that looks like a lens or a model is refused by its name: what it says would be
lost.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.core.camera.models import MODELS, KannalaBrandtCamera, RadTanCamera
from dualslam.core.camera.sphere import OmniCamera
from dualslam.core.errors import InputError
from dualslam.io.camera_build import ANY, BEFORE_FOCAL, LENSES, NONE, Size, check_numbers, lens_of, plain, whole_size

log = logging.getLogger(__name__)

Path = tuple[str, ...]

NAMES: dict[str, tuple[str, ...]] = {
    "model": (
        *("model", "cameramodel", "distortionmodel", "modeltype", "cameratype", "type", "projectiontype", "projection"),
        *("distortiontype", "lensmodel", "lenstype", "projectionmodel", "cameramodeltype", "distmodel", "distortion"),
    ),
    "fisheye": ("fisheyemodel", "isfisheye", "fisheye", "bfisheye"),
    "matrix": ("cameramatrix", "k", "k1", "m1", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx"),
    "list": ("distortioncoefficients", "distcoeffs", "distcoeff", "distortioncoeffs", "dist", "d", "d1", "distortion",
             "coeffs", "distortionparameters", "distortionparams", "distortioncoeff", "parameters"),
    "width": ("imagewidth", "width", "w", "cols"),
    "height": ("imageheight", "height", "h", "rows"),
    "resolution": ("resolution", "imagedimension", "imagesize", "imgsize", "imagersize", "imageresolution"),
    "focals": ("focallength",),
    "principal": ("principalpoint",),
    "fx": ("fx", "flx", "gamma1", "mu"),
    "fy": ("fy", "fly", "gamma2", "mv"),
    "cx": ("cx", "u0", "ppx"),
    "cy": ("cy", "v0", "ppy"),
    "f": ("f", "focal"),
    "angle": ("cameraanglex",),
    "omega": ("omega", "w"),
    "k": ("k", "distortion"),
    **{name: (name,) for name in ("k1", "k2", "k3", "k4", "p1", "p2", "xi", "alpha", "beta")},
}  # fmt: skip
"""Parameters and their keys, in small letters without signs. If two are present, they must agree."""
PARAMETERS = frozenset(word for name, words in NAMES.items() if name not in ("model", "fisheye") for word in words)
SECTIONS = frozenset({
    "projectionparameters", "mirrorparameters", "distortionparameters", "intrinsics", "intrinsic", "distortion", "lens",
    "imageresolution", "imagesize",
    "resolution", "intrinsicparameters", "coefficients", "distortioncoefficients", "narrowstereo", "image",
})  # fmt: skip
"""Keys that only group others."""
SUSPECT = re.compile(
    r"^dist(?!ance)|distort|fisheye|lens|^(camera|projection|mirror)?(model|type)$|equirect|spheri|panoram|^omni|mirror|"
    r"focal|intrinsic|coeff|^principal|^binning|crop|rational|skew|shear|^(image|img|frame)(size|shape|dims?|dimensions?)$"
)
"""Keys that look like a lens, a model, or a cut of the image."""
SUSPECT_NUMBER = re.compile(
    r"^(k|p|s|b|d|sx|sy|tau|r|inv|c)\d$|^(k|d|f|s|c|xi|alpha|beta|gamma|omega)$|^[fc][xy]$|^fl[xy]$"
)
"""Names that look like a coefficient where they have one number."""
HARMLESS = re.compile(
    r"^(sensortype|calibrationtime|focallengthmm|rectificationmatrix|projectionmatrix|perframeintrinsiccoeffs)$"
)
RIG = re.compile(r"^(left|right|camera[12]?|cam\d+|frames|value0)$")
"""Where a file has several cameras of one rig, of which the first is meant; elsewhere one must be chosen."""
SECOND = ("right", "camera2", "cam1")
SAME = 1e-3
"""Relative, and of coefficients: cameras of one file whose numbers differ by less are one."""
MIDDLE = (0.4, 0.6)
"""Where a principal point lies in its image, as a share of its sides. Outside, the image was of another size."""


@dataclass(frozen=True, slots=True)
class Key:
    """A leaf of a file: the keys that lead to it, and its value."""

    path: Path
    value: Any

    @property
    def name(self) -> str:
        """The last key, plain."""
        return plain(self.path[-1])

    @property
    def owner(self) -> Path:
        """The keys above it, but for those that only group."""
        return tuple(part for part in self.path[:-1] if plain(part) not in SECTIONS)


class CameraTable:
    """The keys of one camera of a file, and which of them were used."""

    def __init__(self, where: str, keys: list[Key], others: list[Key]) -> None:
        self.where = where
        self._keys, self._others = keys, others
        self._used: set[Path] = set()
        self.own = {key.name for key in keys}

    @classmethod
    def of(cls, content: dict[str, Any], where: str) -> CameraTable:
        """Find the camera of a file: its own keys, those that stand above them, and the other keys."""
        keys = list(_flat(content))
        owners = list(dict.fromkeys(key.owner for key in keys if _is_focal(key)))
        if not owners:
            # Nothing but a model's name may be there: that of a panorama says why there is no focal length.
            for key in keys:
                if key.name in NAMES["model"] and isinstance(key.value, str):
                    lens_of(key.value, f"{where}: {'.'.join(key.path)}")
                    raise InputError(f"{where} has no intrinsics; add fx, fy, cx and cy as its tool writes them.")
            raise unknown_camera(where)
        owner = min(owners, key=lambda o: ("LEFT" not in o, any(plain(part) in SECOND for part in o), len(o)))
        above = [owner[:n] for n in range(len(owner))]
        if plain(".".join(owner)) == "camera1":
            above.append(("Camera",))
        mine = [k for k in keys if k.owner == owner]
        chosen = [*mine, *(k for k in keys if k.owner in above and k.owner != owner)]
        _refuse_other_frames(keys, mine, owner, where)
        rest = [k for k in keys if k.owner not in owners and k not in chosen]
        if others := [o for o in owners if o != owner and not ("frames" in o and not owner)]:
            named = " and ".join(".".join(o) for o in [owner, *others][:3])
            if not all(RIG.match(plain(o[0])) for o in others):
                raise InputError(f"{where} describes several cameras ({named}); keep the one that took these images.")
            if "frames" not in owner:
                log.warning("%s describes several cameras: %s is read", where, ".".join(owner))
        return cls(where, chosen, rest)

    def find(self, name: str) -> Key | None:
        """Return the key that says `name`, the nearest; refuse two that say different things."""
        words = NAMES.get(name, (name,))
        fitting = [key for key in self._keys if key.name in words and _fits(name, key.value)]
        self._used.update(key.path for key in fitting)
        nearest = [key for key in fitting if key.owner == fitting[0].owner]
        if any(_array(key.value) != _array(nearest[0].value) for key in nearest[1:]):
            named = " and ".join(".".join(key.path) for key in nearest)
            raise InputError(f"{self.where}: {named} say different things; keep the one that is right.")
        return nearest[0] if nearest else None

    def has(self, name: str) -> bool:
        """Whether a key says `name`."""
        return any(k.name in NAMES.get(name, (name,)) and _fits(name, k.value) for k in self._keys)

    def take(self, name: str) -> Any:
        """Return what the file says of `name`; None where nothing."""
        key = self.find(name)
        return None if key is None else key.value

    def key(self, name: str) -> str:
        """Return the file and the key that says `name`, for a message."""
        key = self.find(name)
        return f"{self.where}: {name if key is None else '.'.join(key.path)}"

    def number(self, name: str) -> float:
        """Return a number that must be there."""
        value = self.take(name)
        if value is None:
            raise InputError(f"{self.where} has no {name}; add it.")
        try:
            number = float(value[0] if isinstance(value, list) else value)
        except (TypeError, ValueError):
            raise InputError(f"{self.key(name)} is {value!r}, not a number.") from None
        check_numbers([number], self.key(name))
        return number

    def optional(self, name: str) -> float:
        """Return a number that is zero where it is missing."""
        return self.number(name) if self.has(name) else 0.0

    def numbers(self, name: str) -> list[float] | None:
        """Return the numbers of a list or a matrix, by rows; None where there is none."""
        value = self.take(name)
        if value is None:
            return None
        try:
            numbers = [float(n) for n in np.asarray(value, float).ravel()]
        except (TypeError, ValueError):
            raise InputError(f"{self.key(name)} is not a list of numbers.") from None
        check_numbers(numbers, self.key(name))
        if name == "matrix" and len(numbers) == 16:
            numbers = [numbers[i] for i in (0, 1, 2, 4, 5, 6, 8, 9, 10)]
        if name == "matrix" and not any(numbers):
            raise InputError(f"{self.key(name)} is all zeros: this camera was not calibrated.")
        return numbers

    def size(self, numbers: dict[str, float], images_px: Callable[[], Size] | None) -> Size:
        """Return the size of the images; where the file does not say it, that of these images, if `numbers` fit it."""
        resolution = self.numbers("resolution")
        if resolution is not None and len(resolution) >= 2 and len(resolution) % 2 == 0:
            return whole_size((resolution[0], resolution[1]), self.where)
        if self.has("width") and self.has("height"):
            return whole_size((self.number("width"), self.number("height")), self.where)
        if images_px is None:
            raise InputError(f"{self.where} does not say the size of the images; add image_width and image_height.")
        size = images_px()
        # Without one it is the middle.
        cx, cy = (numbers.get(name, 0.5 * side) for name, side in zip(("cx", "cy"), size, strict=True))
        if not all(MIDDLE[0] <= (c + 0.5) / side <= MIDDLE[1] for c, side in zip((cx, cy), size, strict=True)):
            raise InputError(
                f"{self.where} does not say the size of its images, and its principal point ({cx:g}, {cy:g}) is not "
                f"near the middle of these of {size[0]} x {size[1]}; add image_width and image_height."
            )
        log.warning("%s does not say the size of its images: it is taken for these, %d x %d", self.where, *size)
        return size

    def lens(self) -> str:
        """Return the lens that the names of the models say; two that do not go together are refused."""
        lenses: dict[str, str] = {}
        for word in NAMES["model"]:
            for key in self._keys:
                if key.name == word and isinstance(key.value, str):
                    self._used.add(key.path)
                    lenses[lens_of(key.value, f"{self.where}: {'.'.join(key.path)}")] = ".".join(key.path)
        flagged = self.take("fisheye")
        if flagged not in (None, 0, 1, "0", "1", "true", "false"):
            raise InputError(f"{self.key('fisheye')} is {flagged!r}; it should be 0 or 1.")
        if flagged in (1, "1", "true") and not set(lenses) & set(BEFORE_FOCAL):
            lenses[KannalaBrandtCamera.model] = self.key("fisheye").removeprefix(f"{self.where}: ")
        if self.has("xi") and self.has("matrix") and not set(lenses) & set(BEFORE_FOCAL):  # OpenCV names no model
            lenses[OmniCamera.model] = "xi"
        said = [lens for lens in lenses if lens != ANY]
        for sphere in set(said) & set(BEFORE_FOCAL):
            fitting = (NONE, RadTanCamera.model) if sphere == OmniCamera.model else (NONE,)
            said = [lens for lens in said if lens not in fitting]
        if len(said) > 1:
            named = " and ".join(f"{lenses[lens]} ({lens})" for lens in said)
            raise InputError(f"{self.where}: {named} are two models; keep the one that is right.")
        of_pinholes = self.has("matrix") or {"flx", "cameraanglex", "t00", "p1"} & self.own  # no other lens has a p1
        if not lenses and not of_pinholes and not any(k.path[0] in ("Camera", "Camera1", "LEFT") for k in self._keys):
            raise unknown_camera(self.where)
        return said[0] if said else ANY

    def refuse_rest(self) -> None:
        """Refuse keys that look like a lens or a model, and were not used."""
        full = {"width": self.take("width"), "height": self.take("height")}
        for key in [*self._keys, *self._others]:
            if key.path in self._used or HARMLESS.match(key.name) or _says_nothing(key):
                continue
            says_model = isinstance(key.value, str) and LENSES.get(plain(key.value), ANY) not in (ANY, NONE)
            is_number = _is_single(key.value) and SUSPECT_NUMBER.search(key.name)
            in_roi = len(key.path) > 1 and plain(key.path[-2]) == "roi" and key.value != full.get(key.name)
            if says_model or is_number or in_roi or SUSPECT.search(key.name):
                raise InputError(
                    f"{self.where}: {'.'.join(key.path)} looks like a lens, a camera model or a crop, and is not read; "
                    "remove it, or use the keys of docs/calibration.md."
                )


def unknown_camera(where: str) -> InputError:
    """Return the error of a file that describes no camera, or does not say of which kind it is."""
    return InputError(
        f"{where} does not say which camera it is: add `model: pinhole` (or {', '.join(list(MODELS)[1:])}) to "
        "fx, fy, cx, cy, width and height, or give a file of a tool that docs/calibration.md lists."
    )


def _flat(value: Any, path: Path = ()) -> Iterator[Key]:
    """Yield the leaves of a file: numbers, words, and lists of numbers; a matrix with `data` is one."""
    if isinstance(value, dict) and "data" in value and {"rows", "cols", "dt"} & set(value):
        yield Key(path, value["data"])
    elif isinstance(value, dict):
        for key, inner in value.items():
            parts = str(key).split(".") if re.fullmatch(r"[A-Za-z_]\w*(\.\w+)+", str(key)) else [str(key)]
            yield from _flat(inner, (*path, *parts))
    elif isinstance(value, list) and value and all(isinstance(inner, dict) for inner in value):
        for number, inner in enumerate(value):
            yield from _flat(inner, (*path, str(number)))
    elif path:
        yield Key(path, value)


def _is_focal(key: Key) -> bool:
    name = key.name
    if name in (*NAMES["matrix"], *NAMES["focals"]):
        return _fits("matrix", key.value)
    return name in (*NAMES["fx"], *NAMES["f"], *NAMES["angle"], "focalx")


def _array(value: Any) -> Any:
    try:
        return np.asarray(value, float).ravel().tolist()
    except (TypeError, ValueError):
        return value


def _fits(name: str, value: Any) -> bool:
    """Whether a value is of the kind that `name` has: `distortion` may be a word, a list or a number."""
    if name == "matrix":
        return isinstance(value, list) or (isinstance(value, str) and not LENSES.get(plain(value)))
    if name in ("list", "resolution", "focals", "principal"):
        return isinstance(value, list)
    return _is_single(value)


def _is_single(value: Any) -> bool:
    """Whether a value is a word or a number, by itself or in OpenCV's matrix of one."""
    return not isinstance(value, list) or (len(value) == 1 and not isinstance(value[0], list))


def _says_nothing(key: Key) -> bool:
    """Whether a value is zero, false or empty, or bins single pixels."""
    numbers = _array(key.value)
    if isinstance(numbers, list):
        return not any(numbers) or (key.name.startswith("binning") and numbers == [1.0])
    return plain(key.value) in ("", "none", "false", "no")


def _refuse_other_frames(keys: list[Key], mine: list[Key], owner: Path, where: str) -> None:
    """Refuse frames of nerfstudio or Polycam with intrinsics, a lens or a size of their own that differ."""
    first = {k.name: k for k in mine if k.name in PARAMETERS}
    for key in keys:
        if key.name in first and key.owner and key.owner != owner and plain(key.owner[0]) == "frames":
            ours, theirs = _array(first[key.name].value), _array(key.value)
            if np.shape(ours) != np.shape(theirs) or not (ours == theirs or np.allclose(ours, theirs, SAME, SAME)):
                raise InputError(
                    f"{where}: {'.'.join(key.path)} is {key.value}, {'.'.join(first[key.name].path)} "
                    f"{first[key.name].value}; one camera is read, so give the images of one."
                )
