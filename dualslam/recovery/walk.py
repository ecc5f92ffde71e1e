"""State and result of one attempt at reverse tracking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from dualslam.atlas.trajectory import Path
from dualslam.core.decisions import Gate
from dualslam.core.events import Event, EventKind
from dualslam.core.types import Failure, FailureReason, Rival
from dualslam.linking import LinkRefusal
from dualslam.linking.rivals import Choice
from dualslam.map.submap import Submap
from dualslam.recovery.job import FoundLink, RecoveredFrame, RecoveryJob, path_of
from dualslam.recovery.schedule import LinkTries


@dataclass(slots=True, eq=False)
class Walk:
    """One attempt: what it has posed, the link that it has led to, and why it ends."""

    job: RecoveryJob
    attempt: str  # its name
    submap: Submap  # a copy of the job's, which grows
    tries: LinkTries  # what it and earlier walks have tried in vain
    problem: Failure | None = None  # why it was not made
    frames: dict[int, RecoveredFrame] = field(default_factory=dict)  # in the order in which they were posed first
    events: list[Event] = field(default_factory=list)
    # The link; or else one whose scale is too loose to be relied on.
    link: FoundLink | None = None
    unsure: FoundLink | None = None
    n_keyframes: int = 0
    # Gaps crossed, frames without a pose in these, and frames without a pose at the end.
    n_gaps: int = 0
    n_skipped: int = 0
    n_unusable: int = 0
    n_unrecognised: int = 0  # frames without a pose that show something: others may recognise them
    out_of_time: bool = False
    given_up: bool = False
    needs_camera: bool = False  # no other walk would do better before the camera is calibrated
    looks_alike: bool = False  # several poses are alike beyond a gap: another front end may not even notice
    before_gap: int | None = None  # the frame from which the first gap was crossed
    walk_sigma: float = 0.0  # of the scale that the walk hands on, as the last link that was tried says
    rivals: Sequence[Rival] = ()  # alternative hypotheses for poses beyond gaps
    choice: Choice | None = None  # what the velocities say of these
    refused: FailureReason | None = None  # of the last link that was tried
    why_unusable: str = ""
    why_not_linked: str = ""

    @classmethod
    def from_copy(cls, job: RecoveryJob, attempt: str, tries: LinkTries) -> Walk:
        """Return a walk that has not begun, with copies of the job's submap and of earlier tries."""
        return cls(job, attempt, job.submap.copy(), tries.copy())

    @property
    def is_final(self) -> bool:
        """Whether no other attempt is to be made after this one."""
        return self.link is not None or self.needs_camera or self.looks_alike or self.out_of_time

    @property
    def leaves_open(self) -> bool:
        """Whether other features may do better: not where all that shows something was posed, and the scale lost."""
        return self.n_unrecognised > 0 or self.refused not in (None, FailureReason.SCALE_LOST)

    @property
    def stopped_at(self) -> int | None:
        """The frame next to the one at which it has stopped, if no link was tried."""
        stopped = self.n_unusable > 0 and self.link is None and self.refused is None
        return min(self.frames, default=self.job.newest_id) if stopped else None

    @property
    def verdict(self) -> str:
        """The result in a few words."""
        if self.link is not None:
            return "linked"
        ended = "out of time" if self.out_of_time else self.why_unusable if self.n_unusable else "the buffer ends"
        ended = "given up" if self.given_up else ended
        return f"{ended}; no link: {self.why_not_linked}" if self.why_not_linked else ended

    @property
    def path(self) -> Path:
        """Where it has been, and the frames that it set out from."""
        return path_of(self.submap, self.frames.values(), self.job.poses)

    def lost_scale_from(self, max_sigma: float) -> int | None:
        """Return from which frame it crossed a gap, where it came to no link as it hands the scale on more loosely."""
        return self.before_gap if self.link is None and self.walk_sigma > max_sigma else None

    def note_unusable(self, failure: Failure) -> None:
        """Count a frame that was not posed."""
        self.n_unusable += 1
        self.n_unrecognised += failure.reason is not FailureReason.NO_TEXTURE
        self.looks_alike |= failure.reason is FailureReason.LOOK_ALIKE
        self.why_unusable = failure.detail or str(failure.reason)

    def note_posed(self, frame: RecoveredFrame, new_keyframe: bool) -> None:
        """Count a frame that was posed."""
        self.frames.setdefault(frame.pose.index, frame)
        self.n_keyframes += new_keyframe
        self.n_gaps += self.n_unusable > 0
        self.n_skipped += self.n_unusable
        self.n_unusable = 0

    def note_confirmed(self, frame: RecoveredFrame) -> None:
        """Count a frame, given before without a pose, that the last one has confirmed."""
        self.frames.setdefault(frame.pose.index, frame)
        self.n_skipped -= 1
        self.n_unrecognised -= 1

    def note_refused(self, found: Failure) -> None:
        """Note why a link was not made, and whether going on, or another walk, could change that."""
        self.refused, self.why_not_linked = found.reason, found.detail
        self.walk_sigma = found.walk_sigma if isinstance(found, LinkRefusal) else 0.0
        self.needs_camera |= found.reason is FailureReason.CAMERA
        self.given_up |= found.reason in (FailureReason.CAMERA, FailureReason.SCALE_LOST)
        # As long as the walk is not far enough beyond the gap nothing is measured, and more may tell.
        is_of_motion = found.reason in (FailureReason.LEAP, FailureReason.LOOK_ALIKE)
        self.given_up |= is_of_motion and self.choice is not None and self.choice.is_measured

    def event(self, seconds: float, max_gap_frames: int) -> Event:
        """Return the walk in one line, at the frame where it ended."""
        by_index = {view.index: view for view in (*self.job.own, *self.job.views)}
        last = next(reversed(self.frames), self.job.newest_id)
        data: dict[str, Any] = {
            "attempt": self.attempt,
            "frames": len(self.frames),
            "new_keyframes": self.n_keyframes,
            "gaps": self.n_gaps,
            "skipped_frames": self.n_skipped,
            "unusable_at_end": self.n_unusable,
            "matches": sum(frame.n_matches for frame in self.frames.values()),
            "inliers": sum(frame.n_inliers for frame in self.frames.values()),
            "verdict": self.verdict,
            "seconds": seconds,
        }
        if self.link is not None:
            data |= {"old_submap": self.link.old_id, **self.link.estimate.numbers}
        gap = Gate("frames in a row without a pose", self.n_unusable, "<=", max_gap_frames)
        at = last, by_index[last].timestamp_s, self.submap.id
        return Event(EventKind.RECOVERY_ATTEMPT, *at, data, gates=(gap,))
