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
    """State that the steps of a frame share.

    Attributes
    ----------
    parts : Components
    config : Config
    record : Record
    buffer : FrameBuffer
    pace : Pace
    saved : StoredMap or None
        The map that this run continues.
    localises : bool
        Frames are only found in that map, and nothing is added to it.
    relocaliser : Relocaliser
        Looks for the map that was lost last.
    health : HealthMonitor
        Of the tracking in the live map, or of the attempts at one.
    motion_watch : MotionWatch
    audit : PhotometricAudit
    live : VisualOdometry or None
        The front end of the live submap; None while there is no map.
    lost : list of View
        The frames since tracking was lost in the live map.
    """

    parts: Components
    config: Config
    record: Record
    buffer: FrameBuffer
    saved: StoredMap | None
    localises: bool
    relocaliser: Relocaliser
    health: HealthMonitor
    audit: PhotometricAudit
    pace: Pace = field(default_factory=Pace)
    motion_watch: MotionWatch = field(default_factory=MotionWatch)
    live: VisualOdometry | None = None
    lost: list[View] = field(default_factory=list)

    def front_ends(self) -> list[VisualOdometry]:
        """Return the front ends that track in a submap, or may soon: they must follow when it moves."""
        return [front_end for front_end in (self.live, self.relocaliser.relocaliser) if front_end is not None]

    def begin_health(self) -> None:
        """Forget the signs of trouble: another map is tracked from now on, or none."""
        self.health = HealthMonitor(self.config.health)
