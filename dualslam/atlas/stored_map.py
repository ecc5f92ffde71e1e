"""A map that is whole: what one run leaves on the disk, and the next one continues."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.base import Camera


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """Submaps with their links, and where each frame stands: what `save_atlas` writes and `load_atlas` reads."""

    atlas: Atlas
    poses: dict[int, FramePose]
    camera: Camera | None = None
    """By which the features are rectified, with what was found out about it; None in maps of before it was kept."""
    colours: Mapping[int, NDArray[np.uint8]] = field(default_factory=dict)
    """mapping of int to (N, 3) uint8: of each submap's landmarks; none where the map was saved without."""

    @property
    def next_id(self) -> int:
        """The first number that no frame of the map has: the count of frames goes on there."""
        kept = (k for m in self.atlas.submaps.values() for k in (*m.keyframes, *m.anchors))
        return 1 + max([*self.poses, *kept], default=-1)

    @property
    def main(self) -> list[int]:
        """The linked set of submaps with most posed frames: its first one's frame is the world of the saved run."""
        return self.atlas.largest(Counter(pose.submap_id for pose in self.poses.values()))
