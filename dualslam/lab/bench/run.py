"""Run a bench: the trials that have no line yet, one folder and one line each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from dualslam.core.config.files import dump_config
from dualslam.core.errors import OutputError
from dualslam.io.atomic import write_text
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.record import TrialRecord
from dualslam.lab.bench.spec import BenchSpec
from dualslam.lab.bench.trial_log import TRIALS, TrialLog

log = logging.getLogger(__name__)

SPEC = "bench.yaml"
FOLDERS = "trials"

Executor = Callable[[Iterable[Trial]], Iterator[TrialRecord]]


def run_bench(
    spec: BenchSpec,
    trials: list[Trial],
    out: Path,
    execute: Executor,
    on_trial: Callable[[TrialRecord, int, int], None] | None = None,
    limit: int | None = None,
) -> list[TrialRecord]:
    """Run what is not done yet, and return the lines of the trials that are done, in their planned order.

    A bench that was killed goes on where it was. Where a spec has been changed since, the trials that are other ones
    now run again, and the rest counts.

    Parameters
    ----------
    spec : BenchSpec
    trials : list of Trial
    out : Path
    execute : callable
        Runs trials and yields their records as they come.
    on_trial : callable, optional
        Called with each record that is new, how many trials are done, and how many there are.
    limit : int, optional
        Run so many trials at most.

    Raises
    ------
    InputError, OutputError
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out} cannot be written to: {error.strerror or error}; choose another folder.") from error
    write_text(out / SPEC, dump_config(spec))
    trial_log = TrialLog(out / TRIALS)
    done = trial_log.done(trials)
    if done:
        log.info("%d of %d trials are done already", len(done), len(trials))
    for record in execute([trial for trial in trials if trial.key not in done][:limit]):
        trial_log.append(record)
        done[record.key] = record
        if on_trial is not None:
            on_trial(record, len(done), len(trials))
    return [done[trial.key] for trial in trials if trial.key in done]


def trial_folder(out: Path, trial: Trial) -> Path:
    """Return where a trial's run belongs."""
    return out / FOLDERS / trial.key
