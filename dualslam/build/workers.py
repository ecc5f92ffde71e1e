"""Background work, at once or in processes, and its lanes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from dualslam.atlas.beside import atlas_handlers
from dualslam.build.parts import atlas_solver, graph_maker, new_calibration, new_initialiser, place_parts
from dualslam.build.walks import FEATURE_THREADS, recovery_parts
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config, FrontendConfig
from dualslam.core.interfaces import SubmapGraph
from dualslam.core.jobs import Handler, Handlers, JobKind
from dualslam.core.resources import spare_cores
from dualslam.core.types import Failure, Frame
from dualslam.core.walk_news import WalkWatch
from dualslam.frontends.registry import create_frontend
from dualslam.frontends.tracking.map_readout import answer_readout
from dualslam.lab.disturbances import FaultScript
from dualslam.map.graph_beside import GraphServer
from dualslam.map.lens import CalibrationAnswer, CalibrationJob, answer
from dualslam.places import PlaceVerifier
from dualslam.places.recogniser import search_places
from dualslam.recovery.job import RecoveryParts
from dualslam.recovery.reverse_tracking import recover_in_steps
from dualslam.recovery.scale_watch import SCALE_HANDLERS
from dualslam.workers.desk import Lane, WorkerDesk
from dualslam.workers.start_beside import FeaturesBeside, StartServer

WORKER_BUDGET = 0.75
"""Share of the time after which a worker counts as hung that its walks may take: what they have by then is not lost."""
WALK_LIMIT_S = 120.0
"""After which a worker counts as hung, and its recovery as failed. A walk over a full buffer of 10 s takes a tenth."""
JOB_LIMIT_S = 30.0
"""After which a process for graphs or features counts as hung: a full submap or a large image takes a second or two."""
MAP_KINDS = (JobKind.START, JobKind.GRAPH)
"""Jobs of the live map's worker, in order. It keeps a state from job to job."""
GRAPH_NICENESS, WALK_NICENESS = 3, 8
"""Of the process that has the graphs, and of long work: half and a sixth of tracking's share of short cores."""


def inline_handlers(
    config: Config, parts: RecoveryParts, verifier: PlaceVerifier, new_graph: Callable[[], SubmapGraph]
) -> dict[JobKind, Handler]:
    """Build what does the long work: reverse tracking, questions about the camera, the search for places, the atlas."""

    def answered(job: CalibrationJob) -> CalibrationAnswer | Failure:
        return answer(job, new_calibration(config, job.camera, job.covariance), new_graph)

    return {
        JobKind.WALK: lambda job: recover_in_steps(job, parts),
        JobKind.READOUT: answer_readout,
        JobKind.CALIBRATION: answered,
        JobKind.LOOP: lambda search: search_places(search, verifier),
        **atlas_handlers(atlas_solver(config)),
        **SCALE_HANDLERS,
    }


def map_handlers(config: Config, size_px: tuple[int, int]) -> dict[JobKind, Handler]:
    """Build what the worker for the live map does: it looks for its start, and has its graph from then on."""
    frontend = create_frontend(config.frontend)
    return {
        JobKind.START: StartServer(partial(new_initialiser, config, frontend, size_px)),
        JobKind.GRAPH: GraphServer(graph_maker(config)),
    }


def walk_handlers(config: Config, camera: Camera, n_threads: int) -> Handlers:
    """Build what a worker for long work does."""
    frontend = create_frontend(config.frontend)
    parts = recovery_parts(config, camera, frontend, n_threads)
    verifier = place_parts(config, frontend, camera).verifier
    return {JobKind.FORESIGHT: parts.foresee, **inline_handlers(config, parts, verifier, graph_maker(config))}


def feature_handlers(config: FrontendConfig) -> Handlers:
    """Build what the worker for features does: it finds those of one image after the other."""
    return {JobKind.FEATURES: create_frontend(config).extract}


def worker_desk(config: Config, camera: Camera, faults: FaultScript, watch: WalkWatch) -> WorkerDesk:
    """Build the desk whose work is done in processes, which are started at once."""
    recovery = config.recovery
    # Live frames come first: reverse tracking gets threads only if tracking and workers leave a core.
    n_threads = min(FEATURE_THREADS, spare_cores(1 + recovery.workers))
    walks = Lane(
        "walks",
        (
            JobKind.EDGES,
            JobKind.ATLAS,
            JobKind.SCALE,
            JobKind.READOUT,
            JobKind.CALIBRATION,
            JobKind.LOOP,
            JobKind.WALK,
            JobKind.FORESIGHT,
        ),
        partial(walk_handlers, config, camera, n_threads),
        recovery.workers,
        WALK_LIMIT_S,
        niceness=WALK_NICENESS,
    )
    live_map = Lane(
        "map", MAP_KINDS, partial(map_handlers, config, camera.size_px), 1, JOB_LIMIT_S, niceness=GRAPH_NICENESS
    )
    return WorkerDesk([live_map, walks], recovery.finish_wait_s, faults.kill_worker, watch)


def features_beside(desk: WorkerDesk, config: FrontendConfig, painted: Callable[[Frame], Frame]) -> FeaturesBeside:
    """Start the process that finds the features of the frame to come."""
    desk.open(Lane("features", (JobKind.FEATURES,), partial(feature_handlers, config), 1, JOB_LIMIT_S))
    return FeaturesBeside(desk, painted)
