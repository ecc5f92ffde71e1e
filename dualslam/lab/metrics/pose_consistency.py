"""Whether frames' covariances are as large as their errors: NEES, in the gauge of a submap."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray
from dualslam.map.frame_records import FrameResult
from dualslam.map.submap import Submap


def pose_nees(submaps: Mapping[int, Submap], result: FrameResult, T_world_cam: FloatArray) -> float | None:
    """Return the normalised estimation error squared of a frame that was just posed; 6 is expected.

    True poses stand relative to the submap's first keyframe. Their unit is that of its first baseline.

    - `T_world_cam` (F, 4, 4): true poses of all frames.

    None in the gauge's own frames, where the frame has no pose, and where its covariance is not known.
    """
    covariance = result.covariance
    if result.T_submap_cam is None or covariance is None or result.submap_id is None:
        return None
    submap = submaps[result.submap_id]
    first, second = submap.gauge
    if result.index <= second or second not in submap.keyframes:
        return None
    T = se3.inverse(T_world_cam[first]) @ T_world_cam[[second, result.index]]
    baseline = submap.T_submap_kf[second][:3, 3] - submap.T_submap_kf[first][:3, 3]
    T[1, :3, 3] *= np.linalg.norm(baseline) / np.linalg.norm(T[0, :3, 3])
    error = se3.log(se3.inverse(T[1]) @ se3.inverse(submap.T_submap_kf[first]) @ result.T_submap_cam)
    return float(error @ np.linalg.solve(covariance, error))
