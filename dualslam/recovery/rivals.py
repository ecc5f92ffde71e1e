"""Which of several poses beyond a gap, all of which the images allow, is one that the camera can have come to.

What repeats itself leaves poses for many places, a period apart. The velocities before and after the gap, each known in
its own map, tell how far off each of them is, as for any leap (`recovery/leaps.py`); and only where they leave no doubt
is one of them believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy.spatial.distance import pdist

from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FailureReason, FloatArray, Rival
from dualslam.map.trajectory import Path
from dualslam.recovery.leaps import ALLOWED, Leap, gaps_of, leap_by_other, leap_refusal


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What the velocities say of the poses that a walk took beyond gaps, and of their rivals.

    Attributes
    ----------
    refusal : Failure or None
        Why the walk is not to be believed, if it is not. Without numbers where nothing could be measured as yet.
    better : tuple of Rival
        What it has to go by instead, if that is told: of several frames, all at one place.
    """

    refusal: Failure | None
    better: tuple[Rival, ...] = ()

    @property
    def is_measured(self) -> bool:
        """Whether the walk was far enough beyond the gap, and the lost map long enough."""
        return self.refusal is None or bool(self.refusal.numbers)


def choose_by_velocity(walked: Path, known: Path, rivals: Sequence[Rival]) -> Choice:
    """Tell the poses that a walk took beyond gaps from their rivals.

    The velocity before the gap is the lost map's: the walk may have found its place only a while beyond the gap, and a
    long leap tells less. Of a frame's poses one is believed where it is allowed as a leap and all others are refused;
    and so would be any other that is not found, if it lies as far off as these lie from each other. All frames must
    tell the same.

    Parameters
    ----------
    walked : Path
        Of the frames of the walk and those that it set out from.
    known : Path
        The lost map's, as far as it is sound, in the coordinates of the walk.
    rivals : sequence of Rival
    """
    refusal: Failure | None = None
    better: list[Rival] = []
    n_frames = 0
    for _, of_frame in groupby(rivals, key=lambda rival: rival.index):
        beside = list(of_frame)
        measured = _measure(walked, known, beside)
        if measured is None:
            return Choice(Failure(FailureReason.LOOK_ALIKE, "beyond the gap several poses are alike"))
        leaps, places = measured
        own = leaps[0]
        told = min(range(len(leaps)), key=lambda n: leaps[n].off_mu)
        others = [leap for n, leap in enumerate(leaps) if n != told]
        reach_mu = leaps[told].off_mu + ALLOWED * leaps[told].usual_mu
        if not all(leap.is_refused for leap in others) or not reach_mu < pdist(places).min():
            return _nothing_told(own)
        n_frames += 1
        if told > 0:
            better.append(beside[told - 1])
            refusal = leap_refusal(own)
    if 0 < len(better) < n_frames:
        return _nothing_told(own)
    return Choice(refusal, tuple(better))


def _nothing_told(own: Leap) -> Choice:
    detail = "beyond the gap several poses are alike, and velocities do not tell which the camera has come to"
    return Choice(Failure(FailureReason.LOOK_ALIKE, detail, own.numbers))


def _measure(walked: Path, known: Path, rivals: Sequence[Rival]) -> tuple[list[Leap], FloatArray] | None:
    """Measure the leap over the gap that a frame lies beyond: as the walk has it, and as each rival of that frame.

    Returns these leaps, and where the last frame before the gap is by each (N, 3); None where nothing can be measured.
    """
    gaps = [i for i in gaps_of(walked.times_s).tolist() if walked.index[i] >= rivals[0].index]
    if not gaps:
        return None
    after_s = walked.times_s[gaps[0] + 1]
    path = known.take(known.times_s < after_s).then(walked)
    n_beyond = int(np.searchsorted(path.times_s, after_s))
    leaps, places = [], []
    for T_moves in (np.eye(4), *(rival.T_rival_walked for rival in rivals)):
        centres = np.concatenate([se3.act(T_moves, path.centres[:n_beyond]), path.centres[n_beyond:]])
        leap = leap_by_other(path.times_s, centres, n_beyond - 1, known.times_s, known.centres, known.refound)
        if leap is None:
            return None
        leaps.append(leap)
        places.append(centres[n_beyond - 1])
    return leaps, np.array(places)
