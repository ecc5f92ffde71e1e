"""Every setting of a run, with its meaning: strict pydantic models, read from and written to YAML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from dualslam.core.config.corruption import Corruption
from dualslam.core.config.problems import StrictModel as StrictModel  # part of this module, too
from dualslam.core.noise_model import ROBUST_K


class FrontendConfig(StrictModel):
    """Features and their comparison."""

    name: str = "auto"
    """Which front end: `auto`, `orb`, `sift`, `gms`, `kornia` (an extra), or `module:Class`, of what can be imported.
    Another package may offer one as an entry point of `dualslam.frontends`. `auto` is `sift` where the first
    images show few corners and it is the first to start a map, or steps are wide; else `orb`."""
    n_features: int = Field(1000, ge=50, le=20000)
    """Keypoints per image."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Settings of the chosen front end alone; it checks their names itself."""


class PixelsConfig(StrictModel):
    """The pixel matcher, which finds landmarks in the image itself where guided search finds too few."""

    name: str | None = None
    """Which pixel matcher: `direct`, one that a package offers as an entry point of `dualslam.pixel_matchers`, or
    `module:Class`, of what can be imported. null: none."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Settings of the chosen pixel matcher alone; it checks their names itself."""


class CameraConfig(StrictModel):
    """Camera properties beyond its calibration file."""

    model_sigma_px: float = Field(0.8, ge=0, le=100)
    """Error of the camera model itself at a pixel (one sigma), beside the noise of the features: chequerboard
    calibrations and rectified data sets are off by half a pixel to a pixel towards the rim of the image."""
    readout_s: float | None = Field(None, ge=-0.1, le=0.1)
    """Time between reading the first and the last row of an image, or column, where it is higher than wide. 0 for a
    global shutter, about 0.03 for webcams and the first Kinect, negative where the last one was read first, as in
    images turned upside down. null: it is estimated from frames without a map. If the shutter probably rolls, no map
    starts from a fast turn until then."""
    find_still_pixels: bool = True
    """Find pixels that stand still in the image while the rest moves (a bonnet, black bars, a logo), and leave them
    out. No map starts while the camera itself stands still."""
    mask: str | None = None
    """Image of the frames' size whose black pixels show no scene; or a folder with one a frame, by name or order."""


class InitialiserConfig(StrictModel):
    """How a submap starts: two views, a first bundle adjustment, and a check after it."""

    matching: Literal["ratio", "gms"] = "ratio"
    """How the two views are matched: by the front end's own wide matching, or by grid-based motion statistics. Any
    front end with binary descriptors supports these (`orb` with `gms` is the paper's Dual-SLAM+)."""


class TrackingConfig(StrictModel):
    """Pose of each frame against the submap."""

    min_inliers: int = Field(20, ge=6)
    """Landmarks that must agree with a pose for it to be taken at all."""
    max_lost_s: float = Field(0.75, ge=0)
    """Seconds after which a lost submap is given up, counted from the first frame without a pose by the frames' times.
    Below 5 Hz, as many frames as 5 Hz gives in them. Until then wide matching may find it again, and the next one may
    start."""


class KeyframeConfig(StrictModel):
    """When a frame becomes a keyframe."""

    max_parallax_deg: float = Field(4.0, gt=0)
    """Parallax at which a keyframe is due whatever is tracked."""
    weak_landmarks: int = Field(60, ge=10)
    """Tracked landmarks below which tracking is weak and a keyframe is due at once. Near landmarks hold the camera's
    position, by one over the depth squared each. If only few near ones do, a keyframe is also due when less than half
    of the hold required of their number is left."""


class MappingConfig(StrictModel):
    """New landmarks at a keyframe, and what is culled."""

    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe of whose landmarks this share is seen by three others at the same or a finer scale is culled."""


class HealthConfig(StrictModel):
    """When a tracked frame counts as explained by the map."""

    min_inliers: int = Field(25, ge=6)
    """Landmarks that must agree with the frame's pose."""
    max_refused: float = Field(0.5, ge=0, le=1)
    """Share of a new keyframe's matches that its graph may refuse: where the map contradicts the majority, the pose
    is wrong, and the keyframe is taken out again before the map grows about it. 1 lets every pose in."""


LEARNED: Mapping[str, Any] = {
    "frontend": "kornia",
    "n_features": 1000,
    "options": {"detector": "xfeat", "matcher": "lightglue"},
    "if_installed": True,
}
"""The attempt `learned`. LightGlue takes half the time with 1,000 features that it takes with 1,500."""


class AttemptConfig(StrictModel):
    """One attempt at a recovery: where its poses come from. It may be written as one word, which is `live`, `gap`
    (`{frontend: sift, tracking: live}`), `learned` (XFeat with LightGlue, if installed) or a front end's name.
    """

    frontend: str = "live"
    """`live`: the live features, guided by the motion model in reverse. Or a front end by its name: its own features,
    found in the buffered images, pose the frames by PnP from one to the next. Frames that cannot be used are skipped.
    Landmarks, and what is compared when linking, are made of the live features in either case."""
    tracking: Literal["own", "live"] = "own"
    """`own`: that front end poses every frame, so the attempt does not depend on the live features. `live`: it poses
    only the first frames beyond gaps, until the live features can take over. That is several times as fast."""
    n_features: int = Field(2000, ge=50, le=20000)
    """Keypoints per image of that front end."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Settings of that front end alone."""
    if_installed: bool = False
    """Whether the attempt is left out where the front end's extra is not installed. A run that would have made it
    writes the event `attempt_unavailable` once. Otherwise a missing extra is an error."""

    @property
    def is_live(self) -> bool:
        """Whether it walks on the live features alone."""
        return self.frontend == "live"

    @property
    def name(self) -> str:
        """Its name in events."""
        return self.frontend if self.tracking == "own" else f"gap ({self.frontend})"

    @model_validator(mode="before")
    @classmethod
    def _from_word(cls, value: Any) -> Any:
        if value == "gap":
            return {"frontend": "sift", "tracking": "live"}
        if value == "learned":
            return dict(LEARNED)
        return {"frontend": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _settings_have_an_owner(self) -> AttemptConfig:
        if self.is_live and self != AttemptConfig.model_construct():
            raise ValueError("`live` has no settings of its own: it is the front end that the section `frontend` sets")
        return self


class RecoveryConfig(StrictModel):
    """Reverse tracking that joins a new submap to the one that was lost."""

    enabled: bool = True
    """Off: a lost track ends the submap, and the next one is not linked to it."""
    max_gap_frames: int = Field(30, ge=0)
    """Frames in a row that reverse tracking may skip, because none of its keyframes can be matched in them. A walk that
    links no map, but poses the frames before a start, goes on to the end of the buffer."""
    attempts: tuple[AttemptConfig, ...] = Field(
        (AttemptConfig(frontend="sift", tracking="live"), AttemptConfig.model_validate("learned")), min_length=1
    )
    """In this order, each from the same snapshot of the new map, until one leads to a link. A list of words will do,
    such as `[gap, live, sift]`; an attempt with settings is written `{frontend: sift, n_features: 3000}`."""
    relocalise_after: int | None = Field(15, ge=0)
    """Frames with content but without a start, after which a map that they show is searched for and continued (if
    `places.enabled`). null: never. A new map that starts sooner is better linked by reverse tracking, and most start
    within 2 to 5 frames. Where the camera turns in place none can start, but it may come back to a lost map."""
    retry_keyframes: tuple[Annotated[int, Field(ge=1)], ...] = (5, 15)
    """Keyframes of the new map at which the first attempt is repeated if none has found a link, or left buffered frames
    without a pose. The map then knows depths better, and more of the scene. It is also repeated after a calibration. If
    any number stands here, it is repeated at the end of the run, once the map has grown by half. One for poses alone
    that finds none is the last."""
    workers: int = Field(0, ge=0, le=16)
    """Processes for long background work, for which tracking never waits (`--workers`): reverse tracking and
    self-calibration. With any there is one more, which solves the live map's graph. 0: inline, in the tracking process,
    which waits."""
    finish_wait_s: float = Field(30.0, ge=0)
    """How long the end of a run that was interrupted waits for walks under way. Any other end waits for all of them."""


class BufferConfig(StrictModel):
    """The frames that reverse tracking can still read."""

    duration_s: float = Field(10.0, gt=0)
    """Seconds of video that are kept (the paper's k) while there is a map to track; before it and after it, all is."""
    max_mb: float = Field(256.0, gt=0)
    """Hard bound on the memory of the kept features and images, mebibytes. Ten seconds of KITTI are 56, of 640 x 480 at
    30 Hz 120. A long loss reaches it; then images are packed, and the stretch between the frames before the loss and
    the newest ones thins out: first its images, then its frames. A bound too small for the rest costs the oldest."""


class GraphConfig(StrictModel):
    """The factor graph of a submap and its solver."""

    robust_k: float = Field(ROBUST_K, gt=0)
    """Huber threshold in sigmas: 1.345 keeps 95 % efficiency under Gaussian noise, 0.8 does where residuals are at
    0.6 of their sigmas, and 88 % where the sigmas are right."""
    max_keyframes: int = Field(150, ge=20, le=1000)
    """Keyframes at which a submap rolls over into the next. An update's cost grows with the map: on a road 65 ms on
    average with this cap, 140 ms without. The solver's Cholesky rejects chains of more than about 1,000."""
    rollover_keyframes: int = Field(12, ge=3, le=19)
    """Keyframes that a submap shares with the one that it rolls over into."""
    factors_per_keyframe: int = Field(60, ge=20)
    """Observations of a keyframe that become factors of the graph, about, chosen from those that it could bear: spread
    over the image, long tracks first. Points of the others follow the poses. An update's cost grows with it; where few
    other keyframes see the same points (on a road), it is up to 2.5 times as many."""


class LinkingConfig(StrictModel):
    """When two submaps that saw the same frames are linked by a similarity.

    A wrong link is off by more than one of the first three limits. All bounds on sigmas follow from them: a third, so
    that three sigmas are the limit; half of it, two sigmas, for what is judged again later.
    """

    wrong_scale: float = Field(0.05, gt=0)
    """Relative error of the scale at which a link is wrong."""
    wrong_rotation_deg: float = Field(3.0, gt=0)
    """Error of the rotation at which it is."""
    wrong_position: float = Field(0.05, gt=0)
    """Error of the matched landmarks' centre, relative to their median depth, at which it is."""

    deformation_sigma: float = Field(0.01, gt=0, le=0.1)
    """Relative deformation (standard deviation: drift in scale, bending in radians) that two healthy maps may have
    against each other over the length of their overlap, beyond their pixels' noise. It is the noise model of all gates
    that compare parts of the maps with each other."""
    min_inliers: int = Field(20, ge=6)
    """Matched landmarks that must agree."""
    min_keyframes: int = Field(4, ge=2)
    """Shared keyframes older than the suspected onset of corruption that must agree one by one. A rigid corrupted tail
    passes every other gate: two keyframes fix it, so evidence starts with the third."""

    @property
    def max_scale_sigma(self) -> float:
        """Largest standard deviation of the scale (relative)."""
        return self.wrong_scale / 3

    @property
    def max_rotation_sigma_deg(self) -> float:
        """Largest standard deviation of the rotation about any axis."""
        return self.wrong_rotation_deg / 3

    @property
    def max_position_sigma(self) -> float:
        """Largest standard deviation of the position of the matched landmarks' centre, relative to their depth."""
        return self.wrong_position / 3

    @property
    def max_live_scale_sigma(self) -> float:
        """Largest standard deviation of the scale at the new map's live end, including the loss by reverse tracking
        from there to the overlap. Also the limit beyond a gap that tracking has crossed by wide matching.
        """
        return self.wrong_scale / 2

    @property
    def max_joined_scale_sigma(self) -> float:
        """Largest standard deviation of the scale with which two maps are joined at all: one sigma. Beyond half of it,
        at the live end, the join carries a doubt, and reverse tracking looks for a better one first.
        """
        return self.wrong_scale

    @property
    def max_live_rotation_deg(self) -> float:
        """Rotation by which the camera that the pixels ask for may bend the new map from overlap to live end."""
        return self.wrong_rotation_deg / 2

    @property
    def max_gap_scale_sigma(self) -> float:
        """Largest standard deviation of the scale beyond a gap of reverse tracking, by the Hessian of its wide matches:
        the landmarks that are found again beyond the gap halve it, if the gap relocalisation is right.
        """
        return self.wrong_scale


class AtlasConfig(StrictModel):
    """The graph over all submaps."""

    robust: bool = True
    """Whether a connection that the others contradict is rejected; else all of them are obeyed."""


class PlacesConfig(StrictModel):
    """Places that are seen again."""

    enabled: bool = True
    """Whether places are recognised at all: loops, merges by revisit, frames without a map that are found in one."""


class LoopsConfig(StrictModel):
    """Loops and merges of maps at revisited places."""

    enabled: bool = True
    """Whether the live map is linked where it shows what any map, itself among them, has shown before. Without
    recovery (`recovery.enabled`) a lost map of the same run is never merged."""


class CalibrationConfig(StrictModel):
    """Self-calibration: when a submap estimates its camera, and when the estimate is used."""

    refine: bool = True
    """Whether to do it at all."""
    first_keyframes: int = Field(30, ge=10)
    """Keyframes at which a submap is asked for the first time."""
    max_observations: int = Field(15000, ge=1000)
    """Observations that go into the estimate: they bound its time (about 1 s)."""
    log_focal_sigma: float = Field(0.05, ge=1e-6)
    """Prior of the log of both focal lengths. A chequerboard gives 0.003, a data sheet 0.05, the depth camera's focal
    length taken for the colour camera's 0.1. It need not be tight: where the motion does not fix the focal length,
    nothing is changed at all."""

    @property
    def max_focal_sigma(self) -> float:
        """Sigma of the log focal length up to which it counts as observed: 1 % of focal length is 10 % of scale in a
        bend.
        """
        return 0.2 * self.log_focal_sigma


class Config(StrictModel):
    """The root of the configuration."""

    seed: int = Field(0, ge=0, le=2**64 - 1)
    """Seed of every random choice of the run; the solvers take 64 bits."""
    frontend: FrontendConfig = FrontendConfig()
    pixels: PixelsConfig = PixelsConfig()
    camera: CameraConfig = CameraConfig()
    initialiser: InitialiserConfig = InitialiserConfig()
    tracking: TrackingConfig = TrackingConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    health: HealthConfig = HealthConfig()
    buffer: BufferConfig = BufferConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    graph: GraphConfig = GraphConfig()
    linking: LinkingConfig = LinkingConfig()
    atlas: AtlasConfig = AtlasConfig()
    places: PlacesConfig = PlacesConfig()
    loops: LoopsConfig = LoopsConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    corruptions: tuple[Corruption, ...] = ()
    """Deliberate failures of the run, for example [{kind: blackout, start: 100, length: 10}]."""
