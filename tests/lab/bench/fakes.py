"""Trials that take no time: the outcome of one depends on its numbers alone."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dualslam.lab.bench.plan import SourceInfo, Trial, plan_trials
from dualslam.lab.bench.pool import run_in_processes
from dualslam.lab.bench.record import Breakage, LinkError, TrialOutcome, TrialRecord, blank_record
from dualslam.lab.bench.spec import BenchSpec, SequenceSpec

SPEC = BenchSpec.model_validate_json("""{
  "name": "fake",
  "sequences": [
    {"name": "a", "source": "a", "frames": 100, "group": "one"},
    {"name": "b", "source": "b", "frames": 100, "group": "two", "returns_to_start": true}],
  "variants": [{"name": "base", "set": {"recovery.enabled": false}}, {"name": "Dual"}],
  "conditions": [
    {"name": "natural"},
    {"name": "blackout", "corruptions": [{"kind": "blackout", "seconds": 0.5}]},
    {"name": "fault", "corruptions": [{"kind": "wrong_pose", "frames": 1}], "sequences": ["a"]}],
  "trials": 3
}""")


def describe(sequence: SequenceSpec) -> SourceInfo:
    return SourceInfo(sequence.source, "", 1000, 20.0)


def run_fake(trial: Trial) -> TrialRecord:
    """The base fails where there is a black-out; Dual links it at its first or second attempt, or crashes."""
    blank = replace(blank_record(trial, TrialOutcome.DONE, ""), initialised_at=4, initialised_after_s=0.2)
    good = replace(blank, status="T" * 100, ate_m=0.5 + 0.1 * trial.number, path_m=100.0, end_point_error_m=0.3)
    if trial.condition == "natural":
        return good
    lost = Breakage(50, 0, "too_few_matches", 10, 0.5)
    if trial.variant == "base":
        return replace(blank, status="T" * 50 + "l" * 9 + "i" * 41, ate_m=0.1, path_m=50.0, breakages=(lost,))
    if trial.number == 2:
        return blank_record(trial, TrialOutcome.CRASHED, "ZeroDivisionError: by zero")
    attempt = 1 + trial.number
    found = replace(lost, attempts=attempt, succeeded_at=attempt, recovery_s=2.0 * attempt)
    return replace(good, breakages=(found,), links=(LinkError(0.01, 0.1, 0.001),))


def run_and_note(trial: Trial, folder: str) -> TrialRecord:
    """The same, noting that it was run, and by whom."""
    path = Path(folder) / f"{trial.key.replace('/', '_')}.{time.time_ns()}.{os.getpid()}"
    path.touch()
    return run_fake(trial)


def run_or_die(trial: Trial, folder: str) -> TrialRecord:
    """One trial takes its process with it, another one hangs."""
    if trial.key == "a/natural/base/01":
        os._exit(7)
    return run_and_note(trial, folder)


def run_slowly(trial: Trial, folder: str) -> TrialRecord:
    time.sleep(0.3)
    return run_and_note(trial, folder)


def run_for_long(trial: Trial, folder: str) -> TrialRecord:
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(120)
    return run_fake(trial)


def bench_for_long(folder: str) -> None:
    """What a process does that will be killed."""
    list(run_in_processes(partial(run_for_long, folder=folder), plan_trials(SPEC, describe), 2))


def runs_in(folder: Path) -> list[str]:
    return sorted(file.name.split(".")[0] for file in folder.iterdir())


def processes_in(folder: Path) -> set[str]:
    return {file.name.rsplit(".", 1)[1] for file in folder.iterdir()}


def starts_of(trials: list[Trial]) -> np.ndarray:
    return np.array([trial.start for trial in trials])
