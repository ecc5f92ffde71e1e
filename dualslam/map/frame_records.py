"""Records of frames: the row that stays and grows, and the result that a step returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FloatArray, FrameMethod, FrameStatus


@dataclass(slots=True)
class FrameRow:
    """Record of one frame so far: a row of ``frames.csv``. Reverse tracking may still pose it later."""

    index: int  # the frame's number inside the system; its index in the source in what a run leaves behind
    timestamp_s: float
    status: FrameStatus
    submap: int | None = None  # the one that it is in
    in_main_map: bool | None = None
    """None in `System.rows`: it is known once a run has ended, to `dualslam.frame_rows` and ``frames.csv``."""
    n_matches: int = 0
    n_inliers: int = 0
    latency_ms: float = 0.0
    # What the map claims of it (`run/claims.py`), known there as well; None also where it cannot tell.
    sigma_position_rel: float | None = None
    sigma_scale: float | None = None
    method: FrameMethod | None = None  # how its pose was found; None without a pose
    doubt: str = ""
    """Empty, or the code of a reason in the run's verdict that is about this frame; known to ``frames.csv``."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """Result of one step about its frame.

    Attributes
    ----------
    T_submap_cam : (4, 4) float64 or None
        In the unit and frame of submap `submap_id`, as known now; later frames refine it.
    S_world_submap : (4, 4) float64 or None
        Where that submap lies in its world, as known now: a similarity, ``p_world = S_world_submap @ p_submap``. It
        changes with events alone (`linked`, `loop_closed`, `merged`, ...).
    world_id : int or None
        The submap in whose frame and unit the world is: the first of the linked set, or the saved map's. Frames with
        the same one are in one world.
    failure : Failure or None
        Why the frame has no pose.
    pose_ms : float or None
        From the start of the step to the frame's pose, before the map grew from it.
    method : FrameMethod or None
        How the pose was found.
    doubt : str
        Empty, or the code of what makes this stretch doubtful so far (`ReasonCode`).
    covariance_now : callable or None
        Computes `covariance`.
    """

    index: int
    status: FrameStatus
    submap_id: int | None
    T_submap_cam: FloatArray | None
    n_matches: int
    n_inliers: int
    latency_ms: float
    failure: Failure | None
    pose_ms: float | None = None
    S_world_submap: FloatArray | None = None
    world_id: int | None = None
    method: FrameMethod | None = None
    doubt: str = ""
    covariance_now: Callable[[], FloatArray | None] | None = field(default=None, repr=False, compare=False)

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) of xi in ``T_submap_cam @ exp(xi)``, relative to the first keyframe of the submap; None if not known.

        Order: rotation (rad), then translation (unit of the submap), in the camera's axes. It is computed when it is
        asked for, by the map as it is then: ask before the next frame.
        """
        return None if self.covariance_now is None else self.covariance_now()

    @property
    def pose(self) -> FloatArray | None:
        """The same as `T_world_cam`."""
        return self.T_world_cam

    @property
    def position(self) -> FloatArray | None:
        """(3,) camera centre in the world, in its unit; None without a pose."""
        T = self.T_world_cam
        return None if T is None else se3.translation(T)

    @property
    def lost(self) -> str | None:
        """Why the frame has no pose, in words; None where it has one."""
        if self.T_submap_cam is not None:
            return None
        if self.failure is None:
            return "there is no map yet"
        return self.failure.detail or str(self.failure.reason).replace("_", " ")

    @property
    def T_world_cam(self) -> FloatArray | None:
        """(4, 4) pose, camera to world, in the world's unit; None without one."""
        if self.T_submap_cam is None or self.S_world_submap is None:
            return None
        return np.asarray(sim3.act_on_pose(self.S_world_submap, self.T_submap_cam))
