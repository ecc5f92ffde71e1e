"""`make faults`: what happens to a run, by seed: it is killed, its disk is full, its solver fails. It loses nothing.

A loss is printed with the kind and seed that repeat it. Times are CPU times of the process, so a repetition is alike
and not the same.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from dualslam.core.errors import DualSlamError
from dualslam.core.types import BoolArray
from dualslam.io.map_store import load_atlas
from dualslam.io.run_folder import FRAMES, TRAJECTORY
from dualslam.io.run_reading import read_frames
from dualslam.io.trajectory_files import read_tum
from dualslam.lab.synthetic import render_to_folder
from dualslam.report import read_run
from dualslam.run.sources import parse_world
from tests.fuzz.faulty_run import KINDS, SAVE_S
from tests.fuzz.many import Trial, make_many

BLACK = slice(36, 43)
"""Frames of a street: a map is lost there, another begins, and both are joined."""
ENDS = {
    "interrupt": {0, 130},
    "terminate": {0, 130, -signal.SIGTERM},
    "kill": {0, -signal.SIGKILL},
    "full_disk": {0, 2},
    "solver": {0},
    "workers": {0},
}
"""Exit statuses that are right. A signal that comes before the run, or behind it, acts as always."""
WRITING_S = 1.0
"""What writing takes, at most, with the time to wait for that before."""
LEAST_SHARE = 0.9
"""Of the frames that an undisturbed run poses: a failed solver or worker may cost a few."""


@dataclass(frozen=True)
class Bench:
    """A recording, and what an undisturbed run of it costs and finds.

    Attributes
    ----------
    source : Path
    cpu_s : float
        Of the command.
    is_posed : (N,) bool
    """

    source: Path
    cpu_s: float
    is_posed: BoolArray

    @classmethod
    def build(cls, folder: Path) -> Bench:
        """Render the recording, and run it."""
        source = folder / "street"
        render_to_folder(parse_world("synthetic:street,frames=70,width=320,height=240,seed=1"), source)
        for name in np.array(sorted((source / "images").iterdir()))[BLACK]:
            cv2.imwrite(str(name), np.zeros((240, 320), np.uint8))
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "dualslam", "run", str(source), "--out", str(folder / "sound")]
        run = subprocess.run([*command, "--quiet", "--inline"])
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run.returncode == 0
        is_posed = [row.in_main_map for row in read_frames(folder / "sound" / FRAMES)]
        return cls(source, after.ru_utime - before.ru_utime, np.array(is_posed, bool))

    def n_posed_of(self, n_frames: int) -> int:
        """How many of the first frames an undisturbed run poses, where it is given no more of them."""
        return int(self.is_posed[: min(n_frames, BLACK.start) if n_frames < len(self.is_posed) else n_frames].sum())


def tried(kind: str, seed: int, out: Path, bench: Bench) -> tuple[int, str | None]:
    """Make one case; return its exit status, and what is wrong with what it said and left, or None."""
    command = [sys.executable, "-m", "tests.fuzz.faulty_run", kind, str(seed), str(bench.cpu_s)]
    done = subprocess.run([*command, str(bench.source), str(out)], capture_output=True, text=True, timeout=300)
    said = [line for line in done.stderr.splitlines() if not line.startswith("WARNING ")]
    if done.returncode not in ENDS[kind]:
        return done.returncode, f"status {done.returncode}: {done.stderr}"
    if done.returncode == 2 and (len(said) != 1 or not said[0].startswith("dualslam: ")):
        return done.returncode, f"not one sentence: {done.stderr}"
    try:
        return done.returncode, _lost(done.returncode, done.stdout, out, bench)
    except (DualSlamError, ValueError) as error:
        return done.returncode, f"a file cannot be read: {error!r}"


def _lost(status: int, progress: str, out: Path, bench: Bench) -> str | None:
    """Return what is missing in a run folder, or None; raise where a file cannot be read.

    `progress`: a line after each frame: how many there were, and the time.
    """
    n_frames, when_s = np.array([line.split() for line in progress.splitlines()], float).reshape(-1, 2).T
    for file in out.glob("*.jsonl"):
        for row in file.read_text().split("\n")[:-1]:
            json.loads(row)
    rows = read_frames(out / FRAMES) if (out / FRAMES).exists() else []
    n_posed = len(read_tum(out / TRAJECTORY)) if (out / TRAJECTORY).exists() else 0
    if status in (0, 130) and len(n_frames):
        load_atlas(out)
        read_run(out)
        n_due = int(n_frames[-1])
    else:
        n_due = int(n_frames[when_s <= when_s[-1:] - SAVE_S - WRITING_S].max(initial=0))
    if len(rows) < n_due or [row.index for row in rows] != list(range(len(rows))):
        return f"{len(rows)} rows of frames for {n_due} frames"
    if n_posed < LEAST_SHARE * bench.n_posed_of(n_due):
        return f"{n_posed} frames are posed; without a fault, {bench.n_posed_of(n_due)} of {n_due}"
    return None


def prepare(folder: Path) -> Trial:
    return partial(tried, bench=Bench.build(folder))


if __name__ == "__main__":
    sys.exit(make_many("faults", str(__doc__), KINDS, 200, prepare))
