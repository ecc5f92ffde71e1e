"""How strongly a finished run speaks for each reason of its verdict, whether or not the reason is given."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from dualslam.run.results import trajectories_of
from dualslam.system.audit.photometric import MIN_SAMPLES, Sample
from dualslam.system.audit.steps import measure_steps
from dualslam.system.audit.verdict import ReasonCode
from dualslam.system.system import System


def audit_scores(system: System) -> dict[str, float]:
    """Return a score for each reason that has one: the higher, the worse.

    The verdict gives a reason where its score exceeds a threshold. A bench needs the scores of all runs to tell whether
    another threshold is better.
    """
    main = trajectories_of(system).main.in_time_order()
    ratio = measure_steps(main.timestamps_s, main.T_world_cam[:, :3, 3]).ratio
    scores = {str(ReasonCode.JUMP): float(ratio.max(initial=0.0))}
    in_main = set(main.index.tolist())
    kept = [s for s in system.audit.samples if system.numbers.index_of(s.index) in in_main]
    scores[str(ReasonCode.PHOTOMETRIC)] = worst_disagreement(kept)
    if system.log_focal_sigma is not None:
        scores[str(ReasonCode.FOCAL)] = system.log_focal_sigma
    return scores


def worst_disagreement(samples: Sequence[Sample]) -> float:
    """Return the largest share of patches that disagree in all of `MIN_SAMPLES` consecutive samples of one map.

    With a threshold below it, `system.audit.photometric.disagreeing_stretches` finds a stretch. 0 without samples.
    """
    worst = 0.0
    for _, group in groupby(samples, key=lambda s: s.submap_id):
        agreement = [s.agreement for s in group]
        for first in range(len(agreement) - MIN_SAMPLES + 1):
            worst = max(worst, 1.0 - max(agreement[first : first + MIN_SAMPLES]))
    return worst
