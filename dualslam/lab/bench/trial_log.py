"""``trials.jsonl``: one line a trial, on the disk as soon as the trial is over. What a killed bench goes on from."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from dualslam.core.errors import InputError, OutputError
from dualslam.io.map_files import to_plain
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.record import TrialRecord

TRIALS = "trials.jsonl"


class TrialLog:
    """The lines of a bench. Only the process that runs the bench writes; trials hand their lines to it.

    Parameters
    ----------
    path : Path
        The file; a last line that a crash cut off is taken away, and its trial runs again.

    Raises
    ------
    InputError
        Where another line is not one of a trial.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.records: list[TrialRecord] = []
        try:
            text = path.read_bytes() if path.exists() else b""
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
        whole, newline, cut = text.rpartition(b"\n")
        for number, line in enumerate(whole.splitlines(), 1):
            self.records.append(_parse(line, f"{path}, line {number}"))
        if cut:
            self._truncate(len(whole + newline))

    def done(self, trials: Iterable[Trial]) -> dict[str, TrialRecord]:
        """Return the lines of those trials that are here, by key. A line of a trial that has changed does not count."""
        wanted = {trial.key: trial.fingerprint for trial in trials}
        return {r.key: r for r in self.records if wanted.get(r.key) == r.fingerprint}

    def append(self, record: TrialRecord) -> None:
        """Write a line with one system call and wait until it is on the disk.

        Raises
        ------
        OutputError
        """
        line = (json.dumps(to_plain(record.as_dict()), allow_nan=False) + "\n").encode()
        try:
            handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            try:
                os.write(handle, line)
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError as error:
            raise OutputError(f"{self._path} cannot be written: {error.strerror or error}.") from error
        self.records.append(record)

    def _truncate(self, size: int) -> None:
        try:
            os.truncate(self._path, size)
        except OSError as error:
            raise OutputError(f"{self._path} cannot be written: {error.strerror or error}.") from error


def _parse(line: bytes, where: str) -> TrialRecord:
    try:
        return TrialRecord.from_dict(json.loads(line))
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{where} is not the line of a trial ({error}); choose another folder for the bench."
        ) from None
