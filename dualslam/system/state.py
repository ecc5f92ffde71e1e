"""What the steps of the machine share: the parts that it is made of, and where it stands between two frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

from dualslam.atlas.record import Record
from dualslam.atlas.stored_map import StoredMap
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.config.settings import Config
from dualslam.core.interfaces import (
    FinalRefiner,
    FocalChangeFinder,
    JointCalibrator,
    MapStarter,
    PatchCheck,
    Registrar,
    Scene,
    Seeker,
    Shutter,
    SubmapAdjuster,
    SubmapGraph,
    VisualOdometry,
)
from dualslam.core.types import Failure, Features, FloatArray, Frame, LateFrame, Matches, View
from dualslam.core.walk_news import WalkWatch
from dualslam.map.graph_beside import BesideGraphs
from dualslam.map.lens import Calibration
from dualslam.map.submap import Submap
from dualslam.places.sightings import PlaceParts
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.system.audit.photometric import PhotometricAudit
from dualslam.system.health import HealthMonitor
from dualslam.system.motion_watch import MotionWatch
from dualslam.system.pace import Pace
from dualslam.workers.scheduled_desk import ScheduledDesk


@dataclass(slots=True)
class State:
    """State that the steps of a frame share."""

    parts: Components
    config: Config
    record: Record
    buffer: FrameBuffer
    saved: StoredMap | None  # the map that this run continues
    localises: bool  # frames are only found in that map, and nothing is added to it
    health: HealthMonitor  # of the tracking in the live map, or of the attempts at one
    audit: PhotometricAudit
    pace: Pace = field(default_factory=Pace)
    motion_watch: MotionWatch = field(default_factory=MotionWatch)
    live: VisualOdometry | None = None  # the front end of the live submap; None while there is no map
    lost: list[View] = field(default_factory=list)  # the frames since tracking was lost in the live map

    def front_ends(self) -> list[VisualOdometry]:
        """Return the front end that tracks in a submap, if there is one: it must follow when that moves."""
        return [] if self.live is None else [self.live]

    def begin_health(self) -> None:
        """Forget the signs of trouble: another map is tracked from now on, or none."""
        self.health = HealthMonitor(self.config.health)


@dataclass(frozen=True, slots=True)
class Components:
    """The parts that the composition root puts in: the system itself knows neither front end nor solver."""

    view_of: Callable[[Frame], View | Failure]
    keep: Callable[[Frame], LateFrame | Failure]  # what stays of a frame that came too late to be tracked
    new_starter: Callable[[], MapStarter]
    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], Seeker]
    new_relocaliser: Callable[[Submap, SubmapGraph], Seeker]  # finds its submap wherever it is seen, goes on there
    calibration: Calibration
    calibrate_together: JointCalibrator
    find_focal_change: FocalChangeFinder
    shutter: Shutter
    scene: Scene
    walk_watch: WalkWatch  # hears of reverse tracking that is under way
    atlas_solver: AtlasSolver
    settle_ties: SubmapAdjuster  # bends a submap whose keyframes have come to share landmarks
    refine_at_end: FinalRefiner  # has the last word on each submap
    patches: PatchCheck  # compares frames with the images of older keyframes
    places: PlaceParts
    desk: ScheduledDesk
    open_graph: Callable[[Submap], SubmapGraph]  # a graph of a submap in this process, solved
    new_registrar: Callable[[Submap], Registrar]  # it, `adjust` and `alike`: for `recovery/registration.py`
    adjust: Callable[[Submap, Collection[int]], None]
    alike: Callable[[Mapping[int, Features], Collection[int], int], dict[int, list[int]]]
    match_wide: Callable[[Features, Features], Matches]  # as of `Frontend`
    graphs: BesideGraphs | None = None  # carries changes to submaps' graphs in another process and back
    open_features: Callable[[], Callable[[Frame], Frame]] | None = None
    """Starts one more process, and returns a function that has the features of a frame found there."""
    foresee: Callable[[View], None] | None = None  # precomputes the features that reverse tracking may need

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels, as they are known now."""
        return self.calibration.camera.K
