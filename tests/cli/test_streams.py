"""Where standard output or error cannot be written, nothing that is computed is lost."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

import pytest

from dualslam.cli import main

Install = Callable[..., None]


@pytest.fixture
def full() -> Iterator[TextIO]:
    if not Path("/dev/full").is_char_device():
        pytest.skip("no device that is always full")
    with open("/dev/full", "w", encoding="utf-8") as stream:
        yield stream


@pytest.fixture
def left() -> Iterator[TextIO]:
    """A pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        yield stream


@pytest.mark.parametrize("name", ["full", "left"])
def test_a_run_goes_on_and_its_results_are_whole(
    request: pytest.FixtureRequest,
    folder: Path,
    fake: Install,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    monkeypatch.setattr(sys, "stdout", request.getfixturevalue(name))
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), "--profile"]) == (1 if name == "full" else 0)
    said = "dualslam: standard output cannot be written: No space left on device\n"
    assert capsys.readouterr().err == (said if name == "full" else "")
    assert (tmp_path / "run" / "report.html").exists()


@pytest.mark.parametrize("arguments", ["config", "--help"])
def test_what_a_command_prints_is_missed(
    full: TextIO, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: str
) -> None:
    monkeypatch.setattr(sys, "stdout", full)
    assert main([arguments]) == 1
    assert "standard output cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_stream_that_was_closed_is_no_bug(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stream: str
) -> None:
    monkeypatch.setattr(sys, stream, None)
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 0
    assert main(["config", "--seed", "x"]) == 2


def test_an_error_that_cannot_be_told_is_in_the_status(full: TextIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", full)
    assert main(["config", "--seed", "x"]) == 2
