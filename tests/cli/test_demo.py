"""The demo drives twice, without recovery and with it, and puts both beside each other."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.cli import main
from dualslam.cli.demo_command import drive
from dualslam.cli.parser import parse
from dualslam.core.camera.base import Camera
from dualslam.core.config.files import load_config
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.types import FloatArray, Frame
from dualslam.run.sources import make_world
from tests.cli.fakes import FakeSystem

N = 32
"""Less than a real demo needs to start again: the system is a fake one, and the images are blank."""
Truth = dict[int, FloatArray]


@pytest.fixture(scope="module")
def truth() -> Truth:
    return dict(enumerate(np.asarray(make_world("street", N, 0).ground_truth_T_world_cam)))


@pytest.fixture
def out(truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the demo's folder; its system is lost while the lens is covered, with recovery two frames later."""

    def build(config: Config, camera: Camera) -> FakeSystem:
        return FakeSystem(truth, lost=tuple(range(18 if config.recovery.enabled else 16, 22)))

    monkeypatch.setattr("dualslam.cli.demo_command.MIN_FRAMES", N)
    monkeypatch.setattr("dualslam.lab.synthetic.render.Renderer.image", lambda *_: np.zeros((480, 640), np.uint8))
    monkeypatch.setattr("dualslam.run.session.build_system", build)
    return tmp_path / "demo"


def test_demo_shows_recovery_off_against_on(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demo", "--frames", str(N), "--out", str(out)]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "covered in frames 16 to 25" in lines[0]
    assert (lines[1], lines[4]) == ("Recovery off:", "Recovery on:")
    assert "2 submaps, 1 failure" in lines[2]
    assert lines[5].endswith(f"results in {out / 'on'}")
    assert lines[3].startswith("verdict: usable.")
    assert lines[7].split() == ["off", "on"]
    assert ["coverage", "50.0", "%", "56.2", "%"] in [line.split() for line in lines]
    assert [load_config(out / name / "config.yaml").recovery.enabled for name in ("off", "on")] == [False, True]
    assert "recovery.enabled" in (out / "compare.html").read_text(), "what the two differ in"


def test_demo_overwrites_only_when_asked(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out.mkdir()
    page = out / "compare.html"
    page.write_text("mine")
    command = ["demo", "--frames", str(N), "--out", str(out), "--quiet"]
    assert main(command) == 2
    assert "compare.html is there already" in capsys.readouterr().err
    assert page.read_text() == "mine"
    assert main([*command, "--overwrite"]) == 0
    assert capsys.readouterr().out == ""
    assert page.read_text() != "mine"


@pytest.mark.parametrize(("blind", "status"), [(True, 1), (False, 0)])
def test_status_is_that_of_the_run_with_recovery(
    blind: bool, status: int, truth: Truth, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(config: Config, camera: Camera) -> FakeSystem:
        return FakeSystem(truth, lost=tuple(range(N)) if config.recovery.enabled is blind else ())

    monkeypatch.setattr("dualslam.run.session.build_system", build)
    assert main(["demo", "--frames", str(N), "--out", str(out), "--quiet"]) == status
    assert (out / "compare.html").exists()


def test_an_interrupted_demo_ends_there(truth: Truth, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(frame: Frame) -> None:
        if frame.index == 5:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("dualslam.run.session.build_system", lambda *_: FakeSystem(truth, before_step=interrupt))
    assert main(["demo", "--frames", str(N), "--out", str(out), "--quiet"]) == 130
    assert [path.name for path in out.iterdir()] == ["off"]


@pytest.mark.slow
def test_the_two_maps_of_the_drive_are_joined_at_the_first_attempt() -> None:
    """What the demo is to show, and to show within a minute."""
    n_frames = parse(["demo"]).frames
    sequence = drive(n_frames)
    system = build_system(Config(), sequence.camera)
    for frame in sequence:
        system.step(frame)
        if system.atlas.links:
            break
    assert len(system.events.of_kind(EventKind.FAILED)) == 1
    assert not system.events.of_kind(EventKind.LINK_REFUSED)
    (attempt,) = system.events.of_kind(EventKind.RECOVERY_ATTEMPT)
    assert attempt.data["verdict"] == "linked"
