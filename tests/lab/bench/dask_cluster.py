"""A Dask scheduler and its workers, each a process of its own, on loopback."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Cluster:
    address: str
    workers: list[subprocess.Popen[bytes]]


@contextmanager
def dask_cluster(folder: Path, n_workers: int = 2) -> Iterator[Cluster]:
    info = folder / "scheduler.json"
    processes = [start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(info))]
    try:
        address = address_in(info)
        workers = [
            start("dask_worker", address, "--nthreads", "1", "--no-nanny", "--local-directory", str(folder / f"{i}"))
            for i in range(n_workers)
        ]
        processes += workers
        yield Cluster(address, workers)
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


def start(command: str, *options: str) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", f"distributed.cli.{command}", *options, "--no-dashboard"]
    return subprocess.Popen(words, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def address_in(info: Path) -> str:
    for _ in range(600):
        if info.exists() and info.stat().st_size:
            return str(json.loads(info.read_text())["address"])
        time.sleep(0.1)
    raise AssertionError("the scheduler did not start")
