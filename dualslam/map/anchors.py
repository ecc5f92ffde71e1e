"""Where frames and keyframes stand by other keyframes of their submap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where a culled keyframe (or a plain frame) stands: a pose relative to a keyframe that is still there."""

    keyframe_id: int
    T_kf_cam: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Where a keyframe stands by what is no observation of the submap's landmarks: a gap relocalisation."""

    keyframe_id: int  # relative to which other keyframe
    T_ref_kf: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6): of xi in ``T_ref_kf @ exp(xi)``: rotation, translation; positive definite

    def scaled(self, scale: float) -> RelativePose:
        """Return the same in another unit of length."""
        units = np.repeat([1.0, scale], len(self.covariance) // 2)
        covariance = units[:, None] * self.covariance * units
        return RelativePose(self.keyframe_id, se3.scaled(self.T_ref_kf, scale), covariance)

    def seen_from(self, keyframe_id: int, T_kf_ref: FloatArray) -> RelativePose:
        """Return the same relative to another keyframe, of which the old one's place is known."""
        return RelativePose(keyframe_id, T_kf_ref @ self.T_ref_kf, self.covariance)


def add_relative_poses(
    information: FloatArray, kf: IntArray, T_submap_kf: Mapping[int, FloatArray], relative: Mapping[int, RelativePose]
) -> None:
    """Add what relative poses say of keyframes (n,) to the information (n, 6, n, 6) of their right perturbations."""
    place = {k: i for i, k in enumerate(kf.tolist())}
    for k, known in relative.items():
        if k in place and known.keyframe_id in place:
            i, j = place[known.keyframe_id], place[k]
            W = np.linalg.inv(known.covariance)
            Ad = se3.adjoint(se3.inverse(T_submap_kf[k]) @ T_submap_kf[known.keyframe_id])
            information[j, :, j, :] += W
            information[i, :, i, :] += Ad.T @ W @ Ad
            information[i, :, j, :] -= Ad.T @ W
            information[j, :, i, :] -= W @ Ad
