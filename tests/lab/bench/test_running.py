"""One line a trial, whatever happens to the processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import pytest

from dualslam.core.errors import InputError
from dualslam.lab.bench.cluster import run_on_cluster
from dualslam.lab.bench.plan import Trial, plan_trials
from dualslam.lab.bench.pool import run_in_processes
from dualslam.lab.bench.record import TrialOutcome, TrialRecord
from dualslam.lab.bench.run import Executor, run_bench
from dualslam.lab.bench.tables import bench_tables
from dualslam.lab.bench.trial_log import TRIALS, TrialLog
from dualslam.testing.waiting import wait_until
from tests.lab.bench import fakes
from tests.lab.bench.dask_cluster import Cluster, dask_cluster
from tests.lab.bench.fakes import SPEC, describe, processes_in, run_fake, runs_in


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    return plan_trials(SPEC, describe)


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    (tmp_path / "notes").mkdir()
    return tmp_path / "notes"


def in_this_process(trials: Iterable[Trial]) -> Iterator[TrialRecord]:
    return map(run_fake, trials)


def tables_of(records: list[TrialRecord]) -> list[str]:
    return [table.csv() for table in bench_tables(SPEC, records)]


@pytest.fixture(scope="module")
def undisturbed(trials: list[Trial]) -> list[str]:
    return tables_of(list(map(run_fake, trials)))


def test_records_come_back_as_they_were(trials: list[Trial], tmp_path: Path) -> None:
    records = run_bench(SPEC, trials, tmp_path, in_this_process)
    assert TrialLog(tmp_path / TRIALS).records == records == list(map(run_fake, trials))
    assert len((tmp_path / TRIALS).read_text().splitlines()) == len(trials)


def test_a_killed_bench_goes_on_where_it_was(
    trials: list[Trial], tmp_path: Path, notes: Path, undisturbed: list[str]
) -> None:
    def killed(todo: Iterable[Trial]) -> Iterator[TrialRecord]:
        yield from map(run_fake, list(todo)[:7])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_bench(SPEC, trials, tmp_path, killed)
    with (tmp_path / TRIALS).open("a") as file:
        file.write('{"key": "a/nat')  # killed while it wrote
    again = partial(fakes.run_and_note, folder=str(notes))
    records = run_bench(SPEC, trials, tmp_path, lambda todo: map(again, todo))
    assert len(runs_in(notes)) == len(trials) - 7
    assert tables_of(records) == undisturbed
    assert len(TrialLog(tmp_path / TRIALS).records) == len(trials)


def test_a_changed_trial_runs_again(trials: list[Trial], tmp_path: Path, notes: Path) -> None:
    run_bench(SPEC, trials, tmp_path, in_this_process)
    changed = SPEC.model_copy(
        update={"variants": (SPEC.variants[0], SPEC.variants[1].model_copy(update={"set": {"health.min_inliers": 30}}))}
    )
    again = partial(fakes.run_and_note, folder=str(notes))
    records = run_bench(changed, plan_trials(changed, describe), tmp_path, lambda todo: map(again, todo))
    assert all("_Dual_" in name for name in runs_in(notes))
    assert len(runs_in(notes)) == len(records) / 2


def test_a_line_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / TRIALS).write_text('{"key": 3}\n')
    with pytest.raises(InputError, match=r"trials.jsonl, line 1 is not the line of a trial"):
        TrialLog(tmp_path / TRIALS)


def test_processes_run_all_trials(trials: list[Trial], tmp_path: Path, notes: Path, undisturbed: list[str]) -> None:
    run = partial(fakes.run_and_note, folder=str(notes))
    records = run_bench(SPEC, trials, tmp_path, lambda todo: run_in_processes(run, todo, 2))
    assert tables_of(records) == undisturbed
    assert len(processes_in(notes)) == 2
    assert str(os.getpid()) not in processes_in(notes)


def test_a_process_that_dies_costs_its_trial_alone(trials: list[Trial], tmp_path: Path, notes: Path) -> None:
    run = partial(fakes.run_or_die, folder=str(notes))
    records = {r.key: r for r in run_bench(SPEC, trials, tmp_path, lambda todo: run_in_processes(run, todo, 2))}
    assert len(records) == len(trials)
    died = records.pop("a/natural/base/01")
    assert (died.outcome, died.error) == (TrialOutcome.CRASHED, "the process died with exit code 7")
    expected = {t.key: run_fake(t) for t in trials}
    assert all(record == expected[key] for key, record in records.items())


def test_no_process_outlives_a_bench_that_is_killed(notes: Path) -> None:
    """Or the bench that goes on where this one was would find its trials' folders in use."""
    code = f"from tests.lab.bench.fakes import bench_for_long; bench_for_long({str(notes)!r})"
    root = Path(__file__).parents[3]
    bench = subprocess.Popen([sys.executable, "-c", code], cwd=root)
    try:
        wait_until(lambda: len(list(notes.iterdir())) == 2)
    finally:
        bench.kill()
        bench.wait()
    for file in notes.iterdir():
        wait_until(lambda pid=int(file.name): not running(pid))  # type: ignore[misc]


def running(pid: int) -> bool:
    try:
        # A zombie that nobody has buried runs no more.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with dask_cluster(tmp_path) as running:
        yield running


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_tables(
    cluster: Cluster,
    trials: list[Trial],
    tmp_path: Path,
    notes: Path,
    undisturbed: list[str],
) -> None:
    address, workers = cluster.address, cluster.workers
    killed = []

    def kill_one(record: TrialRecord, n_done: int, n: int) -> None:
        if not killed and len(processes_in(notes)) == 2:
            workers[0].send_signal(signal.SIGKILL)
            workers[0].wait()
            killed.append(n_done)

    run = partial(fakes.run_slowly, folder=str(notes))
    execute: Executor = lambda todo: run_on_cluster(run, todo, address)  # noqa: E731
    records = run_bench(SPEC, trials, tmp_path, execute, kill_one)
    assert killed
    assert killed[0] < len(trials) - 3
    assert tables_of(records) == undisturbed
    assert processes_in(notes) == {str(process.pid) for process in workers}


def test_no_scheduler_is_told_in_one_sentence(trials: list[Trial], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dualslam.lab.bench.cluster.CONNECT_S", 1)
    with pytest.raises(InputError, match=r"No Dask scheduler answers at tcp://127.0.0.1:9"):
        list(run_on_cluster(run_fake, trials, "tcp://127.0.0.1:9"))
