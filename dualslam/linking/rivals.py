"""Choice among several poses beyond a gap that the images all allow: the one that the camera can have reached.

The velocities before and after the gap, each known in its own map, predict the motion (`linking/motion.py`). A pose is
accepted only if they leave no doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.spatial.distance import pdist

from dualslam.atlas.trajectory import Path
from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FailureReason, FloatArray, Rival
from dualslam.linking.join_test import judge_motion
from dualslam.linking.motion import Motion, gaps_of, measure_motion


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The decision by velocities among the poses of a walk beyond gaps and their alternatives."""

    refusal: Failure | None  # why the walk is refused, if it is
    better: tuple[Rival, ...] = ()  # the poses to use instead, if known: of several frames, all at one place
    is_measured: bool = True  # whether the walk was far enough beyond the gap


def choose_by_velocity(walked: Path, known: Path, rivals: Sequence[Rival]) -> Choice:
    """Choose by velocity between the poses of a walk beyond gaps and their alternatives.

    The velocity before the gap is the lost map's. Of a frame's poses one is accepted if the motion test allows it and
    refuses all others. It must also refuse a further pose that was not found, as far off as these lie from each other.
    All frames must agree.

    - `walked`: of the frames of the walk and those that it set out from.
    - `known`: the lost map's, as far as it is sound, in the coordinates of the walk.
    """
    refusal: Failure | None = None
    better: list[Rival] = []
    n_frames = 0
    for _, of_frame in groupby(rivals, key=lambda rival: rival.index):
        beside = list(of_frame)
        measured = _measure(walked, known, beside)
        if measured is None:
            detail = "beyond the gap several poses are alike"
            return Choice(Failure(FailureReason.LOOK_ALIKE, detail), is_measured=False)
        motions, places = measured
        own = motions[0]
        told = min(range(len(motions)), key=lambda n: motions[n].off_mu)
        others = [motion for n, motion in enumerate(motions) if n != told]
        reach_mu = motions[told].off_mu + motions[told].allowed_mu
        if not all(motion.is_refused for motion in others) or not reach_mu < pdist(places).min():
            return _nothing_told(own)
        n_frames += 1
        if told > 0:
            better.append(beside[told - 1])
            refusal = judge_motion([own]).refusal()
    if 0 < len(better) < n_frames:
        return _nothing_told(own)
    return Choice(refusal, tuple(better))


def _nothing_told(own: Motion) -> Choice:
    detail = "beyond the gap several poses are alike, and velocities do not tell which the camera has come to"
    return Choice(Failure(FailureReason.LOOK_ALIKE, detail, judge_motion([own]).numbers))


def _measure(walked: Path, known: Path, rivals: Sequence[Rival]) -> tuple[list[Motion], FloatArray] | None:
    """Measure the motion across the gap behind a frame: under the walk's pose, and under each other pose of that frame.

    Returns these motions, and the place of the last frame before the gap by each (N, 3); None without a velocity on
    both sides.
    """
    gaps = [i for i in gaps_of(walked.times_s).tolist() if walked.index[i] >= rivals[0].index]
    if not gaps:
        return None
    after_s = walked.times_s[gaps[0] + 1]
    path = known.take(known.times_s < after_s).then(walked)
    n_beyond = int(np.searchsorted(path.times_s, after_s))
    motions, places = [], []
    for T_moves in (se3.IDENTITY, *(rival.T_rival_walked for rival in rivals)):
        T = np.concatenate([T_moves @ path.T_map_cam[:n_beyond], path.T_map_cam[n_beyond:]])
        motion = measure_motion(replace(path, T_map_cam=T), n_beyond - 1, known) if n_beyond else None
        if motion is None or motion.n_sides < 2:
            return None
        motions.append(motion)
        places.append(T[n_beyond - 1, :3, 3])
    return motions, np.array(places)
