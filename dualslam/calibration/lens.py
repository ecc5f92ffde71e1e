"""The camera as it is known now: when a submap is asked about it, what changes with the answer, and what must wait."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualslam.config.calibration_config import CalibrationConfig
from dualslam.core.camera.corrected import correct
from dualslam.core.camera.models import Camera
from dualslam.core.errors import InputError, SolverError
from dualslam.core.interfaces import SelfCalibrator, SubmapAdjuster, SubmapGraph
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, View
from dualslam.map.submap import Submap

RETRY_KEYFRAMES, RETRY_SHARE = 10, 0.25
"""Where the motion said nothing yet, a submap is asked again after so many more keyframes, or this share more."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A submap's change to a better calibration.

    Attributes
    ----------
    graph : SubmapGraph
        Made from the changed submap.
    before : Submap
        A copy of the submap as it was.
    numbers : dict
        For the event log.
    """

    graph: SubmapGraph
    before: Submap
    numbers: dict[str, float]


class Calibration:
    """The camera that features are rectified by, from the one that was given to the best one known.

    Parameters
    ----------
    camera : Camera
        As it was given.
    config : CalibrationConfig
    estimate : SelfCalibrator
    adjust : SubmapAdjuster
    """

    def __init__(
        self, camera: Camera, config: CalibrationConfig, estimate: SelfCalibrator, adjust: SubmapAdjuster
    ) -> None:
        self._camera = camera
        self._config = config
        self._estimate = estimate
        self._adjust = adjust
        self._due_at: dict[int, int] = {}
        self._refined_in: int | None = None
        self._covariance: FloatArray | None = None  # (5, 5), of the correction that the camera holds

    @property
    def camera(self) -> Camera:
        """The camera that the frames to come are rectified by."""
        return self._camera

    @property
    def covariance(self) -> FloatArray | None:
        """(5, 5) of the correction that it has; none where it is as it was given."""
        return self._covariance

    def is_due(self, submap: Submap) -> bool:
        """Whether it is time to ask this submap."""
        if self._refined_in not in (None, submap.id):
            return False  # what a longer submap said of the lens is not put at risk by a shorter one
        due_at = self._due_at.get(submap.id, self._config.first_keyframes)
        return self._config.refine and len(submap.keyframes) >= due_at

    def refine(self, submap: Submap, graph: SubmapGraph) -> Refinement | Failure:
        """Ask a submap about its camera and, where the answer is clear, change the submap to it.

        Parameters
        ----------
        submap : Submap
            Keeps its ids. Only where the whole change succeeds, it gets other intrinsics, pixels, poses and points.
        graph : SubmapGraph
            A new one, for the changed submap.
        """
        n = len(submap.keyframes)
        self._due_at[submap.id] = int(np.ceil(self._config.growth * n))
        estimate = self._estimate(submap, self._camera, self._covariance)
        if isinstance(estimate, Failure):
            if estimate.reason is FailureReason.DEGENERATE:
                self._due_at[submap.id] = n + max(RETRY_KEYFRAMES, int(RETRY_SHARE * n))
            return estimate
        numbers = estimate.numbers
        if not estimate.accepted and not self._is_much_surer(estimate.covariance):
            return Failure(FailureReason.CHI_SQUARE, "no significant change", numbers)
        try:
            camera = correct(self._camera, estimate.correction)
            before = self._change(submap, camera, graph)
        except (InputError, SolverError) as error:
            return Failure(FailureReason.SOLVER, str(error), numbers)
        self._camera, self._refined_in, self._covariance = camera, submap.id, estimate.covariance
        return Refinement(graph, before, numbers)

    def update(self, submap: Submap, graph: SubmapGraph) -> Submap | Failure:
        """Change a submap that an earlier camera made to the present one; return a copy of it as it was.

        It was the same lens: what a longer map says of it is true of this one too. Two maps of different cameras have
        different shapes, and would not be linked.
        """
        try:
            return self._change(submap, self._camera, graph)
        except (InputError, SolverError) as error:
            return Failure(FailureReason.SOLVER, str(error))

    def _change(self, submap: Submap, camera: Camera, graph: SubmapGraph) -> Submap:
        changed = submap.copy()
        _change_camera(changed, camera)
        self._adjust(changed)
        solved = graph.rebuild(changed)
        changed.apply_estimate(*solved.values)
        before = submap.copy()
        submap.take_over(changed)
        return before

    def _is_much_surer(self, covariance: FloatArray) -> bool:
        """Whether an answer is worth a change that is not significant: only where the present one was hardly sure."""
        if self._covariance is None:
            return False
        config, present, found = self._config, *(float(np.sqrt(C[0, 0])) for C in (self._covariance, covariance))
        hardly_sure = present > config.max_sigma_ratio * config.log_focal_sigma
        return hardly_sure and found < config.update_sigma_ratio * present

    def rectified(self, view: View) -> View:
        """Return a view with the pixels of the present camera; features without a place there keep their old one."""
        features = view.features
        uv_rect_px, _ = self._camera.rectify(features.uv_px)
        lost = ~np.isfinite(uv_rect_px).all(axis=1)
        uv_rect_px[lost] = features.uv_rect_px[lost]
        return replace(view, features=replace(features, uv_rect_px=uv_rect_px))


def _rectified_again(features: Features, camera: Camera) -> Features:
    """Return features with their pixels under another camera. None is dropped (observations name them by their row),
    and sigmas stay: a correction changes them by a few per cent.
    """
    uv_rect_px, _ = camera.rectify(features.uv_px)
    lost = ~np.isfinite(uv_rect_px).all(axis=1)
    if lost.any():
        raise InputError(f"camera: {int(lost.sum())} features have no place in the corrected image")
    return replace(features, uv_rect_px=uv_rect_px)


def _change_camera(submap: Submap, camera: Camera) -> None:
    submap.K = camera.K
    submap.relative_poses = {}  # they were measured with the camera of before
    for k, keyframe in submap.keyframes.items():
        submap.keyframes[k] = replace(keyframe, features=_rectified_again(keyframe.features, camera))
