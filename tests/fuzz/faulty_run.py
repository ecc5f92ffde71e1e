"""One run to which something happens on the way: ``python -m tests.fuzz.faulty_run KIND SEED CPU_S SOURCE OUT``."""

from __future__ import annotations

import os
import pkgutil
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import dualslam.run.session
from dualslam.cli import main
from dualslam.core.errors import SolverError

SIGNALS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM, "kill": signal.SIGKILL}
KINDS = (*SIGNALS, "full_disk", "solver", "workers")
SAVE_S = 0.25
SINGULAR = RuntimeError("Indeterminant linear system detected while working near variable x1")
SOLVERS: tuple[tuple[str, Exception], ...] = (
    ("gtsam.ISAM2.update", SINGULAR),
    ("gtsam.ISAM2.calculateEstimate", SINGULAR),
    ("gtsam.Marginals.marginalCovariance", SINGULAR),
    ("gtsam.LevenbergMarquardtOptimizer.optimize", SINGULAR),
    ("dualslam.backend.schur.System.step", SolverError("no optimum")),
    ("dualslam.backend.schur.System.about_lens", SolverError("not definite")),
)
"""What fails once, and how."""


def happen_at(cpu_s: float, act: Callable[[], None]) -> None:
    """Do something once this process has used so much time."""
    signal.signal(signal.SIGPROF, lambda *_: act())
    signal.setitimer(signal.ITIMER_PROF, cpu_s)


def fill_disk() -> None:
    """Let no file grow any more."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


def kill_workers(rng: np.random.Generator) -> None:
    """Kill some of the processes that compute beside this one."""
    for task in Path("/proc/self/task").iterdir():
        for child in (task / "children").read_text().split():
            if rng.random() < 0.6 and b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(int(child), signal.SIGKILL)


def fail_at(nth: int, name: str, error: Exception) -> None:
    """Let the nth call of a function raise."""
    n_calls = 0

    def function(*args: Any, **kwargs: Any) -> Any:
        nonlocal n_calls
        n_calls += 1
        if n_calls == nth:
            raise error
        return real(*args, **kwargs)

    real = pkgutil.resolve_name(name)
    mock.patch(name, function).start()


def report_frames() -> None:
    """Print how many frames there were, and the time, after each."""
    write_if_due = dualslam.run.session._PosesSoFar.write_if_due

    def function(poses_so_far: Any) -> None:
        now_s = time.monotonic()
        write_if_due(poses_so_far)
        os.write(1, f"{len(poses_so_far._system.rows)} {now_s}\n".encode())

    mock.patch("dualslam.run.session._PosesSoFar.write_if_due", function).start()


def run(kind: str, seed: int, cpu_s: float, source: str, out: str) -> int:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    at_s = rng.uniform(0.0, cpu_s)
    dualslam.run.session.SAVE_S, dualslam.run.session.SAVING_SHARE = SAVE_S, float("inf")
    report_frames()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have told its background not to mind it
    if kind in SIGNALS:
        happen_at(at_s, lambda: os.kill(os.getpid(), SIGNALS[kind]))
    elif kind == "full_disk":
        happen_at(at_s, fill_disk)
    elif kind == "workers":
        happen_at(at_s / 2.0, lambda: kill_workers(rng))
    else:
        name, error = SOLVERS[rng.integers(len(SOLVERS))]
        fail_at(int(np.exp(rng.uniform(0.0, np.log(100.0)))), name, error)
    workers = ["--workers", "1"] if kind == "workers" else ["--inline"]
    status = main(["run", source, "--out", out, "--quiet", *workers])
    signal.setitimer(signal.ITIMER_PROF, 0.0)  # the interpreter ends without its handler
    return status


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), *sys.argv[4:]))
