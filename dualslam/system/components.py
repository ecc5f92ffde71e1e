"""The parts that a system is made of: what knows the front ends and the solver comes from outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.interfaces import (
    FinalRefiner,
    MapStarter,
    PatchCheck,
    Scene,
    Seeker,
    Shutter,
    SubmapGraph,
)
from dualslam.core.types import Failure, FloatArray, Frame, LateFrame, View
from dualslam.core.walk_news import WalkWatch
from dualslam.map.graph_beside import BesideGraphs
from dualslam.map.lens import Calibration
from dualslam.map.submap import Submap
from dualslam.places.sightings import PlaceParts
from dualslam.workers.scheduled_desk import ScheduledDesk


@dataclass(frozen=True, slots=True)
class Components:
    """The parts that the composition root puts in: the system itself knows neither front end nor solver.

    `keep`: what stays of a frame that came too late to be tracked. `new_relocaliser`: a front end that finds its submap
    again wherever it is seen, and tracks from there. `walk_watch`: hears of reverse tracking that is under way. `desk`:
    does the background work. `graphs`: carries changes to submaps' graphs in another process and back, if they are
    solved there. `refine_at_end`: has the last word on each submap.
    `patches`: compares frames with the images of older keyframes. `open_graph`: makes a graph of a submap in this
    process, solved. `open_features`: starts one more process, and returns a function that has the features of a frame
    found there. `foresee`: precomputes in the background the features that reverse tracking may need. None without
    background processes.
    """

    view_of: Callable[[Frame], View | Failure]
    keep: Callable[[Frame], LateFrame | Failure]
    new_starter: Callable[[], MapStarter]
    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], Seeker]
    new_relocaliser: Callable[[Submap, SubmapGraph], Seeker]
    calibration: Calibration
    shutter: Shutter
    scene: Scene
    walk_watch: WalkWatch
    atlas_solver: AtlasSolver
    refine_at_end: FinalRefiner
    patches: PatchCheck
    places: PlaceParts
    desk: ScheduledDesk
    open_graph: Callable[[Submap], SubmapGraph]
    graphs: BesideGraphs | None = None
    open_features: Callable[[], Callable[[Frame], Frame]] | None = None
    foresee: Callable[[View], None] | None = None

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels, as they are known now."""
        return self.calibration.camera.K
