"""Trials with the real system, and the command."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import pytest

from dualslam.cli import main
from dualslam.lab.bench.plan import Trial, plan_trials
from dualslam.lab.bench.record import FailureKind, TrialOutcome, TrialRecord, faults_of, judge
from dualslam.lab.bench.spec import BenchSpec, RightRun, load_spec
from dualslam.lab.bench.trial_log import TrialLog
from dualslam.run.bench_trial import describe_source, run_trial
from tests.cli.conftest import _own_environment  # noqa: F401 (used by every test)
from tests.lab.bench.dask_cluster import dask_cluster

SPEC = """
name: tiny
sequences:
  - {name: room, source: "synthetic:room,frames=50,seed=2,width=480,height=360", frames: 40, returns_to_start: true}
variants: [{name: base, set: {recovery.enabled: false}}]
conditions: [{name: gap, corruptions: [{kind: drop, frames: 3}]}]
trials: 1
"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> BenchSpec:
    path = tmp_path_factory.mktemp("spec") / "tiny.yaml"
    path.write_text(SPEC)
    return load_spec(path)


@pytest.fixture(scope="module")
def trial(spec: BenchSpec) -> Trial:
    (trial,) = plan_trials(spec, lambda sequence: describe_source(sequence, None))
    return trial


@dataclass(frozen=True)
class Done:
    """A bench that the command has run: its folder, the only line, and what was printed."""

    command: list[str]
    out: Path
    record: TrialRecord
    printed: str
    told: str


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "tiny.yaml").write_text(SPEC)
    command = ["bench", str(folder / "tiny.yaml"), "--out", str(folder / "out"), "--jobs", "1"]
    with redirect_stdout(StringIO()) as printed, redirect_stderr(StringIO()) as told:
        assert main(command) == 0
    (record,) = TrialLog(folder / "out" / "trials.jsonl").records
    return Done(command, folder / "out", record, printed.getvalue(), told.getvalue())


@pytest.mark.slow
def test_a_trial_is_a_run_folder_and_a_line(spec: BenchSpec, trial: Trial, done: Done, tmp_path: Path) -> None:
    record, out = done.record, done.out
    assert record.outcome is TrialOutcome.DONE, record.error
    assert len(record.status) == 37
    assert record.initialised_at is not None
    assert record.coverage > 0.95
    assert record.ate_m is not None
    assert record.path_m is not None
    assert record.end_point_error_m is not None
    assert judge(record, spec.thresholds) is None
    # 1.2 s are too short for a stretch to be judged; the rest of what makes a run right is there.
    assert (record.level, record.judged, record.is_still) == ("good", 0, False)
    assert record.n_clear == record.n_clear_posed > 25
    assert faults_of(record, RightRun()) == ()
    run = out / "trials" / "room" / "gap" / "base" / "00"
    assert json.loads((run / "summary.json").read_text())["ate_rmse_m"] == pytest.approx(record.ate_m)
    assert json.loads((run / "trial.json").read_text())["start"] == trial.start
    # The same trial again takes the place of the first, with the same result but for its times.
    shutil.copytree(out, tmp_path / "again")
    again = run_trial(trial, str(tmp_path / "again"))
    assert replace(again, wall_s=record.wall_s, cpu_s=record.cpu_s) == record


def test_what_goes_wrong_is_in_the_line(trial: Trial, tmp_path: Path) -> None:
    missing = run_trial(replace(trial, source=str(tmp_path / "nowhere")), str(tmp_path))
    assert missing.outcome is TrialOutcome.CRASHED
    assert "does not exist" in missing.error
    late = run_trial(replace(trial, timeout_s=1e-3), str(tmp_path))
    assert late.outcome is TrialOutcome.TIMED_OUT
    assert judge(late, BenchSpec.model_fields["thresholds"].default) is FailureKind.TIMED_OUT


def test_a_bug_leaves_its_traceback_in_the_folder(
    trial: Trial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("dualslam.run.bench_trial.run_to_folder", broken)
    record = run_trial(trial, str(tmp_path))
    assert (record.outcome, record.error) == (TrialOutcome.CRASHED, "ZeroDivisionError: by zero")
    assert "ZeroDivisionError" in (tmp_path / "trials" / trial.key / "error.log").read_text()


@pytest.mark.slow
def test_the_command_writes_tables_and_runs_nothing_twice(done: Done, capsys: pytest.CaptureFixture[str]) -> None:
    assert "### Table II: failures" in done.printed
    assert "1/1 room/gap/base/00: good" in done.told
    lines, page = (done.out / "trials.jsonl").read_text(), (done.out / "tables.md").read_text()
    assert main(done.command) == 0
    assert capsys.readouterr().err == ""
    assert ((done.out / "trials.jsonl").read_text(), (done.out / "tables.md").read_text()) == (lines, page)


@pytest.mark.slow
def test_a_cluster_gives_the_line_that_this_machine_gives(trial: Trial, done: Done, tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(SPEC)
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 1) as cluster:
        command = ["bench", str(tmp_path / "tiny.yaml"), "--out", str(out), "--scheduler", cluster.address]
        assert main([*command, "--quiet"]) == 0
    (line,) = TrialLog(out / "trials.jsonl").records
    here = done.record
    assert here.outcome is TrialOutcome.DONE
    assert replace(here, wall_s=line.wall_s, cpu_s=line.cpu_s) == line
    runs = [each / "trials" / trial.key / "trajectory.txt" for each in (out, done.out)]
    assert runs[0].read_bytes() == runs[1].read_bytes()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--data", "/nowhere"], "--data /nowhere is no folder"),
        (["--only", "road"], "has no sequence road; it has room"),
        (["--jobs", "0"], "must be a whole number of at least 1"),
    ],
)
def test_bad_usage_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    (tmp_path / "tiny.yaml").write_text(SPEC)
    assert main(["bench", str(tmp_path / "tiny.yaml"), "--out", str(tmp_path / "out"), *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
