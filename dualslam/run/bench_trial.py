"""One trial of a bench: open, run, measure. What `dualslam.lab.bench` is handed to run."""

from __future__ import annotations

import json
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

from dualslam.core.config.files import config_from_dict
from dualslam.core.errors import DualSlamError
from dualslam.core.interfaces import Sequence
from dualslam.core.resources import keep_freed_memory, limit_threads
from dualslam.core.types import Failure
from dualslam.io.atomic import write_text
from dualslam.io.run_reading import read_frames
from dualslam.io.trajectory_files import Trajectory
from dualslam.lab.audits.link_audit import audit_links
from dualslam.lab.bench.measure import breakages, end_point_error, initialisation, status_letters, trajectory_error
from dualslam.lab.bench.plan import SourceInfo, Trial
from dualslam.lab.bench.record import LinkError, TrialOutcome, TrialRecord, blank_record
from dualslam.lab.bench.run import trial_folder
from dualslam.lab.bench.spec import SequenceSpec
from dualslam.lab.bench.truth import are_untrue, compare, read_verdict, submaps_of, true_frames
from dualslam.map.frame_records import FrameResult
from dualslam.run.session import Outcome, run_to_folder
from dualslam.run.sources import SYNTHETIC, open_source

ERROR_LOG, TRIAL = "error.log", "trial.json"


class _TimedOutError(Exception):
    """The trial took longer than it may."""


def describe_source(sequence: SequenceSpec, data: Path | None) -> SourceInfo:
    """Open a sequence so far that its length is known.

    `data`: the folder in which paths are sought.

    Raises `InputError`.
    """
    source = sequence.source if sequence.source.startswith(SYNTHETIC) else _place(sequence.source, data)
    camera = _place(sequence.camera, data) if sequence.camera else ""
    opened = open_source(source, camera_file=camera or None)
    return SourceInfo(source, camera, len(opened), opened.rate_hz)


def run_trial(trial: Trial, out: str) -> TrialRecord:
    """Run a trial into its folder under `out`, and return its line. Whatever goes wrong in it is in the line.

    Raises `KeyboardInterrupt`: where a signal ended the run early: that is no result.
    """
    limit_threads()
    keep_freed_memory()
    began = time.perf_counter()
    folder = trial_folder(Path(out), trial)
    try:
        return replace(_run(trial, folder, began), wall_s=time.perf_counter() - began)
    except _TimedOutError as error:
        return blank_record(trial, TrialOutcome.TIMED_OUT, str(error), time.perf_counter() - began)
    except Exception as error:  # a failed trial is a result, and stays in the tables
        if not isinstance(error, DualSlamError):
            write_text(folder / ERROR_LOG, traceback.format_exc())
        said = " ".join(f"{type(error).__name__}: {error}".split())[:500]
        return blank_record(trial, TrialOutcome.CRASHED, said, time.perf_counter() - began)


def _run(trial: Trial, folder: Path, began: float) -> TrialRecord:
    sequence = open_source(
        trial.source,
        camera_file=trial.camera or None,
        start=trial.start,
        stride=trial.stride,
        max_frames=trial.max_frames or None,
    )

    def watch(result: FrameResult) -> None:
        if trial.timeout_s is not None and time.perf_counter() - began > trial.timeout_s:
            raise _TimedOutError(f"longer than {trial.timeout_s:g} s; it was at frame {result.index}")

    config = config_from_dict(trial.config, trial.key)
    # With config.yaml beside it, all that the run is made of.
    frames = {"source": trial.source, "start": trial.start, "stride": trial.stride, "max_frames": trial.max_frames}
    write_text(folder / TRIAL, json.dumps(frames | {"camera": trial.camera}, indent=2) + "\n")
    outcome = run_to_folder(config, sequence, folder, overwrite=True, on_frame=watch)
    if outcome.report.interrupted:
        raise KeyboardInterrupt
    return _measure(trial, folder, sequence, outcome)


def _measure(trial: Trial, folder: Path, sequence: Sequence, outcome: Outcome) -> TrialRecord:
    rows, events = read_frames(folder / "frames.csv"), list(outcome.system.events)
    initialised_at, initialised_after_s = initialisation(rows, events)
    losses = breakages(events)
    record = replace(
        blank_record(trial, TrialOutcome.DONE, ""),
        status=status_letters(rows),
        initialised_at=initialised_at,
        initialised_after_s=initialised_after_s,
        breakages=losses,
        cpu_s=outcome.report.cpu_s,
        **read_verdict(outcome.summary),
    )
    truth: Trajectory | None = getattr(sequence, "ground_truth", None)
    if truth is None:
        return record
    corruptions = config_from_dict(trial.config, trial.key).corruptions
    source: Any = sequence  # recorded or rendered: it knows its frames
    frames = true_frames(source.source_indices, source.frame_timestamps, truth, corruptions)
    main = outcome.trajectories.main
    on_true_clock, known = frames.on_true_clock(main), frames.truth
    trusted = known.take(~are_untrue(known.index, trial.truth_breaks))
    if len(main) and len(trusted):
        ate_m, path_m = trajectory_error(on_true_clock, trusted, frames.times_s)
        record = replace(record, ate_m=ate_m, path_m=path_m)
    return replace(
        record,
        end_point_error_m=end_point_error(on_true_clock, known) if trial.returns_to_start else None,
        links=_link_errors(outcome, known),
        **compare(
            frames,
            main,
            submaps_of(rows, main.index),
            initialised_at,
            losses,
            repeats_m=trial.repeats_m,
            truth_breaks=trial.truth_breaks,
        ),
    )


def _link_errors(outcome: Outcome, truth: Trajectory) -> tuple[LinkError, ...]:
    true = dict(zip(truth.index.tolist(), truth.T_world_cam, strict=True))
    audits = audit_links(outcome.system.atlas, outcome.system.poses.values(), true)
    return tuple(LinkError(a.worst_scale, a.rotation_deg, a.position) for a in audits if not isinstance(a, Failure))


def _place(path: str, data: Path | None) -> str:
    return str(data / path) if data is not None else path
