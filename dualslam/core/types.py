"""The small frozen values that the stages of the system hand to each other.

Conventions of all of dualslam:

- ``T_a_b`` takes coordinates in b to coordinates in a.
- Poses are (4, 4) float64, camera to submap unless the name says otherwise.
- The camera looks along +z, with x right and y down.
- Pixels are (u, v), with (0, 0) at the centre of the top-left pixel.
- A submap's lengths are in its own monocular unit (``_mu``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dualslam.core.decisions import Gate
from dualslam.core.errors import InputError
from dualslam.core.grey_image import GreyImage

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
REFINED_PX = 1.5
"""Pixels of its octave by which a detector errs at most, and a map may move a feature: a longer way leads elsewhere."""


class FrameStatus(StrEnum):
    """Status of one input frame: the `status` column of ``frames.csv``."""

    INITIALISING = "initialising"
    TRACKED = "tracked"
    LOST = "lost"
    RECOVERED = "recovered"
    BYPASSED = "bypassed"
    DROPPED = "dropped"
    UNREADABLE = "unreadable"


class FrameMethod(StrEnum):
    """How a frame's pose was found: the `method` column of ``frames.csv``."""

    GUIDED = "guided"
    """Landmarks searched where the motion model predicts them."""
    WIDE = "wide"
    """Whole images matched: at a start, beyond a gap, when a map is relocalised."""
    DIRECT = "direct"
    """Most of its landmarks found by a pixel matcher."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a sequence.

    Attributes
    ----------
    index : int
        Position in the source, whatever the stride or direction of reading.
    timestamp_s : float
        Time of exposure, seconds.
    image : ndarray or None
        (H, W) or (H, W, 3) RGB uint8; None where the file could not be read (`error` says why).
    error : str
        Empty, or the reason why the image is missing.
    features : Features or None
        What was found in the image already, as the front end's `extract` returns it.
    hidden : (H, W) bool or None
        Pixels that show no scene, such as a gripper: no feature is taken from them.

    Raises
    ------
    InputError
        If it is none: it is refused before anything is done with it.
    """

    index: int
    timestamp_s: float
    image: NDArray[np.uint8] | None
    error: str = ""
    features: Features | None = None
    hidden: BoolArray | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be a frame."""
        if not isinstance(self.index, int | np.integer) or self.index < 0:
            raise InputError(f"a frame's index is {self.index!r}; frames are counted from 0 in whole numbers.")
        if not isinstance(self.timestamp_s, int | float | np.number) or not math.isfinite(self.timestamp_s):
            raise InputError(f"frame {self.index}: its time is {self.timestamp_s!r}; it must be a number of seconds.")
        if self.image is None:
            return
        if not isinstance(self.image, np.ndarray):
            raise InputError(f"frame {self.index}: its image is a {type(self.image).__name__}; it must be an array.")
        is_colour = self.image.ndim == 3 and self.image.shape[2] == 3
        if self.image.dtype != np.uint8 or not (self.image.ndim == 2 or is_colour) or self.image.size == 0:
            raise InputError(
                f"frame {self.index}: its image is {self.image.shape} {self.image.dtype}; "
                "it must be (H, W) or (H, W, 3) RGB uint8, values from 0 to 255."
            )
        hidden = self.hidden
        if hidden is not None and (hidden.dtype != np.bool_ or hidden.shape != self.image.shape[:2] or hidden.all()):
            raise InputError(
                f"frame {self.index}: its mask is {hidden.shape} {hidden.dtype}; it must be bool, of the image's size "
                f"{self.image.shape[:2]}, and leave some pixels."
            )


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Features:
    """Keypoints of one image with their descriptors, N of them.

    Attributes
    ----------
    uv_px : (N, 2) float64
        Their positions in the image. Those of a rolling shutter are corrected to the time of its middle row.
    uv_rect_px : (N, 2) float64
        The same, with lens distortion removed: pixels of the camera's pinhole equivalent. All geometry uses these.
    sigma_px : (N,) float64
        Standard deviation of each coordinate of `uv_rect_px`, isotropic.
    scale : (N,) float64
        Size of the image patch relative to the finest level (>= 1).
    octave : (N,) int64
        Pyramid level.
    angle_rad : (N,) float64
        Orientation, clockwise from +u.
    descriptors : (N, D)
        Opaque to all but the front end that made them.
    """

    uv_px: FloatArray
    uv_rect_px: FloatArray
    sigma_px: FloatArray
    scale: FloatArray
    octave: IntArray
    angle_rad: FloatArray
    descriptors: NDArray[np.generic]

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays; one that serves as two is counted once."""
        arrays = (self.uv_px, self.uv_rect_px, self.sigma_px, self.scale, self.octave, self.angle_rad, self.descriptors)
        return sum({id(array): array.nbytes for array in arrays}.values())

    def n_common(self, other: Features) -> int:
        """Return how many features, from the first on, are the same in another set of the same image.

        A map may have found more in its keyframe than the front end had: those stand behind the front end's. It may
        have refined pixels, too (`REFINED_PX`). So descriptors and octaves are compared, and pixels roughly.
        """
        n = min(len(self), len(other))
        if self is other:
            return n
        mine, theirs = self.descriptors, other.descriptors
        if (mine.dtype, mine.shape[1:]) != (theirs.dtype, theirs.shape[1:]):
            return 0
        apart_px = np.abs(self.uv_px[:n] - other.uv_px[:n]).max(axis=1, initial=0.0)
        differ = (self.octave[:n] != other.octave[:n]) | (apart_px > 2 * REFINED_PX * self.scale[:n])
        differ |= (mine[:n] != theirs[:n]).any(axis=1)
        return int(differ.argmax()) if differ.any() else n

    def take(self, rows: NDArray[np.generic]) -> Features:
        """Return the features at `rows` (indices or a mask)."""
        rows = np.asarray(rows)
        index: IntArray = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows.astype(np.int64, copy=False)
        return Features(
            self.uv_px.take(index, axis=0),  # of rows of several columns, ten times as fast as [index]
            self.uv_rect_px.take(index, axis=0),
            self.sigma_px[index],
            self.scale[index],
            self.octave[index],
            self.angle_rad[index],
            self.descriptors.take(index, axis=0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A frame as the system sees it once its features are found: what the frame buffer keeps.

    Attributes
    ----------
    index : int
    timestamp_s : float
    features : Features
        Of the live front end.
    image : GreyImage or None
        For attempts at recovery that need other features, and to find landmarks again; None where it was given up.
    turn_rad : (3,) float64 or None
        Rotation during the readout of the image that was taken out of the features; None: nothing was.
    """

    index: int
    timestamp_s: float
    features: Features
    image: GreyImage | None = None
    turn_rad: FloatArray | None = None

    @property
    def nbytes(self) -> int:
        """Memory of features and image."""
        return self.features.nbytes + (self.image.nbytes if self.image is not None else 0)


@dataclass(frozen=True, slots=True)
class LateFrame:
    """A frame that came too late to be tracked, and whose features are found only when a walk needs them."""

    index: int
    timestamp_s: float
    image: GreyImage  # without the pixels that show no scene

    @property
    def nbytes(self) -> int:
        """Memory of the image."""
        return self.image.nbytes


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pairs of features (or landmarks) of two sets.

    Attributes
    ----------
    index : (M, 2) int64
        Row in the first set, row in the second; no row occurs twice in a column.
    distance : (M,) float64
        Descriptor distance in the front end's own unit.
    """

    index: IntArray
    distance: FloatArray

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that the map keeps. Its pose and its landmarks belong to the submap, not to it."""

    id: int  # the index of its source frame: the same frame has the same keyframe id in every submap
    timestamp_s: float
    features: Features


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A posed frame."""

    view: View
    T_cam_submap: FloatArray  # (4, 4)
    T_predicted: FloatArray  # (4, 4): what the motion model said
    landmark_ids: IntArray  # (N,): for each feature of the view the landmark it agrees with, or `NO_LANDMARK`
    visible_ids: IntArray  # (V,): landmarks that the search expected to see; none where the pose came from elsewhere
    n_matches: int  # landmarks that were matched
    n_inliers: int  # those that agree with the pose
    chi2: float  # mean squared whitened residual per degree of freedom of the inliers
    wide: bool  # whether guided matching failed and the pose came from wide matching
    covariance: FloatArray  # (6, 6): of `T_cam_submap`, for a left perturbation (rotation, translation)
    n_by_pixels: int = 0  # inliers that a pixel matcher found; the others are features that were matched

    @property
    def seen_ids(self) -> IntArray:
        """The landmarks that agree with the pose."""
        return self.landmark_ids[self.landmark_ids >= 0]

    @property
    def method(self) -> FrameMethod:
        """How the pose was found: `DIRECT` where pixels found most of the inliers."""
        if 2 * self.n_by_pixels > self.n_inliers:
            return FrameMethod.DIRECT
        return FrameMethod.WIDE if self.wide else FrameMethod.GUIDED


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """Another answer to where a frame beyond a gap is, where what is seen there repeats itself."""

    index: int  # of the frame
    T_cam_rival: FloatArray  # (4, 4): ``T_cam_submap`` by the other answer
    T_cam_walked: FloatArray  # (4, 4): the same by the one that was gone by

    @property
    def T_rival_walked(self) -> FloatArray:
        """Transform of everything beyond the gap, from its place under the one pose to that under the other."""
        return np.asarray(np.linalg.inv(self.T_cam_rival) @ self.T_cam_walked, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A verified start of a submap."""

    views: list[View]  # first view, witnesses, last view, in the order in which they were given
    T_first_cam: FloatArray  # (V, 4, 4)
    xyz: FloatArray  # (N, 3): in the first camera's frame; the median depth is 1
    feature: IntArray  # (V, N): feature of each point in each view, or -1
    numbers: dict[str, float]  # the measures that the checks looked at


class FailureReason(StrEnum):
    """Why an estimate, a track or a link was given up."""

    NO_TEXTURE = "no_texture"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_INLIERS = "too_few_inliers"
    LOW_INLIER_RATIO = "low_inlier_ratio"
    MOTION_JUMP = "motion_jump"
    CHI_SQUARE = "chi_square"
    LOW_PARALLAX = "low_parallax"
    CAMERA_STANDS = "camera_stands"
    AMBIGUOUS_MODEL = "ambiguous_model"
    DOUBTFUL_INITIALISATION = "doubtful_initialisation"
    DEGENERATE = "degenerate"
    SOLVER = "solver"
    UNREADABLE = "unreadable"
    NOT_INSTALLED = "not_installed"
    SCALE = "scale"
    SCALE_LOST = "scale_lost"
    CAMERA = "camera"
    SPREAD = "spread"
    AGREEMENT = "agreement"
    CONTRADICTION = "contradiction"
    REPROJECTION = "reprojection"
    DEFORMED = "deformed"
    NEEDS_OLDER_KEYFRAMES = "needs_older_keyframes"
    UNCONFIRMED = "unconfirmed"
    LOOK_ALIKE = "look_alike"
    LEAP = "leap"
    PHOTOMETRIC = "photometric"
    TIMEOUT = "timeout"
    WORKER = "worker"
    BUSY = "busy"
    DISABLED = "disabled"


@dataclass(frozen=True, slots=True)
class Failure:
    """A falsy result: the estimate was not made, and why.

    >>> pose = Failure(FailureReason.TOO_FEW_MATCHES, "12 matches, 20 needed")
    >>> bool(pose)
    False
    """

    reason: FailureReason
    detail: str = ""
    numbers: dict[str, float] = field(default_factory=dict)
    gates: tuple[Gate, ...] = field(default=(), kw_only=True)
    """The comparisons that led to it, where they are known."""

    def __bool__(self) -> bool:
        return False
