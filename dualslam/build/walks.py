"""Construction of reverse tracking: the live front end, and the attempts by others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

from dualslam.backend.self_calibration import find_preferred_camera
from dualslam.build.checks import auxiliary_config, naming_attempt
from dualslam.build.parts import bundle_adjuster, graph_maker, window_solver
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import AttemptConfig, Config, FrontendConfig
from dualslam.core.errors import ConfigError
from dualslam.core.estimates import PreferredCamera
from dualslam.core.interfaces import Frontend, SubmapGraph
from dualslam.core.noise_model import SAME_POINT_PX
from dualslam.core.types import Failure, FailureReason, Frame, IntArray, LateFrame, View
from dualslam.frontends.features.image_features import ImageFeatures
from dualslam.frontends.frame_reader import view_of
from dualslam.frontends.gap.auxiliary_map import Auxiliary, BufferedFeatures, OwnFeatures
from dualslam.frontends.gap.pnp_odometry import PnpOdometry, Route, find_lack
from dualslam.frontends.gap.refinding import Refinder
from dualslam.frontends.registry import FOR_WALKS, create_frontend, find_missing
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.linking import DescriptorMatcher
from dualslam.map.submap import Submap
from dualslam.recovery.job import Attempt, RecoveryJob, RecoveryParts

MAX_UNRECOGNISED = 5
"""An attempt by other features alone, after another one, ends at so many frames in a row that show something and are
not recognised. That one has tried to cross the gap. This one follows from frame to frame what the live
features have lost: its crossings of 9 and 14 such frames lost the scale, for seven times the cost a frame."""
FEATURE_THREADS = 2
"""That find other front ends' features beside reverse tracking, where the tracking waits for it."""


def recovery_parts(
    config: Config,
    camera: Camera,
    frontend: Frontend | None = None,
    n_threads: int = FEATURE_THREADS,
    new_graph: Callable[[], SubmapGraph] | None = None,
) -> RecoveryParts:
    """Build what reverse tracking is made of, for a camera as it was given.

    `frontend`: the live one, where this process has it already: it may hold networks. `n_threads`: that find other
    front ends' features beside the walk; the results do not depend on it. `new_graph`: instead of `ISam2SubmapGraph`.

    Raises `ConfigError` if a front end that an attempt names is not known, or its options are wrong.
    """
    frontend = frontend or create_frontend(config.frontend)

    def live(job: RecoveryJob, submap: Submap, graph: SubmapGraph) -> VisualFrontEnd:
        refinder = Refinder(submap, frontend, lambda: job.camera, config.camera.model_sigma_px)
        for view in sorted(job.own, key=lambda view: view.index, reverse=True):  # those next to the walk stay
            refinder.remember(view)
        window, everywhere = window_solver(config), not job.lost
        return VisualFrontEnd(
            frontend, config, submap, graph, camera, refinder=refinder, looks_everywhere=everywhere, window=window
        )

    auxiliaries = _auxiliaries(config, n_threads)

    def foresee(view: View) -> None:
        images = next((each.images for each in auxiliaries.values() if each.is_built), None)
        if images is not None and view.image is not None and find_lack(view, config.tracking.min_inliers) is None:
            images.of(view.image)

    def find_camera(job: RecoveryJob, submap: Submap, keyframe_ids: IntArray) -> PreferredCamera | None:
        settings = (config.calibration, config.graph.robust_k, config.seed)
        return find_preferred_camera(submap, keyframe_ids, job.camera, *settings, job.camera_covariance)

    def read(frame: LateFrame, camera: Camera) -> View | Failure:
        taken = Frame(frame.index, frame.timestamp_s, frame.image.pixels())
        return view_of(taken, frontend, camera, config.camera.model_sigma_px)

    return RecoveryParts(
        attempts=_attempts(config, frontend, live, camera, auxiliaries),
        posing=Attempt("live", live),
        new_graph=new_graph or graph_maker(config),
        matcher=DescriptorMatcher(frontend.distance, frontend.max_distance, SAME_POINT_PX),
        find_camera=find_camera,
        config=config,
        read=read,
        foresee=foresee,
    )


class _ImagesOf:
    """Another front end's features of buffered images. The front end is built when it is first needed."""

    def __init__(self, wanted: FrontendConfig, n_threads: int) -> None:
        self._wanted = wanted
        self._n_threads = n_threads

    @property
    def is_built(self) -> bool:
        """Whether the front end is there."""
        return "images" in self.__dict__

    @cached_property
    def images(self) -> ImageFeatures:
        """Build the front end."""
        return ImageFeatures(create_frontend(self._wanted, FOR_WALKS), self._n_threads)

    def find_lack(self) -> Failure | None:
        """Return why the front end cannot be built here."""
        missing = find_missing(self._wanted.name)
        if missing is not None:
            return Failure(FailureReason.NOT_INSTALLED, missing)
        try:
            self.images  # noqa: B018
        except ConfigError as error:
            return Failure(FailureReason.NOT_INSTALLED, error.problem)
        return None


def _auxiliaries(config: Config, n_threads: int) -> dict[str, _ImagesOf]:
    """Return the front ends of the attempts by their settings, which share features; those may be built when needed."""
    auxiliaries: dict[str, _ImagesOf] = {}
    for number, attempt in enumerate(config.recovery.attempts):
        if attempt.is_live:
            continue
        wanted = auxiliary_config(attempt)
        images = auxiliaries.setdefault(wanted.model_dump_json(), _ImagesOf(wanted, n_threads))
        if not attempt.if_installed:
            with naming_attempt(number):
                images.images  # noqa: B018
    return auxiliaries


def _attempts(
    config: Config,
    frontend: Frontend,
    live: Callable[[RecoveryJob, Submap, SubmapGraph], VisualFrontEnd],
    camera: Camera,
    auxiliaries: dict[str, _ImagesOf],
) -> tuple[Attempt, ...]:
    """Build the attempts: front ends, of which the live one may be one, give the live one its poses."""
    own = Auxiliary(frontend, OwnFeatures())

    def build(number: int, attempt: AttemptConfig) -> Attempt:
        tracks_live = attempt.is_live or attempt.tracking == "live"
        others = None if attempt.is_live else auxiliaries[auxiliary_config(attempt).model_dump_json()]

        def new_odometry(job: RecoveryJob, submap: Submap, graph: SubmapGraph) -> PnpOdometry:
            asked = [own] if tracks_live else []
            if others is not None:
                buffered = BufferedFeatures(others.images, config.camera.model_sigma_px, job.camera)
                asked.append(Auxiliary(others.images.frontend, buffered))
            return PnpOdometry(
                live(job, submap, graph),
                asked,
                Route(job.own, job.views),
                bundle_adjuster(config),
                config,
                camera,
                tracks_live,
                notes_rivals=job.notes_rivals,
                expected=job.expected,
            )

        max_unrecognised = None if number == 0 or tracks_live else MAX_UNRECOGNISED
        made = Attempt(attempt.name, new_odometry, max_unrecognised=max_unrecognised)
        return made if others is None or not attempt.if_installed else replace(made, find_lack=others.find_lack)

    return tuple(build(number, attempt) for number, attempt in enumerate(config.recovery.attempts))
