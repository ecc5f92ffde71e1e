"""Damaged input, by seed: the command says one sentence, exits with 2 or goes on, and leaves all files as they were."""

from __future__ import annotations

import contextlib
import io
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import yaml

from dualslam.cli import main
from dualslam.core.config.settings import Config
from dualslam.core.errors import DualSlamError
from tests.fuzz.mutations import mutated
from tests.io.conftest import make_dataset, make_euroc, make_kitti, make_tum_mono, make_tum_rgbd, write_images
from tests.io.test_camera_formats import FORMATS

READ = "all of it was read."
LAYOUTS = {
    "dataset": make_dataset,
    "kitti": make_kitti,
    "tum_rgbd": make_tum_rgbd,
    "tum_mono": make_tum_mono,
    "euroc": make_euroc,
}
MEASUREMENTS = """position,100.0,0,0,0,0.1,0.1,0.1
position,100.3,3,0,0,0.1,0.1,0.1
height,100.1,0.2,0.5
rotation_rate,100.2,0,0.1,0,0.01
mount,0,0,0,0,0,0,1
distance,100.1,100.4,3,0.1
"""


def read_all(config: Config, sequence: Any, out: Path | None = None, **_: object) -> None:
    """Stand in for the run: read every frame, and end there."""
    for frame in sequence:
        assert (frame.image is None) == bool(frame.error)
    raise DualSlamError(READ)  # exit status 1, as 2 is for what is refused


@dataclass(frozen=True)
class Templates:
    """Sound input of every kind in a folder, from which each case is copied.

    Attributes
    ----------
    folder : Path
    """

    folder: Path

    def build(self) -> Templates:
        """Write the templates."""
        for name, make in LAYOUTS.items():
            make(self.folder / "sequence" / name)
        for i, (name, text, lens) in enumerate(FORMATS):
            write_images(
                self.folder / "camera" / str(i) / "images", ["0.png", "1.png"], lens.width // 4, lens.height // 4
            )
            (self.folder / "camera" / str(i) / name).write_text(text)
        video = cv2.VideoWriter(str(self.folder / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
        rng = np.random.default_rng(0)
        for _ in range(8):
            video.write(rng.integers(0, 256, (48, 64, 3), np.uint8))
        video.release()
        (self.folder / "config.yaml").write_text(yaml.safe_dump(Config().model_dump(mode="json")))
        (self.folder / "measurements.csv").write_text(MEASUREMENTS)
        assert main(["run", "synthetic:room,frames=30", "--out", str(self.folder / "map"), "--quiet", "--inline"]) == 0
        return self


def a_file_of(folder: Path, rng: np.random.Generator) -> Path:
    """Choose a file: small ones, which are read whole and parsed, as often as images."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    images = [path for path in files if path.suffix in (".png", ".jpg")]
    others = [path for path in files if path not in images]
    chosen = images if images and (not others or rng.random() < 0.2) else others
    return chosen[rng.integers(len(chosen))]


def sequence(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    name = list(LAYOUTS)[rng.integers(len(LAYOUTS))]
    shutil.copytree(source / "sequence" / name, work / name)
    spoil(a_file_of(work / name, rng), rng)
    folder = work / name
    if name == "kitti":
        folder = folder / "sequences" / "07"
    elif name in ("tum_rgbd", "euroc"):
        (folder,) = folder.iterdir()
    if rng.random() < 0.3:
        begin_s, step_s = {"kitti": (0.0, 0.1), "euroc": (1403636579.763555, 0.05)}.get(name, (100.0, 0.1))
        poses = "".join(f"{begin_s + step_s * i:.6f} {i} 0 0 0 0 0 1\n" for i in range(6))
        (work / "trajectory.txt").write_text(poses)
        return ["eval", str(work / "trajectory.txt"), str(folder)]
    return ["run", str(folder), "--out", str(work / "out")]


def camera(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    shutil.copytree(source / "camera" / str(rng.integers(len(FORMATS))), work, dirs_exist_ok=True)
    (calibration,) = (path for path in work.iterdir() if path.is_file())
    spoil(calibration, rng)
    return ["run", str(work / "images"), "--camera", str(calibration), "--out", str(work / "out")]


def config(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    spoil(Path(shutil.copy(source / "config.yaml", work)), rng)
    return ["config", "--config", str(work / "config.yaml")]


def measurements(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    shutil.copytree(source / "sequence" / "dataset", work / "walk")
    spoil(Path(shutil.copy(source / "measurements.csv", work)), rng)
    return ["run", str(work / "walk"), "--measurements", str(work / "measurements.csv"), "--out", str(work / "out")]


def video(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    spoil(Path(shutil.copy(source / "walk.avi", work)), rng)
    return ["run", str(work / "walk.avi"), "--fov", "60", "--out", str(work / "out")]


def saved_map(source: Path, work: Path, rng: np.random.Generator) -> list[str]:
    shutil.copytree(source / "map", work / "map")
    names = ("trajectory.txt", "frames.csv", "summary.json", "config.yaml", "events.jsonl")
    files = [path for path in (work / "map").rglob("*") if path.name in names or path.suffix in (".npz", ".json")]
    spoil(sorted(files)[rng.integers(len(files))], rng)
    if rng.random() < 0.3:
        return ["explain", str(work / "map"), "--frame", "12"]
    to = ("tum", "kitti", "ply", "g2o", "bal")[rng.integers(5)]
    return ["export", str(work / "map"), "--to", to, "--out", str(work / "out")]


KINDS: dict[str, Callable[[Path, Path, np.random.Generator], list[str]]] = {
    "sequence": sequence,
    "camera": camera,
    "config": config,
    "measurements": measurements,
    "video": video,
    "map": saved_map,
}


def spoil(path: Path, rng: np.random.Generator) -> None:
    """Damage a file, or take it away, or put a folder in its place."""
    what = rng.random()
    if what > 0.04:
        path.write_bytes(mutated(path.read_bytes(), rng))
        return
    path.unlink()
    if what < 0.02:
        path.mkdir()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextlib.contextmanager
def as_by_a_user() -> Iterator[tuple[io.StringIO, io.StringIO]]:
    """Every warning is a bug; nothing is tracked, and no camera is searched for: what is read is all that counts."""
    out, err = io.StringIO(), io.StringIO()
    with (
        warnings.catch_warnings(),
        mock.patch("dualslam.cli.run_command.run_to_folder", read_all),
        mock.patch("dualslam.cli.run_command.with_camera_found", read_all),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        warnings.simplefilter("error")
        yield out, err


def tried(kind: str, seed: int, work: Path, templates: Path) -> tuple[int, str | None]:
    """Make one case in a new folder; return the exit status, and what is wrong with what the command did or None."""
    work.mkdir()
    command = KINDS[kind](templates, work, np.random.default_rng([seed, list(KINDS).index(kind)]))
    before = contents(work)
    with as_by_a_user() as (_, err):
        status = main(command)
    said = err.getvalue()
    return status, _fault(" ".join(command), status, said, before, contents(work))


def _fault(command: str, status: int, said: str, before: dict[str, bytes], after: dict[str, bytes]) -> str | None:
    if any(after.get(name) != data for name, data in before.items()):
        return f"{command}: an input file was changed"
    if "this is a bug" in said or "Traceback" in said or status not in (0, 1, 2):
        return f"{command}: status {status}: {said}"
    lines = [line for line in said.splitlines() if not line.startswith("WARNING ")]
    if status and (len(lines) != 1 or not lines[0].startswith("dualslam: ")):
        return f"{command}: status {status}, but not one sentence: {said}"
    if status == 2 and after.keys() - before.keys():
        return f"{command}: status 2, but files were left: {sorted(after.keys() - before.keys())}"
    return None
