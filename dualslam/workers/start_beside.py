"""In other processes: the search for a start over frames without a map, and the features of the frame to come."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

from dualslam.core.errors import ConfigError
from dualslam.core.interfaces import START_REACH, MapStarter
from dualslam.core.jobs import Desk, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray, Frame, Start, View
from dualslam.workers.desk import WorkerDesk

LOST = (FailureReason.WORKER, FailureReason.TIMEOUT, FailureReason.BUSY)
"""Ends of a search with which what was collected is lost, too."""
_SESSIONS = count()


@dataclass(frozen=True, slots=True, eq=False)
class StartQuestion:
    """Frames to be collected, the last of which is to be tried."""

    session: int  # of one search: with another one all that was collected is forgotten
    K: FloatArray  # (3, 3): intrinsics of the frames
    views: tuple[View, ...]  # those that the search does not know yet, without their images
    waited_s: float  # for how long there has been no map


class StartServer:
    """Collects and tries, in the process that searches.

    `new_starter`: makes what searches among frames of these intrinsics.
    """

    def __init__(self, new_starter: Callable[[FloatArray], MapStarter]) -> None:
        self._new_starter = new_starter
        self._session = -1
        self._starter: MapStarter | None = None

    def forget(self) -> None:
        """Forget what was collected, as if the process had been started anew."""
        self._session, self._starter = -1, None

    def __call__(self, question: StartQuestion) -> Start | Failure:
        """Try the newest frame."""
        if self._starter is None or question.session != self._session:
            self._session, self._starter = question.session, self._new_starter(question.K)
        *earlier, newest = question.views
        for view in earlier:
            self._starter.collect(view)
        return self._starter.add(newest, question.waited_s)


class StartBeside:
    """A `MapStarter` that, where it is to be brief, searches in another process: one frame at a time, the newest.

    Frames that come while one is tried are collected with the next. A start that is found ends with a frame some frames
    back, and who asked has to go on from there.

    - `starter`: searches here and now when the system is on time.
    - `K` (3, 3): intrinsics of the frames.
    """

    def __init__(self, desk: Desk, starter: MapStarter, K: FloatArray) -> None:
        self._desk = desk
        self._starter = starter
        self._K = K
        self._session = next(_SESSIONS)
        self._views: deque[View] = deque(maxlen=START_REACH + 1)
        self._n_new = 0  # of these, the last ones, that the process does not know

    def collect(self, view: View) -> None:
        """Keep a view as a possible first view, without trying to start from it."""
        self._starter.collect(view)
        self._note(view)

    def add(self, view: View, waited_s: float = 0.0, briefly: bool = False) -> Start | Failure:
        """Take a view in; return what was found for one that has been tried meanwhile."""
        if not briefly:
            self._note(view)
            return self._starter.add(view, waited_s)
        self.collect(view)
        found = self._found()
        if not found and not self._desk.n_open(JobKind.START):
            views = list(self._views)[-self._n_new :]
            sent = tuple(replace(v, image=None) for v in views)
            question = StartQuestion(self._session, self._K, sent, waited_s)
            self._desk.submit(JobKind.START, question)
            self._n_new = 0
        return found

    def _note(self, view: View) -> None:
        self._views.append(view)
        self._n_new = min(self._n_new + 1, len(self._views))

    def _found(self) -> Start | Failure:
        found: Start | Failure = Failure(FailureReason.BUSY, "a start is being looked for")
        for ended in self._desk.poll(JobKind.START):
            if ended.work.session != self._session:
                continue
            found = ended.result if isinstance(ended.result, Failure) else self._own(ended.result)
            if isinstance(found, Failure) and found.reason in LOST:
                self._session, self._n_new = next(_SESSIONS), len(self._views)
        return found

    def _own(self, start: Start) -> Start | Failure:
        """Return a start of the views that were sent, with their images."""
        own = {view.index: view for view in self._views}
        if any(view.index not in own for view in start.views):
            return Failure(FailureReason.TIMEOUT, "the start that was found is of frames long ago")
        return replace(start, views=[own[view.index] for view in start.views])


log = logging.getLogger(__name__)


class FeaturesBeside:
    """Has the features of one frame after the other found in another process, called on one thread that is not the
    tracking's.

    From a process that has died or hangs, the frame comes back without features, and the tracking process finds them.

    - `desk`: with a lane for features.
    - `painted`: returns a frame as the front end is to see it.
    """

    def __init__(self, desk: WorkerDesk, painted: Callable[[Frame], Frame]) -> None:
        self._desk = desk
        self._painted = painted
        self._gave_up = False

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame with its features."""
        if frame.image is None or self._gave_up:
            return frame
        try:
            found = self._desk.ask(JobKind.FEATURES, self._painted(frame).image).result
        except ConfigError as error:
            log.warning("no more features are found in the background: %s", error)
            self._gave_up = True
            return frame
        if isinstance(found, Failure):
            log.warning("frame %d: %s; its features are found beside nothing", frame.index, found.detail)
            return frame
        return replace(frame, features=found)
