"""The composition root: the one place that knows front ends, back end and system, and puts them together."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.backend.local_ba import bundle_adjust, bundle_adjust_arrays
from dualslam.backend.self_calibration import estimate_calibration, find_preferred_camera
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.backend.window import NumpyWindowSolver
from dualslam.calibration.lens import Calibration, CalibrationAnswer, CalibrationJob, answer
from dualslam.config.settings import AttemptConfig, Config, FrontendConfig
from dualslam.core.bundle import BundleAdjuster
from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import CorrectedCamera
from dualslam.core.camera.focal import FocalSearch, ToldFocal
from dualslam.core.errors import ConfigError
from dualslam.core.interfaces import Frontend, PreferredCamera, SelfCalibrator, SubmapGraph, WindowSolver
from dualslam.core.threads import spare_cores
from dualslam.core.types import Failure, FloatArray, Frame, IntArray
from dualslam.frontends.features.image_features import ImageFeatures
from dualslam.frontends.features.motion_statistics import nearest_search
from dualslam.frontends.frame_reader import FrameReader
from dualslam.frontends.gap.auxiliary_features import AuxiliaryFeatures, BufferedFeatures, OwnFeatures
from dualslam.frontends.gap.pnp_odometry import PnpOdometry, Route
from dualslam.frontends.gap.refinding import Refinder
from dualslam.frontends.place_matcher import FrontendPlaceMatcher
from dualslam.frontends.registry import check_frontend
from dualslam.frontends.registry import create_frontend as create_frontend  # part of the Python interface
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.frontends.tracking.rolling_shutter import RollingShutter
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.health import judge_track
from dualslam.io.map_store import StoredMap
from dualslam.lab.disturbances import FaultScript
from dualslam.map.graph_beside import BesideGraphs, GraphServer
from dualslam.map.skeleton import answer_edges
from dualslam.map.submap import Submap
from dualslam.map.tidying import tidy
from dualslam.places import FaissRecogniser, PlaceVerifier
from dualslam.places.search import search_places
from dualslam.places.sightings import PlaceParts
from dualslam.recovery.executor import DeskExecutor, InlineExecutor, RecoveryExecutor
from dualslam.recovery.job import RecoveryJob
from dualslam.recovery.linking import DescriptorMatcher, check_camera, estimate_link, propagate_to_live_end
from dualslam.recovery.linking.gates import DESCRIPTOR_RADIUS_PX
from dualslam.recovery.reverse_tracking import Attempt, RecoveryParts, walk_back
from dualslam.recovery.scale_watch import SCALE_HANDLERS
from dualslam.recovery.walk_news import WalkWatch
from dualslam.system import Components, System
from dualslam.workers.desk import Lane, WorkerDesk
from dualslam.workers.features_beside import FeaturesBeside
from dualslam.workers.jobs import Handlers, InlineDesk, JobKind
from dualslam.workers.start_beside import StartBeside, StartServer

log = logging.getLogger(__name__)

ADJUST_ITERATIONS = 20
FEATURE_THREADS = 2
"""That find other front ends' features beside a walk back, where the tracking waits for it."""
WORKER_BUDGET = 0.75
"""Share of the time after which a worker counts as hung that its walks may take: what they have by then is not lost."""


GRAPH_LIMIT_S = 30.0
"""After which the process that has the graphs counts as hung: a batch over a full submap takes a second."""
FEATURES_LIMIT_S = 10.0
"""After which the process that finds features counts as hung: networks take a second or two on a large image."""
GRAPH_NICENESS, WALK_NICENESS = 3, 8
"""Of the process that has the graphs, and of those for long work: half and a sixth of the share of what tracks,
where cores are short."""


def check_config(config: Config) -> None:
    """Refuse a config that no system can be built from, as far as it shows without extras and weights.

    Raises
    ------
    ConfigError
        If a front end, also one that an attempt at a recovery names, is not known or its options are wrong, or if the
        initialiser cannot match with it.
    """
    frontend = check_frontend(config.frontend)
    if frontend is not None and config.initialiser.matching == "gms":
        nearest_search(frontend)
    for number, attempt in enumerate(config.recovery.attempts):
        if not attempt.is_live:
            with _naming_attempt(number):
                check_frontend(_auxiliary(attempt))


def build_system(
    config: Config,
    camera: Camera,
    recovery: RecoveryExecutor | None = None,
    saved: StoredMap | None = None,
    localise: bool = False,
) -> System:
    """Build a system from its config.

    Parameters
    ----------
    config : Config
    camera : Camera
        Lens model and size of the images that `System.step` will be given.
    recovery : RecoveryExecutor, optional
        Takes the recovery jobs instead of what the config says: to look at them one by one.
    saved : StoredMap, optional
        A map to find frames in and to extend (`load_atlas`); it becomes the system's own. Its camera, as it was found
        out, is taken as known.
    localise : bool
        Find poses in the saved map, and add nothing to it.

    Returns
    -------
    System

    Raises
    ------
    ConfigError
        As `check_config`, and where an extra or weights that a front end needs are missing.
    """
    check_config(config)
    frontend = create_frontend(config.frontend)
    size_px = (camera.width, camera.height)
    known = camera if saved is None else _camera_of(saved, camera)
    is_known = saved is not None and known is saved.camera
    if is_known:  # its camera is its own: to change it would part what is there from what comes
        config = config.model_copy(update={"calibration": config.calibration.model_copy(update={"refine": False})})
    calibration = new_calibration(config, known)
    faults = FaultScript(config.corruptions)
    shutter = RollingShutter(frontend, config.camera, config.seed)

    if saved is not None and not localise:
        saved = replace(saved, poses=tidy(saved.atlas, saved.poses))
    live = LiveParts(config, frontend, calibration, size_px, 0 if saved is None else saved.next_id)
    reader = FrameReader(frontend, live.camera, config.camera.model_sigma_px, shutter)

    workers = config.recovery.workers
    if recovery is None:
        # Built here in any case: a mistake in the config is told at once, not by a worker.
        parts = recovery_parts(config, size_px, frontend=frontend)
    places = place_parts(config, frontend, size_px)
    watch = WalkWatch()
    desk = (
        worker_desk(config, size_px, faults, watch) if workers else InlineDesk(inline_handlers(config, places.verifier))
    )
    graphs = BesideGraphs(desk, window_solver(config)) if workers else None
    if recovery is None:
        recovery = DeskExecutor(desk) if workers else faults.around_inline(InlineExecutor(parts, watch))

    return System(
        Components(
            view_of=faults.around_views(reader),
            new_starter=partial(_starter_beside, desk, live) if isinstance(desk, WorkerDesk) else live.new_starter,
            new_graph=graphs.new_graph if graphs is not None else live.new_graph,
            new_odometry=faults.around_odometry(live.new_odometry),
            new_relocaliser=faults.around_odometry(live.new_relocaliser),
            calibration=calibration,
            shutter=shutter,
            recovery=recovery,
            walk_watch=watch,
            desk=desk,
            atlas_solver=atlas_solver(config),
            adjust_bundle=_adjuster(config),
            graphs=graphs,
            places=places,
            open_features=partial(_features_beside, desk, config.frontend) if isinstance(desk, WorkerDesk) else None,
        ),
        config,
        saved,
        localise,
    )


@dataclass(frozen=True, slots=True)
class LiveParts:
    """What the system makes anew with each start and each submap: the stations of a frame's walk after its features.

    `FrameReader` finds a frame's features; `Initialiser` starts a map from them; `VisualFrontEnd` poses the frames that
    follow, and extends the map by keyframes; `ISam2SubmapGraph` solves it.
    """

    config: Config
    frontend: Frontend
    calibration: Calibration
    size_px: tuple[int, int]
    first_id: int = 0
    """Number of the first frame: those before it are of the runs that have left the saved map."""

    def camera(self) -> Camera:
        """Return the camera as it is known now."""
        return self.calibration.camera

    def new_starter(self) -> Initialiser:
        """Make what collects views until two of them start a map."""
        return new_initialiser(self.config, self.frontend, self.size_px, self.camera().K)

    def new_graph(self) -> ISam2SubmapGraph:
        """Make the factor graph of a submap, solved in this process."""
        return ISam2SubmapGraph(self.config.graph)

    def new_odometry(self, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        """Make the front end that tracks frames against a submap and extends it."""
        return self._front_end(submap, graph, 0)

    def new_relocaliser(self, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        """Make one that looks in the whole submap, and not only at what is near in time."""
        return self._front_end(submap, graph, self.config.recovery.covering_keyframes)

    def _front_end(self, submap: Submap, graph: SubmapGraph, n_covering: int) -> VisualFrontEnd:
        config, frontend = self.config, self.frontend
        refinder = Refinder(submap, frontend, self.camera, config.camera.model_sigma_px)
        window = window_solver(config)
        return VisualFrontEnd(
            frontend, config, submap, graph, self.size_px, refinder, n_covering, window, self.first_id
        )


def new_initialiser(config: Config, frontend: Frontend, size_px: tuple[int, int], K: FloatArray) -> Initialiser:
    """Build what starts a map from frames with these intrinsics."""
    return Initialiser(frontend, _adjuster(config), config.initialiser, K, size_px, config.seed)


def place_parts(config: Config, frontend: Frontend, size_px: tuple[int, int]) -> PlaceParts:
    """Build what recognises places and verifies them."""
    matcher = FrontendPlaceMatcher(frontend, size_px)
    return PlaceParts(
        FaissRecogniser(frontend.max_distance_strict), PlaceVerifier(matcher, config.linking, config.seed)
    )


def _camera_of(saved: StoredMap, camera: Camera) -> Camera:
    """Return the camera that made a saved map, where it is the one that is given, perhaps corrected since.

    Where it is another one, the given: frames are not looked for in submaps of other intrinsics.
    """
    known = saved.camera or camera
    given = known.base if isinstance(known, CorrectedCamera) else known
    if given.to_dict() == camera.to_dict():
        return known
    log.warning("the saved map was made with another camera: single frames cannot be posed in it")
    return camera


def atlas_solver(config: Config) -> GtsamAtlasSolver:
    """Build what solves the graph over all submaps."""
    return GtsamAtlasSolver(config.atlas.robust, config.graph.robust_k)


def window_solver(config: Config) -> WindowSolver:
    """Build what poses new keyframes between the updates of a submap's graph."""
    return NumpyWindowSolver(config.graph.robust_k)


def self_calibrator(config: Config) -> SelfCalibrator:
    """Build what asks a submap about its camera."""
    return lambda submap, camera, covariance: estimate_calibration(
        submap, camera, config.calibration, config.graph.robust_k, config.seed, covariance
    )


def _preferred_camera(
    job: RecoveryJob, config: Config, submap: Submap, keyframe_ids: IntArray
) -> PreferredCamera | None:
    """Ask keyframes of a map that a walk has grown about the camera that it was walked with."""
    settings = (config.calibration, config.graph.robust_k, config.seed)
    return find_preferred_camera(submap, keyframe_ids, job.camera, *settings, job.camera_covariance)


def new_calibration(config: Config, camera: Camera, covariance: FloatArray | None = None) -> Calibration:
    """Build what knows the camera; `covariance`: of the correction that it has, if it was estimated."""
    return Calibration(
        camera,
        config.calibration,
        estimate=self_calibrator(config),
        adjust=lambda submap: adjust_submap(submap, config.graph.robust_k),
        covariance=covariance,
    )


def calibration_handlers(config: Config) -> Handlers:
    """Build what answers questions about the camera."""

    def answered(job: CalibrationJob) -> CalibrationAnswer | Failure:
        calibration = new_calibration(config, job.camera, job.covariance)
        return answer(job, calibration, lambda: ISam2SubmapGraph(config.graph))

    return {JobKind.CALIBRATION: answered}


def place_handlers(verifier: PlaceVerifier) -> Handlers:
    """Build what verifies places."""
    return {JobKind.LOOP: lambda search: search_places(search, verifier)}


def edge_handlers(config: Config) -> Handlers:
    """Build what gives covariances of edges within submaps."""
    solver = atlas_solver(config)
    return {JobKind.EDGES: lambda question: answer_edges(question, solver.edge_covariances)}


def inline_handlers(config: Config, verifier: PlaceVerifier) -> Handlers:
    """Build what is done at once where there are no workers; walks back have an executor of their own."""
    return {**edge_handlers(config), **SCALE_HANDLERS, **calibration_handlers(config), **place_handlers(verifier)}


def graph_handlers(config: Config) -> Handlers:
    """Build what keeps and solves the graphs of submaps."""
    return {JobKind.GRAPH: GraphServer(lambda: ISam2SubmapGraph(config.graph))}


def map_handlers(config: Config, size_px: tuple[int, int]) -> Handlers:
    """Build what the worker for the live map does: it looks for its start, and has its graph from then on."""
    frontend = create_frontend(config.frontend)
    return {
        JobKind.START: StartServer(partial(new_initialiser, config, frontend, size_px)),
        **graph_handlers(config),
    }


def walk_handlers(config: Config, size_px: tuple[int, int], n_threads: int) -> Handlers:
    """Build what a worker for long work does: walks back, calibrations, the search for places, and for the atlas."""
    budget_s = WORKER_BUDGET * config.recovery.time_limit_s
    frontend = create_frontend(config.frontend)
    parts = recovery_parts(config, size_px, budget_s, frontend, n_threads)
    verifier = place_parts(config, frontend, size_px).verifier
    return {
        JobKind.WALK: lambda job: walk_back(job, parts),
        **edge_handlers(config),
        **SCALE_HANDLERS,
        **calibration_handlers(config),
        **place_handlers(verifier),
    }


def feature_handlers(config: FrontendConfig) -> Handlers:
    """Build what the worker for features does: it finds those of one image after the other."""
    return {JobKind.FEATURES: create_frontend(config).extract}


def worker_desk(config: Config, size_px: tuple[int, int], faults: FaultScript, watch: WalkWatch) -> WorkerDesk:
    """Build the desk whose work is done in processes, which are started at once."""
    recovery = config.recovery
    # Live frames come first: threads beside the walk only where a core is left beside the tracking and the workers.
    n_threads = min(FEATURE_THREADS, spare_cores(1 + recovery.workers))
    walks = Lane(
        "walks",
        (JobKind.EDGES, JobKind.SCALE, JobKind.CALIBRATION, JobKind.LOOP, JobKind.WALK),
        partial(walk_handlers, config, size_px, n_threads),
        recovery.workers,
        recovery.time_limit_s,
        niceness=WALK_NICENESS,
    )
    live_map = Lane(
        "map",
        (JobKind.START, JobKind.GRAPH),
        partial(map_handlers, config, size_px),
        1,
        GRAPH_LIMIT_S,
        niceness=GRAPH_NICENESS,
    )
    return WorkerDesk([live_map, walks], recovery.finish_wait_s, faults.kill_worker, watch)


def _starter_beside(desk: WorkerDesk, live: LiveParts) -> StartBeside:
    return StartBeside(desk, live.new_starter(), live.camera().K)


def _features_beside(desk: WorkerDesk, config: FrontendConfig) -> FeaturesBeside:
    desk.open(Lane("features", (JobKind.FEATURES,), partial(feature_handlers, config), 1, FEATURES_LIMIT_S))
    return FeaturesBeside(desk)


def find_focal(
    config: Config, frames: Iterable[Frame], size_px: tuple[int, int], told: ToldFocal | None = None
) -> FocalSearch | Failure:
    """Search for the focal length of a camera that has no calibration, by frames from its beginning.

    `told`: what the source's own data tell, if they do.

    Raises
    ------
    ConfigError
        If the front end is not known, or its options are wrong.
    """
    from dualslam.frontends.tracking.focal_search import search_focal  # an optimiser that no other run needs

    frontend = create_frontend(config.frontend)
    features = [frontend.extract(frame.image) for frame in frames if frame.image is not None]
    return search_focal(frontend, features, size_px, config.seed, told)


def recovery_parts(
    config: Config,
    size_px: tuple[int, int],
    budget_s: float | None = None,
    frontend: Frontend | None = None,
    n_threads: int = FEATURE_THREADS,
) -> RecoveryParts:
    """Build what a walk back in time is made of, for images of this width and height; see `RecoveryParts.budget_s`.

    `frontend`: the live one, where this process has it already: it may hold networks. `n_threads`: that find other
    front ends' features beside the walk; the results do not depend on it.

    Raises
    ------
    ConfigError
        If a front end that an attempt names is not known, or its options are wrong.
    """
    frontend = frontend or create_frontend(config.frontend)

    def live(job: RecoveryJob, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        refinder = Refinder(submap, frontend, lambda: job.camera, config.camera.model_sigma_px)
        for view in sorted(job.own, key=lambda view: view.index, reverse=True):  # those next to the walk stay
            refinder.remember(view)
        n_covering = 0 if job.lost else config.recovery.covering_keyframes
        return VisualFrontEnd(frontend, config, submap, graph, size_px, refinder, n_covering, window_solver(config))

    matcher = DescriptorMatcher(frontend.distance, frontend.max_distance, DESCRIPTOR_RADIUS_PX)
    return RecoveryParts(
        attempts=_attempts(config, frontend, live, size_px, n_threads),
        posing=Attempt("live", live),
        new_graph=lambda: ISam2SubmapGraph(config.graph),
        link=lambda old, new, onset: estimate_link(
            old, new, config.linking, np.random.default_rng(config.seed), onset, matcher
        ),
        max_scale_sigma=config.linking.max_live_scale_sigma,
        propagate=lambda link, new, newest_id, bend: propagate_to_live_end(link, new, newest_id, config.linking, bend),
        check_camera=lambda submap, link, job: check_camera(
            submap, link, job.newest_id, partial(_preferred_camera, job, config), config.linking, config.calibration
        ),
        judge=lambda track: judge_track(track, config.health),
        config=config.recovery,
        fusion=config.fusion,
        budget_s=budget_s,
    )


def _attempts(
    config: Config,
    frontend: Frontend,
    live: Callable[[RecoveryJob, Submap, SubmapGraph], VisualFrontEnd],
    size_px: tuple[int, int],
    n_threads: int,
) -> tuple[Attempt, ...]:
    """Build the attempts; those with the same auxiliary front end share what it finds in the images."""
    auxiliaries: dict[str, ImageFeatures] = {}  # by their settings
    attempts = []
    for number, attempt in enumerate(config.recovery.attempts):
        if attempt.is_live:
            attempts.append(_attempt_by(frontend, lambda camera: OwnFeatures(), attempt, config, live, size_px))
            continue
        wanted = _auxiliary(attempt)
        key = wanted.model_dump_json()
        if key not in auxiliaries:
            with _naming_attempt(number):
                auxiliaries[key] = ImageFeatures(create_frontend(wanted), n_threads)
        features_for = partial(BufferedFeatures, auxiliaries[key], config.camera.model_sigma_px)
        attempts.append(_attempt_by(auxiliaries[key].frontend, features_for, attempt, config, live, size_px))
    return tuple(attempts)


def _attempt_by(
    auxiliary: Frontend,
    features_for: Callable[[Camera], AuxiliaryFeatures],
    attempt: AttemptConfig,
    config: Config,
    live: Callable[[RecoveryJob, Submap, SubmapGraph], VisualFrontEnd],
    size_px: tuple[int, int],
) -> Attempt:
    """Build an attempt in which a front end, which may be the live one itself, gives the live one its poses."""
    tracks_live = attempt.is_live or attempt.tracking == "live"

    def new_odometry(job: RecoveryJob, submap: Submap, graph: SubmapGraph) -> PnpOdometry:
        reverse_tracker, features = live(job, submap, graph), features_for(job.camera)
        overlap_id = max((k for lost in job.lost.values() for k in lost.keyframes), default=job.newest_id)
        route = Route(job.own, job.views, overlap_id)
        return PnpOdometry(reverse_tracker, auxiliary, features, route, _adjuster(config), config, size_px, tracks_live)

    return Attempt(attempt.name, new_odometry)


def _auxiliary(attempt: AttemptConfig) -> FrontendConfig:
    return FrontendConfig(name=attempt.frontend, n_features=attempt.n_features, options=attempt.options)


@contextmanager
def _naming_attempt(number: int) -> Iterator[None]:
    """Say of a mistake in the config that it is in this attempt."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"recovery.attempts[{number}]: {error}") from error


def _adjuster(config: Config) -> BundleAdjuster:
    """Batch bundle adjustment under the robust kernel of the graphs that its results go into."""
    return partial(bundle_adjust_arrays, robust_k=config.graph.robust_k)


def adjust_submap(submap: Submap, robust_k: float) -> None:
    """Refine all of a submap in batch."""
    keyframe_ids = list(submap.keyframes)
    bundle = bundle_adjust(submap, keyframe_ids[1:], keyframe_ids[:1], robust_k, ADJUST_ITERATIONS)
    submap.apply_estimate(*bundle.estimate)
