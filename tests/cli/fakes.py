"""A system that knows the truth, so that the harness and the command line are tested without the algorithm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.record import StageTimer
from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind, EventLog
from dualslam.core.jobs import InlineDesk
from dualslam.core.types import Features, FloatArray, Frame, FrameStatus, Keyframe, View
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.map.frame_records import FrameResult, FrameRow
from dualslam.map.submap import Submap
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.system.audit.photometric import PhotometricAudit
from dualslam.system.pace import Pace
from dualslam.workers.scheduled_desk import ScheduledDesk

NO_FEATURES = Features(
    np.zeros((0, 2)),
    np.zeros((0, 2)),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0, np.int64),
    np.zeros(0),
    np.zeros((0, 32), np.uint8),
)


class NoPatches:
    """Keeps nothing, so that no frame can be compared."""

    def remember(self, submap: Submap, view: View) -> None:
        pass

    def measure(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> float | None:
        return None


class FakeSystem:
    """Poses every frame at its true place, but for those in `lost`; after them a new submap begins."""

    def __init__(
        self,
        truth: dict[int, FloatArray],
        lost: tuple[int, ...] = (),
        before_step: Callable[[Frame], None] = lambda frame: None,
    ) -> None:
        self.atlas = Atlas()
        self.rows: dict[int, FrameRow] = {}
        self.poses: dict[int, FramePose] = {}
        self.events = EventLog()
        self.timer = StageTimer()
        self.buffer = FrameBuffer(1.0, 1.0)
        self.pace = Pace()
        self.desk = ScheduledDesk(InlineDesk({}))
        self.n_finished = 0
        self.numbers = FrameNumbers()
        self.audit, self.blank = PhotometricAudit(NoPatches()), set[int]()
        self.world = self.saved = self.log_focal_sigma = self.hidden = None
        self.camera: Camera = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)
        self.was_interrupted = False
        self._truth, self._lost, self._before_step = truth, lost, before_step
        self._submap: Submap | None = None

    def step(self, frame: Frame) -> FrameResult:
        self._before_step(frame)
        with self.timer.measure("tracking"):
            pass
        number = self.numbers.number(frame.index)
        if frame.image is None or frame.index in self._lost:
            if self._submap is not None:
                self.events.add(EventKind.FAILED, number, frame.timestamp_s, self._submap.id)
            self._submap = None
            return self._result(frame, FrameStatus.LOST)
        T_world_cam = self._truth[frame.index]
        if self._submap is None:
            self._submap = Submap(len(self.atlas.submaps), np.eye(3), np.zeros(32, np.uint8))
            self.atlas.add(self._submap)
            self.events.add(EventKind.INITIALISED, number, frame.timestamp_s, self._submap.id)
        self._submap.add_keyframe(Keyframe(number, frame.timestamp_s, NO_FEATURES), T_world_cam)
        self.poses[number] = FramePose(number, frame.timestamp_s, self._submap.id, number, np.eye(4))
        return self._result(frame, FrameStatus.TRACKED)

    def keep(self, frame: Frame) -> None:
        number = self.numbers.number(frame.index)
        self.rows[number] = FrameRow(number, frame.timestamp_s, FrameStatus.DROPPED)

    def seen(self) -> list[int]:
        """Return the indices of the frames that were given to a step."""
        rows = self.rows.values()
        return [self.numbers.index_of(row.index) for row in rows if row.status is not FrameStatus.DROPPED]

    def finish(self, interrupted: bool = False) -> None:
        self.n_finished += 1
        self.was_interrupted = interrupted

    def _result(self, frame: Frame, status: FrameStatus) -> FrameResult:
        submap_id = None if self._submap is None else self._submap.id
        number = self.numbers.number(frame.index)
        self.rows[number] = FrameRow(number, frame.timestamp_s, status, submap_id, False, 100, 90, 5.0)
        return FrameResult(frame.index, status, submap_id, None, 100, 90, 5.0, None)


def builder(truth: dict[int, FloatArray], **options: object) -> Callable[[Config, Camera], FakeSystem]:
    """Return what stands in for `build_system`."""
    return lambda config, camera: FakeSystem(truth, **options)  # type: ignore[arg-type]
