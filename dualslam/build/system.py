"""The system and the live front end, put together."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dualslam.atlas.stored_map import StoredMap, tidy
from dualslam.backend.final_refinement import refine_submap, settle_ties
from dualslam.backend.focal_change import find_focal_change
from dualslam.backend.local_ba import adjust_and_prune
from dualslam.backend.self_calibration import calibrate_together
from dualslam.build.checks import check_config, check_given
from dualslam.build.parts import atlas_solver, graph_maker, new_calibration, new_initialiser, place_parts, window_solver
from dualslam.build.walks import recovery_parts
from dualslam.build.workers import (
    MAP_KINDS,
    WALK_LIMIT_S,
    WORKER_BUDGET,
    features_beside,
    inline_handlers,
    map_handlers,
    worker_desk,
)
from dualslam.core.camera.base import Camera
from dualslam.core.camera.mapped import MappedCamera, camera_for_map
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.interfaces import Frontend, SubmapGraph
from dualslam.core.jobs import InlineDesk, JobKind
from dualslam.core.schedule import AT_ONCE, After, Policy, Recorded
from dualslam.core.types import View
from dualslam.core.walk_news import WalkWatch
from dualslam.frontends.direct.patch_audit import PatchAudit
from dualslam.frontends.frame_reader import FrameReader
from dualslam.frontends.gap.refinding import Refinder
from dualslam.frontends.registry import create_frontend, create_pixel_matcher
from dualslam.frontends.scene_mask import SceneMask
from dualslam.frontends.still_pixels import StillPixels
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.frontends.tracking.keyframe_images import KeyframeImages
from dualslam.frontends.tracking.pixel_search import PixelSearch
from dualslam.frontends.tracking.registrar import Registrar
from dualslam.frontends.tracking.rolling_shutter import RollingShutter
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.lab.disturbances import FaultScript
from dualslam.map.graph_beside import BesideGraphs
from dualslam.map.lens import Calibration, change_camera
from dualslam.map.submap import Submap
from dualslam.map.submap_change import open_graph
from dualslam.places.faiss_index import find_resembling
from dualslam.recovery.registration import MIN_PARALLAX_DEG
from dualslam.system.state import Components
from dualslam.system.system import System
from dualslam.workers.desk import WorkerDesk
from dualslam.workers.scheduled_desk import ScheduledDesk
from dualslam.workers.start_beside import StartBeside

log = logging.getLogger(__name__)


def build_system(
    config: Config,
    camera: Camera,
    saved: StoredMap | None = None,
    localise: bool = False,
    new_graph: Callable[[], SubmapGraph] | None = None,
    schedule: Policy | None = None,
    in_process: bool = False,
) -> System:
    """Build a system from its config.

    Parameters
    ----------
    camera : Camera
        Lens model and size of the images that `System.step` will be given.
    saved : StoredMap, optional
        A map to find frames in and to extend (`load_atlas`); it becomes the system's own. Its camera, as it was found
        out, is taken as known.
    localise : bool
        Find poses in the saved map, and add nothing to it.
    new_graph : callable, optional
        Makes the factor graph of a submap, each time anew, instead of `ISam2SubmapGraph`; in one process alone.
    schedule : Policy, optional
        When answers of background work are used (`dualslam/core/schedule.py`): `After` so many frames, or as
        `Recorded` by another run. By default at once without workers, else after `DELAYS`, and in real time as they
        come.
    in_process : bool
        Whether the workers' jobs are done in this process; the schedule is the same. So they are for `Recorded`.

    Raises
    ------
    InputError
        As `check_given`; and where graphs of one's own are to go into other processes.
    ConfigError
        As `check_config`, and where an extra or weights that a front end needs are missing.
    """
    check_config(config)
    check_given(camera, saved)
    if new_graph is not None and config.recovery.workers:
        raise InputError("new_graph: a graph of one's own cannot go into other processes; set recovery.workers to 0.")
    new_graph = new_graph or graph_maker(config)
    frontend = create_frontend(config.frontend)
    known = camera if saved is None else _camera_of(saved, camera)
    is_known = saved is not None and saved.camera is not None
    if isinstance(known, MappedCamera):
        camera = known
    if is_known:  # its camera is its own: to change it would part what is there from what comes
        config = config.with_section("calibration", refine=False)
    calibration = new_calibration(config, known)
    faults = FaultScript(config.corruptions)
    shutter = RollingShutter(frontend, config.camera, config.seed)

    if saved is not None and not localise:
        saved = replace(saved, poses=tidy(saved.atlas, saved.poses))
    live = LiveParts(config, frontend, calibration, camera, 0 if saved is None else saved.next_id)
    scene = SceneMask(StillPixels(camera.size_px) if config.camera.find_still_pixels else None)
    reader = FrameReader(frontend, live.camera, config.camera.model_sigma_px, shutter, scene)

    workers = config.recovery.workers
    # Built here in any case: a mistake in the config is reported at once, not by a worker.
    parts = recovery_parts(config, camera, frontend=frontend, new_graph=new_graph)
    places = place_parts(config, frontend, camera)
    watch = WalkWatch()
    in_process = in_process or not workers or isinstance(schedule, Recorded)
    executor: InlineDesk | WorkerDesk
    if in_process:
        handlers = inline_handlers(config, parts, places.verifier, new_graph)
        if workers:
            handlers |= map_handlers(config, camera.size_px)
        # A record says by itself which jobs were lost.
        is_lost = None if isinstance(schedule, Recorded) else faults.loses
        executor = InlineDesk(handlers, watch, is_lost, MAP_KINDS)
    else:
        executor = worker_desk(config, camera, faults, watch)
    schedule = schedule or (After() if workers else AT_ONCE)
    budget_s = WORKER_BUDGET * WALK_LIMIT_S
    desk = ScheduledDesk(executor, schedule, config.recovery.finish_wait_s, budget_s)
    open_one = partial(open_graph, new_graph=new_graph)
    graphs = BesideGraphs(desk, window_solver(config), open_one) if workers else None
    opens = (
        partial(features_beside, executor, config.frontend, scene.painted) if isinstance(executor, WorkerDesk) else None
    )

    return System(
        Components(
            view_of=faults.around_views(reader),
            keep=reader.keep,
            new_starter=partial(_starter_beside, desk, live) if workers else live.new_starter,
            new_graph=graphs.new_graph if graphs is not None else new_graph,
            new_odometry=faults.around_odometry(live.new_odometry),
            new_relocaliser=faults.around_odometry(live.new_relocaliser),
            calibration=calibration,
            calibrate_together=partial(
                calibrate_together,
                change_camera=change_camera,
                config=config.calibration,
                robust_k=config.graph.robust_k,
                seed=config.seed,
            ),
            find_focal_change=partial(find_focal_change, config=config.calibration, seed=config.seed),
            shutter=shutter,
            scene=scene,
            walk_watch=watch,
            desk=desk,
            open_graph=open_one,
            new_registrar=lambda submap: Registrar(frontend, config, submap, camera),
            adjust=partial(
                adjust_and_prune, robust_k=config.graph.robust_k, min_parallax_rad=np.radians(MIN_PARALLAX_DEG)
            ),
            match_wide=frontend.match_wide,
            alike=partial(find_resembling, distance=frontend.distance, max_distance=frontend.max_distance_strict),
            atlas_solver=atlas_solver(config),
            settle_ties=partial(settle_ties, robust_k=config.graph.robust_k),
            refine_at_end=partial(refine_submap, robust_k=config.graph.robust_k),
            patches=PatchAudit(live.camera),
            graphs=graphs,
            places=places,
            open_features=opens,
            foresee=partial(_foresee, desk) if not in_process and config.recovery.enabled else None,
        ),
        config,
        saved,
        localise,
    )


@dataclass(frozen=True, slots=True)
class LiveParts:
    """The parts that are made anew with each start and each submap.

    `FrameReader` finds a frame's features. `Initialiser` starts a map from them. `VisualFrontEnd` poses the frames that
    follow, and extends the map by keyframes. A `SubmapGraph` solves it.
    """

    config: Config
    frontend: Frontend
    calibration: Calibration
    given: Camera
    first_id: int = 0
    """Number of the first frame: those before it are of the runs that have left the saved map."""

    def camera(self) -> Camera:
        """Return the camera as it is known now."""
        return self.calibration.camera

    def new_starter(self) -> Initialiser:
        """Make what collects views until two of them start a map."""
        return new_initialiser(self.config, self.frontend, self.given.size_px, self.camera().K)

    def new_odometry(self, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        """Make the front end that tracks frames against a submap and extends it."""
        return self._front_end(submap, graph)

    def new_relocaliser(self, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        """Make one that looks in the whole submap, and not only at what is near in time."""
        return self._front_end(submap, graph, looks_everywhere=True)

    def _front_end(self, submap: Submap, graph: SubmapGraph, looks_everywhere: bool = False) -> VisualFrontEnd:
        config, frontend = self.config, self.frontend
        refinder = Refinder(submap, frontend, self.camera, config.camera.model_sigma_px)
        return VisualFrontEnd(
            frontend,
            config,
            submap,
            graph,
            self.given,
            refinder=refinder,
            looks_everywhere=looks_everywhere,
            window=window_solver(config),
            first_id=self.first_id,
            pixels=self._pixel_search(refinder.images),
        )

    def _pixel_search(self, images: KeyframeImages) -> PixelSearch | None:
        """Make what finds landmarks by their pixels, if a pixel matcher is chosen."""
        config, matcher = self.config, create_pixel_matcher(self.config.pixels)
        if matcher is None:
            return None
        return PixelSearch(matcher, images, self.frontend, self.camera, config.camera.model_sigma_px)


def _camera_of(saved: StoredMap, camera: Camera) -> Camera:
    """Return the camera that made a saved map, perhaps corrected since; another one is brought to the map's pixels."""
    if saved.camera is None:
        return camera
    found = camera_for_map(saved.camera, camera)
    if found is not saved.camera and found is not camera:
        log.warning("the saved map was made with another camera: this one's pixels are brought to the map's")
    return found


def _foresee(desk: ScheduledDesk, view: View) -> None:
    """Have a worker, which has nothing else to do, look at a frame."""
    desk.poll(JobKind.FORESIGHT)  # what it has found stays there
    desk.submit(JobKind.FORESIGHT, view)


def _starter_beside(desk: ScheduledDesk, live: LiveParts) -> StartBeside:
    return StartBeside(desk, live.new_starter(), live.camera().K)
