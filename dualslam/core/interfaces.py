"""The interfaces of the system, as Protocols: what a front end, a graph and a sequence offer to the rest."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dualslam.core.bundle import FrameRows
from dualslam.core.decisions import Ruling
from dualslam.core.estimates import CalibrationEstimate, FocalChange, GraphEstimate, KeyframeReport
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.types import (
    BoolArray,
    Failure,
    Features,
    FloatArray,
    Frame,
    IntArray,
    Matches,
    Rival,
    Start,
    Track,
    View,
)

if TYPE_CHECKING:
    from dualslam.core.camera.base import Camera
    from dualslam.map.submap import Submap


class Frontend(Protocol):
    """Features, how they are compared, and how far to trust them; guided searches need nothing but this.

    Nothing outside a front end knows what its descriptors are made of. They are rows of one array, of one type and
    length, that can be stored, sent to another process and handed back for comparison. The same image gives the same
    features, whatever came before: a front end has no state, and several threads may ask it at once.
    `dualslam.frontends.conformance` checks all that is said here.

    Attributes
    ----------
    name : str
        The word that selects it in the config.
    scale_factor : float
        Ratio of the patch sizes of neighbouring octaves. A feature is recognised one octave off, so that this is also
        the change of size that a descriptor bears by itself: a front end with one octave states that.
    n_octaves : int
        Number of pyramid levels.
    max_distance : float
        Descriptor distance above which two features are not views of the same point.
    max_distance_strict : float
        The same for searches without a geometric guide.
    max_turn_deg : float
        Rotation of the camera about its axis between two views that `match_wide` bears; 180: any.
    max_zoom : float
        Ratio of sizes between two views that `match_wide` bears, in either direction.
    """

    name: str
    scale_factor: float
    n_octaves: int
    max_distance: float
    max_distance_strict: float
    max_turn_deg: float
    max_zoom: float

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe, in any image: a flat or a tiny one has no features.

        `uv_rect_px` equals `uv_px` (the caller rectifies). `sigma_px` is the noise model: the right matches' residuals
        are to be explained by it. Octaves are in [0, n_octaves), `scale` about ``scale_factor ** octave``. A front end
        without orientations leaves `angle_rad` at zero.
        """
        ...

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Distance of paired descriptors (N, D), (N, D) -> (N,) float.

        Symmetric, and zero for equal ones. A ratio of best to second best must have a meaning (a norm of the
        difference, a count of differing bits).
        """
        ...

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Match without a geometric guide, one to one; `distance` is that of the descriptors."""
        ...


@runtime_checkable
class NearestSearch(Protocol):
    """Extra interface of a front end with quickly compared descriptors: the input of motion statistics."""

    def nearest(self, a: Features, b: Features) -> IntArray:
        """Row in b of the feature nearest to each of a, (N,), by descriptor alone and without any test.

        Several may share one. At least one feature in b.
        """
        ...


class PixelMatcher(Protocol):
    """Finds landmarks in a new image by the pixels of older ones, without features; chosen by `pixels.name`.

    The tracker asks it where guided search finds too few landmarks, before it matches whole images. Its matches are
    observations like any other: the pose is estimated from them, with outliers, and they enter the map. It has no
    state: the same arguments give the same matches. `dualslam.testing.pixel_matching` checks what is said here.

    Attributes
    ----------
    name : str
        The word that selects it in the config.
    """

    name: str

    def find(
        self, references: tuple[PosedImage, ...], image: NDArray[np.uint8], camera: Camera, T_cam_submap: FloatArray
    ) -> PixelMatches:
        """Find landmarks of the references in an image.

        Parameters
        ----------
        references : tuple of PosedImage
            The last posed frame, then keyframes that see the same, the newest first. At least one.
        image : (H, W) uint8
            Grey, of the references' size.
        camera : Camera
            Takes pixels to rays and back.
        T_cam_submap : (4, 4)
            Pose of the image as the motion model predicts it; it may be off by many pixels.

        Returns
        -------
        PixelMatches
            Each landmark at most once, inside the image. `sigma_px` is the noise model: the right matches' residuals
            are to be explained by it. Empty where nothing is found.
        """
        ...


class Sequence(Protocol):
    """A source of frames: folder, video, archive, webcam or renderer."""

    name: str
    camera: Camera
    rate_hz: float

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Frame]: ...


N_WINDOW = 3
"""Newest keyframes that the tracking has a window move: those that it goes on from."""


WindowSolver = Callable[["Submap", list[int]], GraphEstimate | Failure]
"""Poses a new keyframe by a small bundle: what tracking goes on from until the graph has looked at it.

It adjusts a few keyframes, the newest first, and the points that the newest sees; the submap is not changed. Keyframes
of the submap's gauge stay where they are. `GraphEstimate.outlier_rows` are of the newest keyframe.
"""


class Registrar(Protocol):
    """Poses frames in a finished submap, in any order, and extends it by them."""

    def densify(self) -> None:
        """Match the submap's keyframes with those before them, whether tracking needed it or not."""
        ...

    def pose(self, view: View, keyframe_ids: Collection[int]) -> Track | Failure:
        """Pose a frame by the landmarks of some keyframes, all together."""
        ...

    def refuse_repeated(self, track: Track, keyframe_ids: Collection[int]) -> Failure | None:
        """Refuse a pose if another one explains nearly as much: then the scene repeats itself."""
        ...

    def insert(self, track: Track) -> None:
        """Make a frame a keyframe of the submap that sees the landmarks by which it was posed."""
        ...

    def tie(self, find_alike: Callable[[Collection[int]], Mapping[int, list[int]]]) -> int:
        """Let keyframes that `find_alike` names share the landmarks that both show; return how many features do."""
        ...

    def extend(self, keyframe_id: int, others: Collection[int]) -> None:
        """Carry landmarks on along a keyframe's matches with some others, and triangulate new ones with them."""
        ...


class SubmapGraph(Protocol):
    """The factor graph of one submap. The submap's arrays are the record, the graph follows them.

    It knows observations by the numbers of their rows. One that finds that rows have gone which it was not asked about
    (`Submap.n_dropped`) makes its state anew.
    """

    def rows_out(self, submap: Submap) -> IntArray:
        """Return rows of dead observations that it is done with: they may leave the table now."""
        ...

    def keep_rows(self, rows: IntArray) -> None:
        """Take in that only these rows have stayed in the table, in their order (`Submap.keep_observations`)."""
        ...

    def update(self, submap: Submap) -> GraphEstimate:
        """Take in what changed in the submap since the last call (rows added, rows that died) and solve."""
        ...

    def rebuild(self, submap: Submap, near_optimum: bool = False) -> GraphEstimate:
        """Make the solver's state anew from the submap's arrays; `near_optimum`: parts of them are solved already."""
        ...

    def full_estimate(self, submap: Submap) -> GraphEstimate:
        """Return the estimate of everything in the graph as of the last update, without solving."""
        ...

    def pose_covariance(self, keyframe_id: int) -> FloatArray:
        """(6, 6) marginal covariance of `T_submap_kf`, tangent order rotation, translation, in the keyframe's frame."""
        ...

    def point_covariances(self, landmark_ids: IntArray) -> FloatArray:
        """(L, 3, 3) marginal covariances of landmarks, in the submap's frame."""
        ...


SelfCalibrator = Callable[["Submap", "Camera", FloatArray | None], CalibrationEstimate | Failure]
"""Asks a submap about its camera, which is the one that rectified its features. The submap is not changed.

It returns the correction of the calibration that was given, or why it cannot be had. It takes the covariance (5, 5) of
the correction that the camera has, if it was estimated.
"""

JointCalibrator = Callable[
    [list["Submap"], "Camera", FloatArray | None], tuple[CalibrationEstimate, list["Submap"]] | Failure
]
"""Asks several submaps about the camera that they share, as a `SelfCalibrator` does one; also returns copies of them,
changed to it. Raises `InputError` if the correction has no inverse somewhere in the image."""

FocalChangeFinder = Callable[[list["Submap"], "Camera"], FocalChange | None]
"""Finds whether the focal length changes during a run."""

SubmapAdjuster = Callable[["Submap"], None]
"""Refines all poses and points of a submap in place, in batch. Raises `SolverError` where the solver fails."""


class FinalRefiner(Protocol):
    """Refines a submap in place at the end of a run, in batch, under a loss that forgets outliers.

    Raises `SolverError`, and leaves the submap as it was, where the solver fails.
    """

    def __call__(self, submap: Submap, *, frames: FrameRows) -> float:
        """Refine by keyframes and frames, and return the shape of that loss, in the pixels' sigmas."""
        ...


START_REACH = 192
"""Frames back from the newest that a starter looks for its first view, at most."""


class PatchCheck(Protocol):
    """Compares frames with small image patches that are kept of keyframes."""

    def remember(self, submap: Submap, view: View) -> None:
        """Keep patches of a view that is a keyframe of a submap."""
        ...

    def measure(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> float | None:
        """Return which share (0 to 1) of an older keyframe's patches a posed frame shows where the map predicts them.

        None where no keyframe shows enough of the same, or the view has no image.
        """
        ...


class MapStarter(Protocol):
    """Collects views until some of them start a map."""

    def collect(self, view: View) -> None:
        """Keep a view as a possible first view, without trying to start from it."""
        ...

    def add(self, view: View, waited_s: float = 0.0, briefly: bool = False) -> Start | Failure:
        """Take a view in and try to start a map that ends with it.

        `waited_s`: for how long there has been no map; `briefly`: with a part of what could be tried.
        """
        ...


class Shutter(Protocol):
    """Knows or finds how an image is read row by row, and takes that out of the frames' features."""

    @property
    def readout_s(self) -> float:
        """Time between reading the first and the last row (or column, if upright); 0: all at once, or not known yet."""
        ...

    def shutter_corrected(self, view: View, camera: Camera) -> View:
        """Return a frame's view as if all rows had been read at once. Frames come in the order of the sequence."""
        ...

    def all_corrected(self, views: Iterable[View], camera: Camera) -> list[View]:
        """Do so for the frames that came before the readout time was known, given in their order."""
        ...

    def correction(self, indices: Collection[int], camera: Camera) -> Callable[[View], View] | None:
        """Return what does so for these frames one by one, in any order; None where some turn is not known yet.

        It makes the same of a view by whichever readout time it has been corrected before.
        """
        ...

    def may_start(self, view: View, camera: Camera) -> bool:
        """Whether a map may start from this view, found while there is none; `readout_s` may become known by it."""
        ...

    @property
    def is_stated(self) -> bool:
        """Whether the readout time is not to be found, but as it was given."""
        ...

    def ask(self, submap: Submap, rates_rad_s: Mapping[int, FloatArray], camera: Camera) -> object | Failure:
        """Ask a map for what of the readout is left in its keyframes, with how they turn (rad/s, in their own axes).

        The question can be pickled; its answer is a `ReadoutEstimate`.
        """
        ...

    def moved(self, features: Features, camera: Camera, turn_rad: FloatArray) -> Features:
        """Return a keyframe's features without so much more of a turn while it was read."""
        ...

    def take(
        self, readout_s: float, rates_rad_s: Mapping[int, FloatArray], latest: Iterable[View], K: FloatArray
    ) -> None:
        """Continue with the readout time estimated from a map."""
        ...


class Scene(Protocol):
    """Knows which pixels show the scene, and which stand still in the image."""

    @property
    def hidden(self) -> BoolArray | None:
        """Return the pixels (H, W) that were found to stand still: a new array whenever they change, or None."""
        ...

    @property
    def camera_stands(self) -> bool:
        """Whether most of the image stands still, and something moves through it."""
        ...

    def refuse_start(self) -> Failure | None:
        """Return why no map should start now; None where one may."""
        ...

    def shows(self, features: Features) -> BoolArray:
        """Return which features (N,) of any frame are not of pixels that stand still."""
        ...

    def masked(self, view: View) -> View:
        """Return a view of an earlier frame without what stands still."""
        ...


class VisualOdometry(Protocol):
    """Tracks frames against one submap and extends it by keyframes, in whatever order of time the frames come."""

    submap: Submap
    graph: SubmapGraph

    @property
    def reference_id(self) -> int:
        """The keyframe that frames are posed against."""
        ...

    def start_at(self, keyframe_id: int) -> None:
        """Begin at a keyframe of the submap, at rest."""
        ...

    def keep(self, keyframe_ids: Set[int]) -> None:
        """Never cull these keyframes, however redundant they become."""
        ...

    def adopt(self, graph: SubmapGraph, before: Submap) -> None:
        """Go on with another graph of the same submap, whose poses and points have moved since it was `before`."""
        ...

    def track(self, view: View) -> Track | Failure:
        """Pose a frame."""
        ...

    def relative_pose(self, track: Track) -> FloatArray:
        """Return ``T_kf_cam``: the track's pose relative to the reference keyframe; its own is the identity."""
        ...

    @property
    def rivals(self) -> tuple[Rival, ...]:
        """Other answers to where the camera is beyond the gaps that were crossed, and the one at hand."""
        ...

    def confirmed(self) -> Track | None:
        """Return the earlier frame, given without a pose, that the last one has confirmed the pose of."""
        ...

    def keyframe_due(self, track: Track) -> Ruling:
        """Whether the frame should become a keyframe; asking changes nothing."""
        ...

    def go_by_known(self, track: Track) -> None:
        """Go by the keyframe that is there already, of an earlier run, for a frame which would have become one."""
        ...

    def insert_keyframe(self, track: Track, in_haste: bool = False) -> KeyframeReport | Failure:
        """Make the frame a keyframe and solve the graph; `in_haste`: without what can be left out."""
        ...


class Seeker(VisualOdometry, Protocol):
    """The live front end: it grows a submap from its start, and finds it again wherever it is seen."""

    def grow_weak_start(self, noise2: float) -> None:
        """Triangulate what else the views of a start match, where its last view holds few landmarks.

        Call it after `start_at`. `noise2`: variance of the start's whitened residuals.
        """
        ...

    def relocalise(self, view: View, keyframe_id: int) -> Track | Failure:
        """Pose a frame by what a keyframe of the submap and those about it show; go on from there, at rest."""
        ...

    def look_about(self) -> None:
        """Go by the keyframe that sees most of what the last frame saw, without making that one a keyframe."""
        ...
