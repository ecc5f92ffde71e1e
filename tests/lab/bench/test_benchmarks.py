"""The benches that come with the project, on folders of the layouts that they are for."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.config.corruption import Cause
from dualslam.core.errors import InputError
from dualslam.lab.bench.plan import SourceInfo, plan_trials
from dualslam.lab.bench.record import FailureKind, TrialOutcome, judge
from dualslam.lab.bench.spec import Half, load_spec
from dualslam.run.bench_trial import describe_source, run_trial

FOLDER = Path(__file__).parents[3] / "benchmarks"
N = 60


@pytest.mark.parametrize("name", ["kitti", "tum_mono", "failure_lab", "failures", "sample", "against_cpp", "smoke"])
def test_every_bench_can_be_planned(name: str) -> None:
    spec = load_spec(FOLDER / f"{name}.yaml")
    assert (spec.name, spec.reference_name) == (name, "base")
    trials = plan_trials(spec, lambda sequence: SourceInfo(sequence.source, "", 5000, 10.0))
    assert len({trial.key for trial in trials}) == len(trials)
    assert all(t.config["recovery"]["enabled"] == (t.variant != "base") for t in trials)


def test_the_papers_trials() -> None:
    """110 trials of KITTI and 500 of TUM-Mono for each variant: 610."""
    counts = {}
    for name in ("kitti", "tum_mono"):
        spec = load_spec(FOLDER / f"{name}.yaml")
        counts[name] = len(spec.sequences) * len(spec.conditions) * spec.trials
    assert counts == {"kitti": 110, "tum_mono": 500}


def test_the_failure_lab_bench_has_all_causes_of_failure_with_right_inputs() -> None:
    spec = load_spec(FOLDER / "failure_lab.yaml")
    assert {c.cause for c in spec.conditions} == set(Cause) - {Cause.INPUT}


def test_the_bench_of_verdicts_has_400_runs_and_no_stretch_in_both_halves() -> None:
    """400 in each half, of which none shares a world, or a frame of a recording, with one of the other half."""
    n_frames = {"hololens_000": 373, "phone_terrace": 302, "euroc_takeoff": 140}
    used: dict[Half, set[tuple[str, int]]] = {}
    for half in Half:
        spec = load_spec(FOLDER / "verdicts.yaml").with_trials(None, half)
        trials = plan_trials(spec, lambda s: SourceInfo(s.source, "", n_frames.get(s.name, 720), 10.0))
        assert len(trials) >= 400
        assert len({t.key for t in trials}) == len(trials)
        recorded = {s.name for s in spec.sequences if "{seed}" not in s.source}
        used[half] = {(t.source, -1) for t in trials if t.sequence not in recorded}
        for t in (t for t in trials if t.sequence in recorded):
            used[half] |= {(t.source, t.start + t.stride * n) for n in range(t.max_frames)}
    assert used[Half.DEVELOPMENT].isdisjoint(used[Half.REPORTING])


def test_each_clip_of_recovery_is_disturbed_in_its_middle() -> None:
    spec = load_spec(FOLDER / "recovery_clips.yaml")
    trials = plan_trials(spec, lambda s: SourceInfo(s.source, "", 720, s.frames / 10.0 if s.frames else 10.0))
    for trial in trials:
        (corruption,) = trial.config["corruptions"]
        assert 0.3 < (corruption["start"] - trial.start) / trial.max_frames < 0.5
        assert corruption["length"] <= 0.2 * trial.max_frames


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small grey images without anything to see: a trial on them is quick, and finds no map."""
    folder = tmp_path_factory.mktemp("images")
    for i in range(N):
        assert cv2.imwrite(str(folder / f"{i:06d}.png"), np.full((48, 64), 100, np.uint8))
    return folder


def kitti(root: Path, images: Path) -> None:
    (root / "poses").mkdir(parents=True)
    for number in range(11):
        folder = root / "sequences" / f"{number:02d}"
        shutil.copytree(images, folder / "image_0")
        (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(N)))
        (folder / "calib.txt").write_text("".join(f"P{c}: 50 0 32 {-15.0 * c} 0 50 24 0 0 0 1 0\n" for c in range(4)))
        pose = "1 0 0 0 0 1 0 0 0 0 1 {}\n"
        (root / "poses" / f"{number:02d}.txt").write_text("".join(pose.format(i) for i in range(N)))


def tum_mono(root: Path, images: Path) -> None:
    for number in range(1, 51):
        folder = root / f"sequence_{number:02d}"
        folder.mkdir(parents=True)
        shutil.make_archive(str(folder / "images"), "zip", images)
        (folder / "times.txt").write_text("".join(f"{i:05d} {0.05 * i:.6f} 10.0\n" for i in range(N)))
        lines = "0.5 0.7 0.5 0.5 0.9\n64 48\ncrop\n64 48\n"
        (folder / "camera.txt").write_text(lines)
        known = [i for i in range(N) if i < 15 or i >= N - 15]
        truth = "".join(f"{0.05 * i:.6f} {i}.0 0 0 0 0 0 1\n" for i in known)
        (folder / "groundtruthSync.txt").write_text(truth)


@pytest.mark.parametrize(("name", "make"), [("kitti", kitti), ("tum_mono", tum_mono)])
def test_the_benches_of_the_paper_find_their_sequences(
    tmp_path: Path, images: Path, name: str, make: Callable[[Path, Path], None]
) -> None:
    make(tmp_path / "data", images)
    spec = load_spec(FOLDER / f"{name}.yaml")
    trials = plan_trials(spec, partial(describe_source, data=tmp_path / "data"))
    assert len(trials) == len(spec.sequences) * 3 * 10
    starts = [trial.start for trial in trials]
    assert (min(starts), max(starts)) == (0, 50)
    record = run_trial(trials[-1], str(tmp_path / "out"))
    assert record.outcome is TrialOutcome.DONE, record.error
    assert len(record.status) == N - trials[-1].start
    assert judge(record, spec.thresholds) is FailureKind.NO_MAP


def test_a_sequence_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sequences/00 does not exist"):
        plan_trials(load_spec(FOLDER / "kitti.yaml"), partial(describe_source, data=tmp_path))
