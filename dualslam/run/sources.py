"""Opening whatever a run can read: recorded sequences, videos, webcams, and the embedded synthetic worlds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.config import strict_yaml
from dualslam.core.errors import ConfigError, InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Frame
from dualslam.io.bags import has_topics
from dualslam.io.colours import likeness
from dualslam.io.open_sequence import open_sequence
from dualslam.io.read_ahead import read_ahead
from dualslam.io.reduced import MAX_SIDE_PX
from dualslam.io.sequence import RecordedSequence, Selection
from dualslam.io.trajectory_files import Trajectory
from dualslam.io.video import is_live

if TYPE_CHECKING:
    from dualslam.lab.synthetic import SyntheticSequence

SYNTHETIC = "synthetic:"
WORLD_NUMBERS = {"frames": 300, "seed": 0, "width": 640, "height": 480, "visit": 0, "backwards": 0}
"""Numeric options of a synthetic source, and their defaults."""
RENDER_AHEAD_FRAMES = 4
N_COMPARED = 9
SAME_IMAGE = 0.97
"""Correlation with a small picture: of the image itself above 0.98, of the next frame below (see `likeness`)."""
ANY_FOV_DEG = 60.0
"""To read images by of whose camera nothing is known yet, or nothing is asked."""


def open_source(
    source: str | Path | int,
    *,
    camera_file: str | Path | None = None,
    fov_degrees: float | None = None,
    start: int = 0,
    stride: int = 1,
    max_frames: int | None = None,
    reverse: bool = False,
    rate_hz: float | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    max_side_px: int | None = MAX_SIDE_PX,
) -> Sequence:
    """Open a source of frames.

    Parameters
    ----------
    source : path, str or int
        What `dualslam.io.open_sequence` takes, or ``synthetic:street`` or ``synthetic:room``, with options behind
        commas: ``synthetic:street,frames=300,seed=1,width=640,height=480,events=FILE``.
    camera_file, fov_degrees : optional
        Calibration of a source that has none.
    start, stride, max_frames, reverse : optional
        Which frames, counted in the source.
    rate_hz, time_unit, topic : optional
        Rate of the frames, unit of their times, topic of a bag's images (see `dualslam.io.open_sequence`).
    max_side_px : int or None
        Larger recorded images are read smaller, by a whole factor; None: never.

    Raises
    ------
    InputError
    """
    if isinstance(source, str) and source.startswith(SYNTHETIC):
        world = WorldSequence(parse_world(source), Selection(start, stride, max_frames, reverse), source)
        if camera_file is not None or fov_degrees is not None:  # said last: another mistake matters more
            raise InputError(f"{source} has a camera of its own; leave out --camera and --fov.")
        if rate_hz is not None or time_unit is not None:
            raise InputError(f"{source} has a clock of its own; leave out --rate and --time-unit.")
        return world
    return open_sequence(
        source,
        camera_file=camera_file,
        fov_degrees=fov_degrees,
        start=start,
        stride=stride,
        max_frames=max_frames,
        reverse=reverse,
        rate_hz=rate_hz,
        time_unit=time_unit,
        topic=topic,
        max_side_px=max_side_px,
    )


def open_images_of_run(
    source: str | Path, size_px: tuple[int, int], topic: str | None = None, pictures: Mapping[int, bytes] | None = None
) -> RecordedSequence | WorldSequence:
    """Open what a run was made of, in the size in which the run has read it.

    Its camera is not the run's: that is in the map.

    - `source`: as in `open_source`.
    - `size_px` (width, height): of the run's images.
    - `topic`: that the run has read, of a bag.
    - `pictures`: small JPEGs of the run's frames, by their index in the source.

    Raises `InputError` if it cannot be read, is live, or has images of another size, or others than `pictures`.
    """
    if is_live(source):
        raise InputError(f"{source} is live: its frames cannot be read again.")
    has_camera = str(source).startswith(SYNTHETIC)  # recordings may have one, and that comes before a field of view
    fov_degrees, unit = (None, None) if has_camera else (ANY_FOV_DEG, "s")  # times do not matter
    of_bag = topic if has_topics(Path(str(source))) else None
    opened = open_source(source, fov_degrees=fov_degrees, time_unit=unit, topic=of_bag, max_side_px=max(size_px))
    assert isinstance(opened, RecordedSequence | WorldSequence)
    if opened.camera.size_px != size_px:
        raise InputError(f"{source} has images of another size than the run's.")
    _refuse_others(opened, source, pictures or {})
    return opened


def _refuse_others(opened: RecordedSequence | WorldSequence, source: str | Path, pictures: Mapping[int, bytes]) -> None:
    """Refuse a source whose frames are not those of the pictures."""
    chosen = dict(list(pictures.items())[:: max(1, len(pictures) // N_COMPARED)])
    alike = [
        likeness(chosen[frame.index], frame.image)
        for frame in opened.in_colour(chosen)
        if frame.index in chosen and frame.image is not None
    ]
    if chosen and (not alike or np.median(alike) < SAME_IMAGE):
        raise InputError(f"{source} shows other images than the run's; name the source that the run was made of.")


class WorldSequence:
    """Frames of a synthetic world, rendered ahead on a thread, with what a recording offers.

    - `rate_hz`: of the frames that are read, so the stride counts.
    - `ground_truth`: of the whole world, metres.
    - `source_indices` (N,) int64.
    - `frame_timestamps` (N,) float64.
    - `source`: by which it can be made again; empty if that is not known.
    """

    def __init__(self, world: SyntheticSequence, selection: Selection | None = None, source: str = "") -> None:
        selection = selection or Selection()
        self.source = source
        self._world = world
        self.selection = selection
        self.name = world.name
        self.camera: Camera = world.camera
        self.rate_hz = world.rate_hz / selection.stride
        self.ground_truth = Trajectory(world.timestamps_s, world.ground_truth_T_world_cam)
        chosen = selection.indices(world.n_frames, world.name)
        self.source_indices = chosen[np.isin(chosen, world.indices)]
        self.frame_timestamps = world.timestamps_s[self.source_indices]

    def __len__(self) -> int:
        return len(self.source_indices)

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(map(self._world.frame, self.source_indices.tolist()), RENDER_AHEAD_FRAMES)

    def in_colour(self, indices: Iterable[int]) -> Iterator[Frame]:
        """Render some frames again, ascending: these worlds are grey."""
        return map(self._world.frame, sorted(set(indices) & set(self._world.indices.tolist())))


def make_world(
    name: str,
    n_frames: int,
    seed: int,
    events: Iterable[Any] = (),
    width: int = WORLD_NUMBERS["width"],
    height: int = WORLD_NUMBERS["height"],
    **visit: int,
) -> SyntheticSequence:
    """Make a synthetic world; a wrong name or number is bad input here, as it comes from what a user names as source.

    `visit`, `backwards`: see `make_sequence`.

    Raises `InputError`.
    """
    from dualslam.lab.synthetic import make_sequence  # a renderer, which recordings do without

    try:
        return make_sequence(name, n_frames, seed, width, height, events, **visit)
    except ConfigError as error:
        raise InputError(str(error)) from error


def read_script(path: str | Path) -> list[Mapping[str, Any]]:
    """Read a script of disturbances: a YAML list of mappings with `kind`, `start`, `length` and perhaps `strength`.

    Raises `InputError`.
    """
    from dualslam.lab.synthetic import parse_events

    try:
        items = strict_yaml.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(items, list):
            raise InputError(f"{path}: a script is a list of mappings, such as - {{kind: blur, start: 50, length: 9}}.")
        parse_events(items)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file in UTF-8.") from error
    except (ValueError, ConfigError) as error:
        raise InputError(f"{path}: {error}") from error
    return items


def parse_world(source: str) -> SyntheticSequence:
    """Make the world that ``synthetic:NAME,key=value,...`` names.

    Raises `InputError`.
    """
    name, *pairs = source.removeprefix(SYNTHETIC).split(",")
    numbers, events = dict(WORLD_NUMBERS), None
    for pair in pairs:
        key, _, value = pair.partition("=")
        if key == "events":
            events = Path(value)
        elif key not in numbers:
            known = ", ".join(numbers)
            raise InputError(f"{source}: a synthetic world has no option {key!r}; it has {known} and events.")
        elif not value.isdecimal():
            raise InputError(f"{source}: {key} must be a whole number, not {value!r}.")
        else:
            numbers[key] = int(value)
    script = read_script(events) if events is not None else ()
    n_frames, seed = numbers.pop("frames"), numbers.pop("seed")
    return make_world(name, n_frames, seed, script, **numbers)
