"""Opening whatever a run can read: recorded sequences, videos, webcams, and the embedded synthetic worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.io.open_sequence import open_sequence

SYNTHETIC = "synthetic:"
DEFAULT_FRAMES = 300


def open_source(
    source: str | Path | int,
    *,
    camera_file: str | Path | None = None,
    fov_degrees: float | None = None,
    start: int = 0,
    stride: int = 1,
    max_frames: int | None = None,
    reverse: bool = False,
) -> Sequence:
    """Open a source of frames.

    Parameters
    ----------
    source : path, str or int
        What `dualslam.io.open_sequence` takes, or ``synthetic:street`` or ``synthetic:room``, with options behind
        commas: ``synthetic:street,frames=300,seed=1,events=FILE``.
    camera_file, fov_degrees : optional
        Calibration of a source that has none.
    start, stride, max_frames, reverse : optional
        Which frames, counted in the source.

    Raises
    ------
    InputError
    """
    if isinstance(source, str) and source.startswith(SYNTHETIC):
        if camera_file is not None or fov_degrees is not None:
            raise InputError(f"{source} has a camera of its own; leave out --camera and --fov.")
        return open_world(source, start=start, stride=stride, max_frames=max_frames, reverse=reverse)
    return open_sequence(
        source,
        camera_file=camera_file,
        fov_degrees=fov_degrees,
        start=start,
        stride=stride,
        max_frames=max_frames,
        reverse=reverse,
    )


def parse_world(source: str) -> tuple[str, dict[str, Any]]:
    """Read ``synthetic:NAME,key=value,...`` into the world's name and its options `frames`, `seed` and `events`."""
    name, *pairs = source.removeprefix(SYNTHETIC).split(",")
    options: dict[str, Any] = {"frames": DEFAULT_FRAMES, "seed": 0, "events": None}
    for pair in pairs:
        key, _, value = pair.partition("=")
        if key not in options:
            raise InputError(f"{source}: a synthetic world has no option {key!r}; it has frames, seed and events.")
        if key == "events":
            options[key] = Path(value)
        elif not value.isdecimal() or (key == "frames" and int(value) < 1):
            raise InputError(f"{source}: {key} must be a whole number{' above 0' if key == 'frames' else ''}.")
        else:
            options[key] = int(value)
    return name, options
