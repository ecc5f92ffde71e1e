"""Solvers, calibration and the parts that look at features, each made from the config."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from dualslam.atlas.edge_covariances import Covariances
from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.backend.local_ba import bundle_adjust, bundle_adjust_arrays
from dualslam.backend.self_calibration import estimate_calibration
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.backend.window import NumpyWindowSolver
from dualslam.core.bundle import BundleAdjuster
from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import FocalSearch, ToldFocal
from dualslam.core.config.settings import Config
from dualslam.core.estimates import FrontendChoice
from dualslam.core.interfaces import Frontend, SelfCalibrator, WindowSolver
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, MetricSolution, RowSource
from dualslam.core.types import Failure, FloatArray, Frame
from dualslam.frontends.choice import Candidate, choose_frontend
from dualslam.frontends.features.images import features_of
from dualslam.frontends.frame_reader import view_of
from dualslam.frontends.registry import create_frontend
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.frontends.tracking.local_map import look
from dualslam.map.lens import Calibration
from dualslam.map.submap import Submap
from dualslam.places import FaissRecogniser, PlaceVerifier
from dualslam.places.sightings import PlaceParts

ADJUST_ITERATIONS = 20
CORNERS_AND_BLOBS = ("orb", "sift")
"""Front ends that `frontend.name: auto` chooses from."""


def graph_maker(config: Config) -> Callable[[], ISam2SubmapGraph]:
    """Build what makes the factor graph of a submap, each time anew."""
    return partial(ISam2SubmapGraph, config.graph)


def new_initialiser(config: Config, frontend: Frontend, size_px: tuple[int, int], K: FloatArray) -> Initialiser:
    """Build what starts a map from frames with these intrinsics."""
    return Initialiser(frontend, bundle_adjuster(config), config.initialiser, K, size_px, config.seed)


def place_parts(config: Config, frontend: Frontend, camera: Camera) -> PlaceParts:
    """Build what recognises places and verifies them; `camera`: as it was given."""
    return PlaceParts(
        FaissRecogniser(frontend.distance, frontend.max_distance_strict),
        PlaceVerifier(frontend, partial(look, frontend, camera), config.linking, config.seed),
    )


def atlas_solver(config: Config) -> GtsamAtlasSolver:
    """Build what solves the graph over all submaps."""
    return GtsamAtlasSolver(config.atlas.robust, config.graph.robust_k)


@dataclass(frozen=True, slots=True)
class MetricParts:
    """The parts that put a map into the frame of measurements."""

    covariances: Covariances  # a submap's word on its edges
    solve: Callable[[MetricProblem, Sequence[MeasurementSource], Mapping[str, float] | None], MetricSolution]
    """`dualslam.backend.measurements.solve.solve_metric`."""


def metric_parts(config: Config) -> MetricParts:
    """Build what puts a map into the frame of measurements."""
    from dualslam.backend.measurements.solve import solve_metric

    return MetricParts(atlas_solver(config).edge_covariances, solve_metric)


def measurement_sources(rows: Iterable[RowSource]) -> list[MeasurementSource]:
    """Make readings of files' lines.

    Raises `InputError`: naming the line.
    """
    from dualslam.backend.measurements.registry import readings_of

    return [readings_of(source) for source in rows]


def window_solver(config: Config) -> WindowSolver:
    """Build what poses new keyframes between the updates of a submap's graph."""
    return NumpyWindowSolver(config.graph.robust_k)


def self_calibrator(config: Config) -> SelfCalibrator:
    """Build what asks a submap about its camera."""
    return lambda submap, camera, covariance: estimate_calibration(
        submap, camera, config.calibration, config.graph.robust_k, config.seed, covariance
    )


def new_calibration(config: Config, camera: Camera, covariance: FloatArray | None = None) -> Calibration:
    """Build what knows the camera; `covariance`: of the correction that it has, if it was estimated."""
    return Calibration(
        camera,
        config.calibration,
        estimate=self_calibrator(config),
        adjust=lambda submap: adjust_submap(submap, config.graph.robust_k),
        covariance=covariance,
    )


def find_focal(
    config: Config, frames: Iterable[Frame], size_px: tuple[int, int], told: ToldFocal | None = None
) -> FocalSearch | Failure:
    """Search for the focal length of a camera that has no calibration, by frames from its beginning.

    `told`: the focal length in the source's own data, if any.

    Raises `ConfigError` if the front end is not known, or its options are wrong.
    """
    from dualslam.frontends.tracking.focal_search import search_focal  # an optimiser that no other run needs

    frontend = create_frontend(config.frontend)
    features = [features_of(frontend, frame.image) for frame in frames if frame.image is not None]
    return search_focal(frontend, features, size_px, config.seed, told)


def find_frontend(config: Config, frames: Iterable[Frame], camera: Camera) -> FrontendChoice:
    """Choose between ORB and SIFT by frames from a sequence's beginning (`frontend.name: auto`)."""

    def candidate(name: str) -> Candidate:
        frontend = create_frontend(config.frontend.model_copy(update={"name": name}))
        starter = new_initialiser(config, frontend, camera.size_px, camera.K)
        seen = partial(view_of, frontend=frontend, camera=camera, model_sigma_px=config.camera.model_sigma_px)
        return Candidate(frontend, starter, seen)

    corners, blobs = (candidate(name) for name in CORNERS_AND_BLOBS)
    return choose_frontend(frames, corners, blobs, config.frontend.n_features)


def bundle_adjuster(config: Config) -> BundleAdjuster:
    """Batch bundle adjustment under the robust kernel of the graphs that its results go into."""
    return partial(bundle_adjust_arrays, robust_k=config.graph.robust_k)


def adjust_submap(submap: Submap, robust_k: float) -> None:
    """Refine all of a submap in batch."""
    keyframe_ids = list(submap.keyframes)
    bundle = bundle_adjust(submap, keyframe_ids[1:], keyframe_ids[:1], robust_k, ADJUST_ITERATIONS)
    submap.apply_estimate(*bundle.estimate)
