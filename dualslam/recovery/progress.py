"""How far one attempt at reverse tracking has come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dualslam.core.events import Event
from dualslam.core.types import Failure, FailureReason, Rival
from dualslam.linking.rivals import Choice
from dualslam.map.submap import Submap
from dualslam.recovery.job import FoundLink, RecoveredFrame


@dataclass(slots=True, eq=False)
class Progress:
    """The state of one attempt: what it has posed, and why it ends."""

    submap: Submap
    frames: dict[int, RecoveredFrame] = field(default_factory=dict)  # in the order in which they were posed first
    events: list[Event] = field(default_factory=list)
    link: FoundLink | None = None
    unsure: FoundLink | None = None  # instead, one whose scale is too loose to be relied on
    n_keyframes: int = 0
    n_gaps: int = 0
    n_skipped: int = 0  # frames without a pose between some that have one
    n_unusable: int = 0  # the last frames
    out_of_time: bool = False
    given_up: bool = False
    needs_camera: bool = False  # no other walk would do better, before the camera is calibrated
    needs_old_map: bool = False  # nor ever: all keyframes of the lost maps leave the scale open
    looks_alike: bool = False  # beyond a gap: what one front end cannot tell apart another may not even notice
    before_gap: int | None = None  # the frame from which the first gap was crossed
    walk_sigma: float = 0.0  # of the scale that the walk hands on, as the last link that was tried says
    rivals: Sequence[Rival] = ()  # of poses beyond gaps
    choice: Choice | None = None  # what the velocities say of these
    why_unusable: str = ""
    why_not_linked: str = ""

    @property
    def verdict(self) -> str:
        """The result in a few words."""
        if self.link is not None:
            return "linked"
        ended = "out of time" if self.out_of_time else self.why_unusable if self.n_unusable else "the buffer ends"
        ended = "given up" if self.given_up else ended
        return f"{ended}; no link: {self.why_not_linked}" if self.why_not_linked else ended

    def lost_scale_from(self, max_sigma: float) -> int | None:
        """Return from which frame it crossed a gap, where it came to no link as it hands the scale on more loosely."""
        return self.before_gap if self.link is None and self.walk_sigma > max_sigma else None

    def note_unusable(self, failure: Failure) -> None:
        """Count a frame that was not posed."""
        self.n_unusable += 1
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
