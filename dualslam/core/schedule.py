"""When the answers of background work come into the map: stated, recorded, or repeated from a record.

A run's schedule is what its trajectory depends on besides its frames, its configuration and its code: in which frame
each answer was used, which jobs were lost, which frames were dropped, and in real time how late each frame was. It goes
to ``schedule.jsonl`` of the run folder, which holds no poses: with other code the same schedule gives another map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dualslam.core.errors import InputError
from dualslam.core.jobs import JobKind, Limit
from dualslam.core.types import Failure, FailureReason

SCHEDULE = "schedule.jsonl"
"""In a run folder."""
VERSION = 1
"""Of the file: another one is not read."""
AT_END = "end"
"""Stands for the end of the run, where else a frame's index stands."""
OK, WITHDRAWN, OPEN = "ok", "withdrawn", "open"
"""Outcomes of a request besides the reasons of failures; `OPEN`: it had no answer when the run ended."""

When = int | str | None

DELAYS: Mapping[JobKind, float] = {
    JobKind.START: 3,
    JobKind.GRAPH: 3,
    JobKind.EDGES: 13,
    JobKind.ATLAS: 2,
    JobKind.SCALE: 3,
    JobKind.READOUT: 6,
    JobKind.CALIBRATION: 30,
    JobKind.LOOP: 10,
    JobKind.WALK: 18,
}
"""Frames after which an answer is used by default: twice the median CPU time of a job in frames of 30 Hz, and one more.

Twice, since a worker has about half a core where tracking and features take the rest of two. One more, since answers
come in where a frame begins. Medians of the jobs above 10 ms, in frames: start search 0.8, graph 0.8, scale watch 0.7,
readout 2.3, calibration 15, loop search 4.4, reverse tracking 8.2, edge covariances 6
(docs/adr/0020-work-beside-tracking.md), atlas below 0.3."""


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """A job that was asked for."""

    number: int  # counts the requests of the run
    kind: JobKind
    submap: int | None  # without which the answer is of no use
    # When: the steps so far, and the frame's index in the source.
    step: int
    frame: When
    work: Any


@dataclass(frozen=True, slots=True)
class AnswerRecord:
    """A request and what became of it: a line of ``schedule.jsonl``."""

    number: int
    kind: JobKind
    submap: int | None
    # Frames (their index in the source); None: never used.
    requested: When
    used: When
    outcome: str  # `OK`, `WITHDRAWN`, `OPEN`, or the reason of a failure
    detail: str = ""  # of the failure
    steps: int | None = None  # of the job, after which it was stopped, as its time was over
    drained: bool = False  # whether it was used because the run, or its map, ended there, and not when the frame began

    @property
    def is_lost(self) -> bool:
        """Whether the job itself was lost, with the state of the process that did it."""
        return self.outcome in (FailureReason.WORKER, FailureReason.TIMEOUT, FailureReason.BUSY)

    def failure(self) -> Failure:
        """Return the failure that the outcome names."""
        return Failure(FailureReason(self.outcome), self.detail)

    def as_row(self) -> dict[str, Any]:
        """Return the line; what is as ever is left out."""
        row = asdict(self) | {"kind": str(self.kind)}
        return {name: value for name, value in row.items() if value or name not in ("detail", "steps", "drained")}


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late a frame was in real time, and how much later the answers of its step made it (s)."""

    late_s: float
    held_s: float


class Policy(Protocol):
    """Says when the answer to a request is given out."""

    @property
    def waits(self) -> bool:
        """Whether an answer that is due and not there is waited for."""
        ...

    def is_due(self, request: Request, step: int, frame: When) -> bool:
        """Whether the answer is to be given out by now."""
        ...


@dataclass(frozen=True, slots=True)
class After:
    """Answers are used so many frames after they were asked for, by kind; 0 is at once, infinity at the end."""

    frames: Mapping[JobKind, float] = field(default_factory=lambda: DELAYS)
    waits = True

    def is_due(self, request: Request, step: int, frame: When) -> bool:
        """Whether so many frames have passed."""
        return step - request.step >= self.frames.get(request.kind, 0)


AT_ONCE = After({})
"""Each answer is used where it was asked for: one process, nothing beside it."""


@dataclass(slots=True)
class Recorded:
    """The schedule of an earlier run, to be repeated in one process."""

    header: Mapping[str, Any]  # what the run was: version, source, selection of frames, real time or not
    answers: Mapping[int, AnswerRecord]  # by the request's number
    dropped: frozenset[int] = frozenset()  # frames (index in the source)
    lateness: Mapping[int, Lateness] = field(default_factory=dict)  # by frame, of a run in real time
    last_frame: int | None = None  # at which the run ended; None: it was cut off, and its last lines are missing
    interrupted: bool = False
    departure: str = ""  # where the repetition has come apart from the record, and why; empty while it has not

    waits = True

    @classmethod
    def of(cls, rows: Iterable[Mapping[str, Any]]) -> Recorded:
        """Read the lines of a schedule."""
        header: Mapping[str, Any] = {}
        answers: dict[int, AnswerRecord] = {}
        dropped: set[int] = set()
        lateness: dict[int, Lateness] = {}
        last_frame, interrupted = None, False
        for row in rows:
            if "schedule" in row:
                header = row
            elif "number" in row:
                record = AnswerRecord(**{**row, "kind": JobKind(row["kind"])})
                answers[record.number] = record
            elif "dropped" in row:
                dropped.add(int(row["dropped"]))
            elif "late_s" in row:
                lateness[int(row["frame"])] = Lateness(row["late_s"], row["held_s"])
            elif "ended" in row:
                last_frame, interrupted = row["ended"], bool(row["interrupted"])
        return cls(header, answers, frozenset(dropped), lateness, last_frame, interrupted)

    @classmethod
    def read(cls, path: Path) -> Recorded:
        """Read ``schedule.jsonl``.

        Raises `InputError` if it is not there, or no schedule of this version.
        """
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except OSError as error:
            raise InputError(
                f"{path}: {error.strerror or error}; --replay takes the folder of a run that has left its schedule."
            ) from error
        rows = []
        for number, line in enumerate(lines, 1):
            try:
                rows.append(json.loads(line))
            except ValueError as error:
                if number == len(lines):
                    break  # the run was cut off in the middle of it
                raise InputError(f"{path}: line {number} is no JSON; take the file as the run has left it.") from error
        if not rows or rows[0].get("schedule") != VERSION:
            raise InputError(f"{path} is no schedule of version {VERSION}; run the source again to get one.")
        try:
            return cls.of(rows)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} is no schedule of version {VERSION} ({error}); run the source again.") from error

    def is_due(self, request: Request, step: int, frame: When) -> bool:
        """Whether the record has used the answer by this frame."""
        record = self.record_of(request)
        if record is None:
            return self._stated.is_due(request, step, frame)
        return record.used is not None and record.used == frame and not record.drained

    def record_of(self, request: Request) -> AnswerRecord | None:
        """Return what the record says of a request; None once the run has come apart from it."""
        if self.departure:
            return None
        record = self.answers.get(request.number)
        if record is None:
            if self.last_frame is not None:
                self.depart(request.frame, f"it asks for {_described(request)}, and the record ends before that")
            return None
        asked = record.kind, record.submap, record.requested
        if asked != (request.kind, request.submap, request.frame):
            was = f"{record.kind}{'' if record.submap is None else f' of submap {record.submap}'}"
            self.depart(request.frame, f"it asks for {_described(request)}; the record has {was} at {record.requested}")
            return None
        return record

    def depart(self, frame: When, why: str) -> None:
        """Note where the repetition comes apart from the record; from there on answers come as by default."""
        if not self.departure:
            self.departure = f"frame {frame}: {why}"

    @property
    def _stated(self) -> After:
        """The recorded run's schedule, if it had no clock. It also serves after a departure from the record."""
        delays = self.header.get("delays")
        if delays is None:
            return After()
        return After({JobKind(kind): math.inf if frames is None else frames for kind, frames in delays.items()})

    def limit_of(self, request: Request) -> Limit:
        """Return after how many steps the job was stopped."""
        record = self.record_of(request)
        return Limit() if record is None else Limit(after_steps=record.steps)

    def note_end(self, n_requests: int) -> None:
        """Compare the record with how many requests there were, when the run has ended."""
        more = [record for number, record in self.answers.items() if number >= n_requests]
        if more:
            self.depart(AT_END, f"it has asked for {n_requests} jobs, and the record for {len(more)} more")


def _described(request: Request) -> str:
    return f"{request.kind}{'' if request.submap is None else f' of submap {request.submap}'} at {request.frame}"


def header_of(policy: Policy, in_real_time: bool, **given: Any) -> dict[str, Any]:
    """Return the first line of a schedule: its version, what was stated, and what else is `given` of the run."""
    delays = None
    if isinstance(policy, After):
        delays = {str(kind): None if math.isinf(frames) else frames for kind, frames in policy.frames.items()}
    return {"schedule": VERSION, "realtime": in_real_time, "delays": delays, **given}
