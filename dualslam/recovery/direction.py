"""A recovery in a sequence that is read backwards: the same job with its frames numbered the other way round.

Frames are numbered as in their source. Recovery and linking ask which of two keyframes is the older by comparing their
numbers, so a source that is read from its end must be renumbered for them, and what they find numbered back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dualslam.core.events import Event
from dualslam.core.types import Failure
from dualslam.map.trajectory import FramePose
from dualslam.recovery.linking import LinkEstimate
from dualslam.recovery.reverse_tracking import (
    FoundLink,
    RecoveredFrame,
    RecoveryJob,
    RecoveryParts,
    RecoveryResult,
    run_recovery,
)

FRAME_NUMBERS = ("onset", "change_point", "torn")
"""Numbers in the events and refusals of a recovery that name frames."""

Renumber = Callable[[int], int]


def reads_backwards(job: RecoveryJob) -> bool:
    """Whether the frames before the newest one have higher numbers than it."""
    return bool(job.views) and job.views[0].index > job.newest_id


def recover(job: RecoveryJob, parts: RecoveryParts) -> RecoveryResult | Failure:
    """Run a job as `run_recovery` does, in whichever direction its sequence is read."""
    if not reads_backwards(job):
        return run_recovery(job, parts)
    last = max(
        *(view.index for view in job.views),
        *(k for submap in (job.submap, *job.lost.values()) for k in (*submap.keyframes, *submap.anchors)),
    )

    def renumber(index: int) -> int:
        return last - index

    result = run_recovery(renumbered_job(job, renumber), parts)
    return result if isinstance(result, Failure) else _renumbered_result(result, renumber)


def renumbered_job(job: RecoveryJob, renumber: Renumber) -> RecoveryJob:
    """Return the job with other numbers for the same frames."""
    return replace(
        job,
        submap=job.submap.renumbered(renumber),
        newest_id=renumber(job.newest_id),
        lost={m: submap.renumbered(renumber) for m, submap in job.lost.items()},
        onsets={m: renumber(i) for m, i in job.onsets.items()},
        views=tuple(replace(view, index=renumber(view.index)) for view in job.views),
        own=tuple(replace(view, index=renumber(view.index)) for view in job.own),
    )


def _renumbered_result(result: RecoveryResult, renumber: Renumber) -> RecoveryResult:
    return replace(
        result,
        submap=result.submap.renumbered(renumber),
        frames=tuple(_renumbered_frame(frame, renumber) for frame in result.frames),
        link=None if result.link is None else _renumbered_link(result.link, renumber),
        events=tuple(_renumbered_event(event, renumber) for event in result.events),
    )


def _renumbered_frame(frame: RecoveredFrame, renumber: Renumber) -> RecoveredFrame:
    pose: FramePose = frame.pose
    return replace(frame, pose=replace(pose, index=renumber(pose.index), keyframe_id=renumber(pose.keyframe_id)))


def _renumbered_link(link: FoundLink, renumber: Renumber) -> FoundLink:
    found: LinkEstimate = link.estimate

    def optional(index: int | None) -> int | None:
        return None if index is None else renumber(index)

    estimate = replace(
        found,
        agreeing_keyframes=np.array([renumber(k) for k in found.agreeing_keyframes.tolist()], np.int64),
        change_point=optional(found.change_point),
        suspected_onset=optional(found.suspected_onset),
        numbers=_renumbered_data(found.numbers, renumber),
    )
    return replace(link, estimate=estimate)


def _renumbered_event(event: Event, renumber: Renumber) -> Event:
    return replace(event, frame=renumber(event.frame), data=_renumbered_data(event.data, renumber))


def _renumbered_data(data: dict[str, Any], renumber: Renumber) -> dict[str, Any]:
    named = {key: float(renumber(int(data[key]))) for key in FRAME_NUMBERS if data.get(key) is not None}
    return data | named
