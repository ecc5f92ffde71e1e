"""The camera as it is known now: when a submap estimates it, what a new estimate changes, and what must wait.

Asking takes up to seconds, so it is a job on a snapshot (`CalibrationJob`), done by `answer` in any process. The submap
has grown when the answer comes (`dualslam/system/camera/background.py`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import correct
from dualslam.core.config.settings import CalibrationConfig
from dualslam.core.errors import InputError, SolverError
from dualslam.core.estimates import MAX_PATH_CHANGE, CalibrationEstimate
from dualslam.core.interfaces import SelfCalibrator, SubmapAdjuster, SubmapGraph
from dualslam.core.noise_model import GROWN
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, Keyframe, View
from dualslam.map.submap import Submap

UPDATE_SIGMA_RATIO = 0.7
"""A camera may have been changed by an answer less sure than `max_focal_sigma`. It is changed again, however little, if
the new sigma of the focal length is below this share of that answer's: twice the information. One that was sure stays,
until another is significantly different, or all maps of the run answer together."""
AT_LOSS = 1.05
"""A map that may be at its end is asked once more, where it has so many times the keyframes of when it was asked: the
next one begins with what it says. Lower, single frames without a pose would each cost a question."""
FEWEST_KEYFRAMES = 10
"""Of a map that is asked before it is old enough: since the run ends, or since a lost map waits to be joined to it."""
SURE_SIGMA = 0.01
"""Of the log focal length: an answer that is no surer than this is not the last, however little was known before."""

log = logging.getLogger(__name__)

RETRY_KEYFRAMES, RETRY_SHARE = 10, 0.25
"""Where the motion said nothing yet, a submap is asked again after so many more keyframes, or this share more."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationJob:
    """A question about the camera, with all that the answer is made from. It can be pickled."""

    submap: Submap  # the one that is asked, a copy
    lost: dict[int, Submap]  # copies of those that are to change with it
    camera: Camera  # the present one, which rectified their features
    covariance: FloatArray | None  # (5, 5): of the correction that it has, if it was estimated


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationAnswer:
    """A submap's estimate of its camera, and the effect on the maps."""

    camera: Camera
    covariance: FloatArray  # (5, 5)
    submap: Submap  # the job's, changed to that camera and adjusted
    lost: dict[int, Submap]  # those of the job's that could be changed, solved
    numbers: dict[str, float]  # for the event log


class Calibration:
    """The camera that features are rectified by, from the one that was given to the best one known.

    - `camera`: as it was given.
    - `covariance` (5, 5): of the correction that the camera has, if it was estimated.
    """

    def __init__(
        self,
        camera: Camera,
        config: CalibrationConfig,
        estimate: SelfCalibrator,
        adjust: SubmapAdjuster,
        covariance: FloatArray | None = None,
    ) -> None:
        self._camera = camera
        self._config = config
        self._estimate = estimate
        self._adjust = adjust
        self._due_at: dict[int, int] = {}
        self._asked_with: dict[int, int] = {}
        self._refined_in: int | None = None
        self._covariance = covariance
        self._is_confirmed = False
        self._path_change = 0.0  # by the last answer that was not taken
        self._estimated: set[int] = set()  # the submaps that have said something of the camera

    @property
    def camera(self) -> Camera:
        """The camera that the frames to come are rectified by."""
        return self._camera

    @property
    def covariance(self) -> FloatArray | None:
        """(5, 5) of the correction that it has; none where it is as it was given."""
        return self._covariance

    @property
    def log_focal_sigma(self) -> float | None:
        """Standard deviation of the logarithm of its focal length; None where it is as it was given."""
        return None if self._covariance is None else float(np.sqrt(self._covariance[0, 0]))

    def is_due(self, submap: Submap, is_waited_for: bool = False) -> bool:
        """Whether it is time to ask this submap.

        `is_waited_for`: a lost map waits to be joined to it, which no similarity does under a wrong camera. Then it is
        asked as soon as it may answer.
        """
        if self._is_confirmed or self._refined_in not in (None, submap.id):
            return False  # what a longer submap said of the lens is not put at risk by a shorter one
        first = FEWEST_KEYFRAMES if is_waited_for else self._config.first_keyframes
        return self._config.refine and len(submap.keyframes) >= self._due_at.get(submap.id, first)

    def is_due_at_loss(self, submap: Submap) -> bool:
        """Whether it is time to ask a submap that may be at its end: as long as none has estimated the camera."""
        n, config = len(submap.keyframes), self._config
        has_grown = n >= AT_LOSS * self._asked_with.get(submap.id, 0)
        return config.refine and self._refined_in is None and n >= config.first_keyframes and has_grown

    @property
    def is_refuted(self) -> bool:
        """Whether the images have refuted the given camera: it was changed, or is to blame for much of the error."""
        return self._covariance is not None or self._path_change > MAX_PATH_CHANGE / 2

    def is_due_at_end(self, submap: Submap, is_waited_for: bool) -> bool:
        """Whether to ask a submap as the run ends: as long as none has estimated the camera, one that said nothing.

        `is_waited_for`: a lost map waits to be joined to it. Then it is asked also if it has merely grown.
        """
        n = len(submap.keyframes)
        says_more = is_waited_for and n >= AT_LOSS * self._asked_with.get(submap.id, 0)
        is_first = self._refined_in is None and submap.id not in self._estimated
        may_speak = self._refined_in in (None, submap.id)
        return self._config.refine and n >= FEWEST_KEYFRAMES and (is_first or (may_speak and says_more))

    def estimate(self, submap: Submap) -> CalibrationEstimate | Failure:
        """Return what a submap says of the camera; nothing is changed."""
        return self._estimate(submap, self._camera, self._covariance)

    def ask(self, submap: Submap, lost: dict[int, Submap]) -> CalibrationJob:
        """Return the question to a submap, on copies of it and of those that are to change with it."""
        self._asked(submap.id, len(submap.keyframes))
        copies = {m: each.copy() for m, each in lost.items()}
        return CalibrationJob(submap.copy(), copies, self._camera, self._covariance)

    def note(self, job: CalibrationJob, failure: Failure) -> None:
        """Note that a question changed nothing: where the motion said nothing yet, the next comes sooner.

        A camera that an answer of twice the information does not change is confirmed. Nothing more is asked until all
        maps are asked together.
        """
        asked = job.submap.id
        self.note_change(failure)
        if failure.numbers:
            self._estimated.add(asked)
        if failure.reason is FailureReason.DEGENERATE:
            self._said_nothing(asked, len(job.submap.keyframes))
        elif failure.reason is FailureReason.CHI_SQUARE and asked == self._refined_in:
            self._is_confirmed = self._knows_twice_as_much(failure.numbers["log_focal_sigma"])

    def note_change(self, found: CalibrationEstimate | Failure) -> None:
        """Note by how much an answer that was not taken would change the path."""
        self._path_change = found.numbers.get("path_change", 0.0)

    def take(self, answer: CalibrationAnswer) -> None:
        """Let the frames to come be rectified by the camera that was found."""
        self._camera, self._refined_in, self._covariance = answer.camera, answer.submap.id, answer.covariance
        self._estimated.add(answer.submap.id)

    def take_together(self, estimate: CalibrationEstimate) -> bool:
        """Take what all maps of a run say together, if it is significant or has twice the information; say whether."""
        taken = estimate.accepted or self._knows_twice_as_much(float(np.sqrt(estimate.covariance[0, 0])))
        if taken:
            self._camera, self._covariance = correct(self._camera, estimate.correction), estimate.covariance
        return taken

    def _asked(self, submap_id: int, n: int) -> None:
        self._asked_with[submap_id] = n
        self._wait(submap_id, n, int(np.ceil(GROWN * n)))

    def _said_nothing(self, submap_id: int, n: int) -> None:
        self._wait(submap_id, n, n + max(RETRY_KEYFRAMES, int(RETRY_SHARE * n)))

    def _wait(self, submap_id: int, n: int, due_at: int) -> None:
        """Let a submap of `n` keyframes be asked again; a question before its time does not put off the one in time."""
        first = self._config.first_keyframes
        self._due_at[submap_id] = min(due_at, first) if n < first else due_at

    def refine(self, submap: Submap) -> dict[str, float] | Failure:
        """Ask a submap about its camera and, where the answer is clear, change the submap to it.

        The submap keeps its ids. Only where the whole change succeeds, it gets other intrinsics, pixels, poses and
        points. Its graph is to be made anew. Returns numbers for the event log.
        """
        n = len(submap.keyframes)
        self._asked(submap.id, n)
        estimate = self._estimate(submap, self._camera, self._covariance)
        if isinstance(estimate, Failure):
            if estimate.reason is FailureReason.DEGENERATE:
                self._said_nothing(submap.id, n)
            return estimate
        numbers = estimate.numbers
        if not estimate.accepted and not self._is_much_surer(estimate.covariance):
            return Failure(FailureReason.CHI_SQUARE, "no significant change", numbers)
        try:
            camera = correct(self._camera, estimate.correction)
            self._change(submap, camera, None)
        except (InputError, SolverError) as error:
            return Failure(FailureReason.SOLVER, str(error), numbers)
        self._camera, self._refined_in, self._covariance = camera, submap.id, estimate.covariance
        return numbers

    def update(self, submap: Submap, graph: SubmapGraph) -> Submap | Failure:
        """Change a submap that an earlier camera of the same lens made to the present one; return the old state."""
        try:
            return self._change(submap, self._camera, graph)
        except (InputError, SolverError) as error:
            return Failure(FailureReason.SOLVER, str(error))

    def _change(self, submap: Submap, camera: Camera, graph: SubmapGraph | None) -> Submap:
        changed = submap.copy()
        change_camera(changed, camera)
        self._adjust(changed)
        if graph is not None:
            solved = graph.rebuild(changed)
            changed.apply_estimate(*solved.values)
        before = submap.copy()
        submap.take_over(changed)
        return before

    def _is_much_surer(self, covariance: FloatArray) -> bool:
        """Whether an answer is worth a change that is not significant: only where the present one was hardly sure."""
        sure = min(self._config.max_focal_sigma, SURE_SIGMA)
        hardly_sure = self.log_focal_sigma is not None and self.log_focal_sigma > sure
        return hardly_sure and self._knows_twice_as_much(float(np.sqrt(covariance[0, 0])))

    def _knows_twice_as_much(self, log_focal_sigma: float) -> bool:
        """Whether an answer has twice the information of the one in use; not where that is the given camera."""
        present = self.log_focal_sigma
        return present is not None and log_focal_sigma < UPDATE_SIGMA_RATIO * present

    def rectified(self, view: View) -> View:
        """Return a view with the pixels of the present camera; features without a place there keep their old one."""
        return replace(view, features=rectified_where_possible(view.features, self._camera))


def answer(
    job: CalibrationJob, calibration: Calibration, new_graph: Callable[[], SubmapGraph]
) -> CalibrationAnswer | Failure:
    """Do a job: ask its submap, and change it and the lost maps where the answer is clear.

    - `job`: its submaps are not changed.
    - `calibration`: one of its own, with the camera and the covariance of the job.
    """
    submap, changed = job.submap.copy(), {}
    numbers = calibration.refine(submap)
    if isinstance(numbers, Failure):
        return numbers
    for m, each in job.lost.items():
        lost = each.copy()
        before = calibration.update(lost, new_graph())
        if isinstance(before, Failure):
            log.warning("submap %d keeps its camera: %s", m, before.detail)
        else:
            changed[m] = lost
    assert calibration.covariance is not None
    return CalibrationAnswer(calibration.camera, calibration.covariance, submap, changed, numbers)


def rectified_again(features: Features, camera: Camera) -> Features:
    """Return features with their pixels under another camera. None is dropped (observations name them by their row),
    and sigmas stay: a correction changes them by a few per cent.
    """
    uv_rect_px, _ = camera.rectify(features.uv_px)
    lost = ~np.isfinite(uv_rect_px).all(axis=1)
    if lost.any():
        raise InputError(f"camera: {int(lost.sum())} features have no place in the corrected image")
    return replace(features, uv_rect_px=uv_rect_px)


def rectified_where_possible(features: Features, camera: Camera) -> Features:
    """Return features with their pixels under another camera; those without a place there keep their old one."""
    uv_rect_px, _ = camera.rectify(features.uv_px)
    lost = ~np.isfinite(uv_rect_px).all(axis=1)
    uv_rect_px[lost] = features.uv_rect_px[lost]
    return replace(features, uv_rect_px=uv_rect_px)


def change_camera(
    submap: Submap, camera: Camera, done: Mapping[int, Keyframe] | None = None, of: Mapping[int, Keyframe] | None = None
) -> None:
    """Give a submap the pixels and the intrinsics of another camera; poses and points stay.

    `done`: keyframes whose pixels were changed already, when they were as they are in `of`.
    """
    submap.K = camera.K
    submap.relative_poses = {}  # they were measured with the camera of before
    done, of = done or {}, of or {}
    for k, keyframe in submap.keyframes.items():
        if k in done and k in of and keyframe.features is of[k].features:
            submap.keyframes[k] = replace(keyframe, features=done[k].features)
        else:
            submap.keyframes[k] = replace(keyframe, features=rectified_again(keyframe.features, camera))
