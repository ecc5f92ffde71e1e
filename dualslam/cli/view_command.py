"""`dualslam view`: a finished run in the Rerun viewer, or as a recording for it."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from dualslam.cli.configuration import check_free
from dualslam.core.errors import InputError, OutputError, how_to_install
from dualslam.io.atomic import write_bytes
from dualslam.report.run_data import RunData, read_run

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_RERUN = (sys.executable, "-m", "rerun")
_WINDOW = ("--port", "auto", "--bind", "127.0.0.1", "--hide-welcome-screen")
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
_NOWHERE = "http://127.0.0.1:9"
"""The port named `discard`, where nobody answers."""


def execute(args: argparse.Namespace) -> int:
    """Write the recording of a run, or open the viewer with it."""
    if args.save is not None:
        check_free(args.save, args.overwrite, "another with --save")
        save_recording(args.run, args.save, args.quiet)
        return 0
    run = read_run(args.run)
    if not has_display():
        raise InputError("there is no display to open a viewer on; write the recording with --save FILE.")
    open_viewer(_record(run))
    return 0


def save_recording(run: Path, out: Path, quiet: bool) -> None:
    """Write the recording of a run."""
    write_bytes(out, _record(read_run(run)))
    if not quiet:
        print(f"recording in {out}; open it with rerun {out}", flush=True)


def _record(run: RunData) -> bytes:
    try:
        from dualslam.viewer.recording import make_recording
    except ImportError as error:
        raise InputError(f"dualslam view needs the Rerun viewer: {how_to_install('view')}.") from error
    return make_recording(run)


# A viewer of its own on a free port, which other machines cannot reach, without the welcome page that loads examples.


def has_display() -> bool:
    """Whether a window can be opened."""
    return any(os.environ.get(name) for name in DISPLAYS)


def open_viewer(recording: bytes) -> None:
    """Show the content of an ``.rrd`` file, and wait until the window is closed.

    The viewer's own settings forbid it to send usage data; a proxy that leads nowhere keeps it from asking for newer
    versions.

    Raises `OutputError` if the viewer cannot be started.
    """
    with tempfile.TemporaryDirectory(prefix="dualslam-view-") as folder:
        file = Path(folder) / "run.rrd"
        file.write_bytes(recording)
        environment = os.environ | _alone(folder)
        for words in (("analytics", "disable"), (*_WINDOW, str(file))):
            done = subprocess.run([*_RERUN, *words], env=environment, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise OutputError(f"the viewer did not open ({_reason(done.stderr)}); write the recording with --save.")


def _alone(folder: str) -> dict[str, str]:
    """Return the environment of a program that keeps its settings in a folder and reaches no other machine."""
    nowhere = {spelt: _NOWHERE for name in _PROXIES for spelt in (name, name.lower())}
    return nowhere | {"NO_PROXY": "", "no_proxy": "", "XDG_CONFIG_HOME": folder, "XDG_DATA_HOME": folder}


def _reason(stderr: str) -> str:
    """Return the line that says most of what a program complained about."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return (errors or lines or ["it does not say why"])[0]
