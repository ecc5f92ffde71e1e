"""Where the machine stands between two frames: what its steps share."""

from __future__ import annotations

from dataclasses import dataclass, field

from dualslam.atlas.record import Record
from dualslam.core.config.settings import Config
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.types import View
from dualslam.io.map_store import StoredMap
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.relocaliser import Relocaliser
from dualslam.system.audit.photometric import PhotometricAudit
from dualslam.system.components import Components
from dualslam.system.health import HealthMonitor
from dualslam.system.motion_watch import MotionWatch
from dualslam.system.pace import Pace


@dataclass(slots=True)
class State:
    """State that the steps of a frame share."""

    parts: Components
    config: Config
    record: Record
    buffer: FrameBuffer
    saved: StoredMap | None  # the map that this run continues
    localises: bool  # frames are only found in that map, and nothing is added to it
    relocaliser: Relocaliser  # looks for the map that was lost last
    health: HealthMonitor  # of the tracking in the live map, or of the attempts at one
    audit: PhotometricAudit
    pace: Pace = field(default_factory=Pace)
    motion_watch: MotionWatch = field(default_factory=MotionWatch)
    live: VisualOdometry | None = None  # the front end of the live submap; None while there is no map
    lost: list[View] = field(default_factory=list)  # the frames since tracking was lost in the live map

    def front_ends(self) -> list[VisualOdometry]:
        """Return the front ends that track in a submap, or may soon: they must follow when it moves."""
        return [front_end for front_end in (self.live, self.relocaliser.relocaliser) if front_end is not None]

    def begin_health(self) -> None:
        """Forget the signs of trouble: another map is tracked from now on, or none."""
        self.health = HealthMonitor(self.config.health)
