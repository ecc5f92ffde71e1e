"""Features of the frame to come, found in a process of their own while the frame before it is tracked."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from dualslam.core.errors import ConfigError
from dualslam.core.jobs import JobKind
from dualslam.core.types import Failure, Frame
from dualslam.workers.desk import WorkerDesk

log = logging.getLogger(__name__)


class FeaturesBeside:
    """Has the features of one frame after the other found in another process.

    Called on one thread that is not the tracking's. A process that has died or hangs costs nothing but time: the frame
    comes back without features, and the tracking process finds them. So do all that follow where no process starts.

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
