"""A trajectory: poses in time, wherever they come from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dualslam.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses in time, N of them.

    Attributes
    ----------
    timestamps_s : (N,) float64
    T_world_cam : (N, 4, 4) float64
        Camera to the frame of the world, or of the map that it is in.
    index : (N,) int64
        Of each frame in its source; where it is not known, the place in the list.
    """

    timestamps_s: FloatArray
    T_world_cam: FloatArray
    index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if len(self.index) != len(self.timestamps_s):
            object.__setattr__(self, "index", np.arange(len(self.timestamps_s)))

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def take(self, rows: BoolArray | IntArray) -> Trajectory:
        """Return some of the poses, by a mask or by their places in the list."""
        return Trajectory(self.timestamps_s[rows], self.T_world_cam[rows], self.index[rows])

    def in_time_order(self) -> Trajectory:
        """Return the same poses, ascending in time (a run may have read its frames backwards)."""
        return self.take(self.timestamps_s.argsort(kind="stable"))
