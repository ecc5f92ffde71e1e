"""The one line that a trial leaves, even where it failed: what was measured, and the verdict on it."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, field, fields
from enum import StrEnum
from typing import Any

from dualslam.core.types import FrameStatus
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.spec import RightRun, Thresholds

STATUS_LETTERS = {
    FrameStatus.INITIALISING: "i",
    FrameStatus.TRACKED: "t",
    FrameStatus.LOST: "l",
    FrameStatus.RECOVERED: "r",
    FrameStatus.BYPASSED: "b",
    FrameStatus.DROPPED: "d",
    FrameStatus.UNREADABLE: "u",
}


class TrialOutcome(StrEnum):
    """How a trial ended."""

    DONE = "done"
    CRASHED = "crashed"  # an exception, or the death of its process
    TIMED_OUT = "timed_out"


class FailureKind(StrEnum):
    """Why a trial has failed."""

    CRASHED = "crashed"
    TIMED_OUT = "timed out"
    NO_MAP = "no map"
    COVERAGE = "coverage"
    ATE = "error"
    WRONG_LINK = "wrong link"


@dataclass(frozen=True, slots=True)
class Breakage:
    """A map that was lost, and how it was recovered, if it was.

    Attributes
    ----------
    frame : int
        Where the track was given up.
    submap : int
    reason : str
    restart_frames : int or None
        Frames of the source until the next map was initialised; None where none was.
    restart_s : float or None
        The same in seconds of the source.
    attempts : int
        Attempts that the first reverse tracking of a recovery made.
    succeeded_at : int or None
        The one of these that linked the map, from 1.
    recovery_s : float or None
        Seconds that the recovery took.
    relocalised : bool
        Whether the map was found again, and continued, before another had started.
    retries : int
        Reverse tracking that was made again later, once the new map had grown; its attempts are not counted above.
    linked_by_retry : bool
    merged : bool
        Whether it was joined by a place that a later map saw again.
    """

    frame: int
    submap: int
    reason: str
    restart_frames: int | None = None
    restart_s: float | None = None
    attempts: int = 0
    succeeded_at: int | None = None
    recovery_s: float | None = None
    relocalised: bool = False
    retries: int = 0
    linked_by_retry: bool = False
    merged: bool = False

    @property
    def recovered(self) -> bool:
        """Whether it is part of what was mapped after it."""
        return self.relocalised or self.succeeded_at is not None or self.linked_by_retry or self.merged


@dataclass(frozen=True, slots=True)
class LinkError:
    """An accepted link against the truth: relative, degrees, relative."""

    scale: float
    rotation_deg: float
    position: float


class JoinCause(StrEnum):
    """Why a place of the trajectory is asked whether it is joined."""

    DISTURBANCE = "disturbance"  # a passing one is over
    LOSS = "loss"  # a map was given up
    SEAM = "seam"  # the main map changes its submap


@dataclass(frozen=True, slots=True)
class Join:
    """The parts of the main map before and after a disturbance, a loss, or another change of its submap.

    Attributes
    ----------
    frame : int
        First frame after the part before.
    outcome : str
        One of `dualslam.lab.audits.join_audit.JoinOutcome`.
    offset_m, scale_ratio, turn_deg : float or None
        As in `dualslam.lab.audits.join_audit.JoinAudit`.
    cause : JoinCause
    """

    frame: int
    outcome: str
    offset_m: float | None
    scale_ratio: float | None
    turn_deg: float | None
    cause: JoinCause


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason of a run's verdict: its code, and the frames that it is about."""

    code: str
    first_frame: int | None = None
    last_frame: int | None = None


REFUSALS = ("InputError", "ConfigError")
"""How the error of a run begins that refused its input, which is no crash."""
WRONG_JOIN = "wrong"
NO_VERDICT = "none"
"""Level of a run whose program gives no verdict."""


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """A line of ``trials.jsonl``.

    Attributes
    ----------
    key, fingerprint : str
        Of the trial.
    sequence, condition, variant : str
    number : int
    start : int
        First frame.
    outcome : TrialOutcome
    error : str
        What went wrong, if the trial did not end well.
    status : str
        A letter for each frame that came, of `STATUS_LETTERS`; a capital where the frame is in the main map.
    initialised_at : int or None
        Position among these frames of the one at which the first map was initialised.
    initialised_after_s : float or None
        Seconds of the source until then.
    ate_m, path_m : float or None
        RMS error after alignment, and the length of the path; None without ground truth.
    end_point_error_m : float or None
        Of a sequence that returns to its start.
    breakages : tuple of Breakage
    links : tuple of LinkError
        Accepted links that ground truth can judge.
    wall_s, cpu_s : float
    dose : float or None
        Of the corruption that differs from trial to trial.
    n_clear, n_clear_posed : int
        Undisturbed frames from the first initialisation on, and those of them in the main map.
    is_still : bool
        The camera never leaves its place, so that a map is false.
    judged, broken, excepted : int
        Stretches judged; broken ones; broken ones in which the truth jumps, which do not count.
    first_broken_s : float or None
        Seconds from the clip's first frame.
    joins : tuple of Join
    level : str
        Of the run's verdict, or `NO_VERDICT`.
    reasons : tuple of Reason
    scores : dict of str to float
        By reason: how strongly the run speaks for it, whether or not it is given.
    """

    key: str
    fingerprint: str
    sequence: str
    condition: str
    variant: str
    number: int
    start: int
    outcome: TrialOutcome = TrialOutcome.DONE
    error: str = ""
    status: str = ""
    initialised_at: int | None = None
    initialised_after_s: float | None = None
    ate_m: float | None = None
    path_m: float | None = None
    end_point_error_m: float | None = None
    breakages: tuple[Breakage, ...] = ()
    links: tuple[LinkError, ...] = ()
    wall_s: float = 0.0
    cpu_s: float = 0.0
    dose: float | None = None
    n_clear: int = 0
    n_clear_posed: int = 0
    is_still: bool = False
    judged: int = 0
    broken: int = 0
    excepted: int = 0
    first_broken_s: float | None = None
    joins: tuple[Join, ...] = ()
    level: str = NO_VERDICT
    reasons: tuple[Reason, ...] = ()
    scores: dict[str, float] = field(default_factory=dict)

    @property
    def coverage(self) -> float:
        """Share (0 to 1) of the frames from the first initialisation on that are in the main map."""
        if self.initialised_at is None:
            return 0.0
        later = self.status[self.initialised_at :]
        return sum(letter.isupper() for letter in later) / max(len(later), 1)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> TrialRecord:
        """Read what `as_dict` gave.

        Raises
        ------
        ValueError, TypeError, KeyError
            Where it is something else.
        """
        needed = {f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING}
        if not needed <= set(data) <= {f.name for f in fields(cls)}:
            raise ValueError("these are not the fields of a trial")
        return cls(
            **data
            | {
                "outcome": TrialOutcome(data["outcome"]),
                "breakages": tuple(Breakage(**b) for b in data["breakages"]),
                "links": tuple(LinkError(**e) for e in data["links"]),
                "joins": tuple(Join(**j | {"cause": JoinCause(j["cause"])}) for j in data.get("joins", ())),
                "reasons": tuple(Reason(**r) for r in data.get("reasons", ())),
            }
        )


def blank_record(trial: Trial, outcome: TrialOutcome, error: str, wall_s: float = 0.0) -> TrialRecord:
    """Return the line of a trial that left nothing else."""
    return TrialRecord(
        trial.key,
        trial.fingerprint,
        trial.sequence,
        trial.condition,
        trial.variant,
        trial.number,
        trial.start,
        outcome,
        error,
        wall_s=wall_s,
        dose=trial.dose,
    )


def judge(record: TrialRecord, thresholds: Thresholds) -> FailureKind | None:
    """Return why a trial has failed, or None where it has not. The first reason of those in `FailureKind` counts."""
    if record.outcome is TrialOutcome.CRASHED:
        return FailureKind.CRASHED
    if record.outcome is TrialOutcome.TIMED_OUT:
        return FailureKind.TIMED_OUT
    if record.initialised_at is None:
        return FailureKind.NO_MAP
    if record.coverage < thresholds.min_coverage:
        return FailureKind.COVERAGE
    if record.ate_m is not None and record.path_m and record.ate_m > thresholds.max_ate * record.path_m:
        return FailureKind.ATE
    if any(is_wrong(link, thresholds) for link in record.links):
        return FailureKind.WRONG_LINK
    return None


def is_wrong(link: LinkError, thresholds: Thresholds) -> bool:
    """Return whether a link is one that should never have been made."""
    return (
        abs(link.scale) > thresholds.max_link_scale
        or link.rotation_deg > thresholds.max_link_rotation_deg
        or link.position > thresholds.max_link_position
    )


class Fault(StrEnum):
    """Faults that keep a run from being right."""

    CRASHED = "crashed"
    REFUSED = "refused"
    NO_MAP = "no map"
    COVERAGE = "coverage"
    STILL = "map of a still camera"
    BROKEN = "broken"
    ATE = "error"
    FALSE_JOIN = "false join"


FALSE_MAP = frozenset({Fault.STILL, Fault.BROKEN, Fault.ATE, Fault.FALSE_JOIN})
"""Faults that make the map false; the others leave it incomplete, or there is none."""


def faults_of(record: TrialRecord, right: RightRun) -> tuple[Fault, ...]:
    """Return what keeps a run from being right, in the order of `Fault`; empty where it is right."""
    if record.outcome is not TrialOutcome.DONE:
        return (Fault.REFUSED if record.error.startswith(REFUSALS) else Fault.CRASHED,)
    if record.initialised_at is None or not any(letter.isupper() for letter in record.status):
        return () if record.is_still else (Fault.NO_MAP,)
    if record.is_still:
        return (Fault.STILL,)
    found = []
    if record.n_clear_posed < right.min_coverage * record.n_clear:
        found.append(Fault.COVERAGE)
    if record.broken > right.max_broken:
        found.append(Fault.BROKEN)
    if record.ate_m is not None and record.path_m and record.ate_m > right.max_ate * record.path_m:
        found.append(Fault.ATE)
    if any(join.outcome == WRONG_JOIN for join in record.joins):
        found.append(Fault.FALSE_JOIN)
    return tuple(found)
