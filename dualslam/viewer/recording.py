"""The recording of a run for the Rerun viewer. The only file that imports rerun, an extra.

Nothing is sent anywhere: a recording is bytes, and what draws it is started elsewhere.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from dualslam.core.errors import InputError
from dualslam.core.events import EventKind
from dualslam.core.types import FloatArray, FrameStatus, IntArray
from dualslam.report.run_data import RunData
from dualslam.report.statuses import MEANING, event_words, stretches
from dualslam.viewer.colours import ELSEWHERE, MATCH_COLOUR, STATUS_COLOURS, SUBMAP_COLOURS, TRUTH_COLOUR
from dualslam.viewer.playback import Appearing, Playback, Space, camera_statuses, play, segments

APPLICATION = "dualslam"
TIME, FRAME = "timestamp_s", "frame"
EVENTS, STATUS, LATENCY, MATCHES, INLIERS = "events", "status", "latency_ms", "matches/n_matches", "matches/n_inliers"
LEVELS = {
    EventKind.FAILED: "ERROR",
    EventKind.RECOVERY_FAILED: "WARN",
    EventKind.LINK_REFUSED: "WARN",
    EventKind.INITIALISATION_REFUSED: "WARN",
    EventKind.UNREADABLE: "WARN",
    EventKind.INTERRUPTED: "WARN",
}
CAMERA_SHARE = 0.04
"""How far the drawn camera reaches, of the way's extent."""
MIN_CAMERA_MU = 0.05
"""The least of that, for a camera that only turned; landmarks are about 1 away."""
EPOCH_S = 1e9
"""Later times count from 1970: no video lasts thirty years."""


def make_recording(run: RunData) -> bytes:
    """Return a run as the content of an ``.rrd`` file, with the layout that the viewer opens it in.

    Entities: ``map`` (the main map, in its own unit) with ``camera``, ``path``, ``keyframes``, ``landmarks`` and
    ``truth``. The same below ``apart/NN`` for each submap that is not linked to it. ``status``, ``matches``,
    ``latency_ms`` and ``events``. Timelines: ``timestamp_s`` and ``frame``.

    Raises `InputError`: as `play`; or if the environment switches rerun off.
    """
    playback = play(run)
    # An id of the content: the same run makes the same recording, two runs never flow into one.
    identity = hashlib.sha256(json.dumps([run.name, run.summary], sort_keys=True).encode()).hexdigest()
    stream = rr.RecordingStream(APPLICATION, recording_id=identity[:32], send_properties=False)
    if not rr.is_enabled(stream):
        raise InputError("rerun is switched off by the environment variable RERUN; unset it.")
    file = stream.memory_recording()
    stream.send_recording_name(f"{run.summary.get('sequence', run.name)} ({run.name})")
    clock = _Clock(playback)
    for space in playback.spaces:
        _send_space(stream, clock, playback, space)
    _send_frames(stream, clock, playback)
    _send_events(stream, clock, run.events)
    stream.send_blueprint(_layout(playback))
    return file.drain_as_bytes()


def entity(space: Space) -> str:
    """Return the path below which a space stands."""
    return "map" if space.submap is None else f"apart/{space.submap:02d}"


class _Clock:
    """Rows of a playback as columns of both timelines."""

    def __init__(self, playback: Playback) -> None:
        self.timestamp_s = np.array([row.timestamp_s for row in playback.rows])
        self.frame = np.array([row.index for row in playback.rows], np.int64)
        self._since_epoch = bool(len(self.timestamp_s) and self.timestamp_s[0] > EPOCH_S)

    def at_rows(self, row: IntArray | slice) -> list[rr.TimeColumn]:
        return self.at(self.timestamp_s[row], self.frame[row])

    def at(self, timestamp_s: FloatArray, frame: IntArray) -> list[rr.TimeColumn]:
        # Second and fraction apart: nanoseconds since 1970 are more than a float64 holds.
        whole = np.floor(timestamp_s)
        nanoseconds = whole.astype(np.int64) * 10**9 + np.round((timestamp_s - whole) * 1e9).astype(np.int64)
        if self._since_epoch:
            time = rr.TimeColumn(TIME, timestamp=nanoseconds.astype("datetime64[ns]"))
        else:
            time = rr.TimeColumn(TIME, duration=nanoseconds.astype("timedelta64[ns]"))
        return [time, rr.TimeColumn(FRAME, sequence=frame)]


# --- what stands in space


def _send_space(stream: rr.RecordingStream, clock: _Clock, playback: Playback, space: Space) -> None:
    path, posed = entity(space), space.posed
    # The first camera of a map is its frame: x right, y down, z forward.
    stream.log(path, rr.ViewCoordinates.RDF, static=True)
    if len(posed):
        _send_camera(stream, clock, playback, space)
        ends, strips = segments(posed)
        colours = _status_colours([playback.rows[i].status for i in ends.tolist()])
        if len(ends):
            stream.log(f"{path}/path", rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.6)), static=True)
            columns = rr.LineStrips3D.columns(strips=list(strips), colors=colours)
            stream.send_columns(f"{path}/path", clock.at_rows(ends), columns)
    _send_points(stream, f"{path}/keyframes", clock, space.keyframes, radius=2.4)
    _send_points(stream, f"{path}/landmarks", clock, space.landmarks, radius=1.2)
    if len(space.truth_xyz):
        radius = rr.Radius.ui_points(1.0)
        strip = rr.LineStrips3D([space.truth_xyz], colors=_colour(TRUTH_COLOUR), radii=radius)
        stream.log(f"{path}/truth", strip, static=True)


def _send_camera(stream: rr.RecordingStream, clock: _Clock, playback: Playback, space: Space) -> None:
    """Move the camera with the poses; without one it stays where it was, in the colour of what became of the frame."""
    path, camera, posed = f"{entity(space)}/camera", playback.camera, space.posed
    lens = rr.Pinhole(
        image_from_camera=camera.K,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=max(CAMERA_SHARE * space.size, MIN_CAMERA_MU),
    )
    stream.log(path, lens, static=True)
    moved = rr.Transform3D.columns(translation=posed.xyz, mat3x3=posed.T_map_cam[:, :3, :3])
    stream.send_columns(path, clock.at_rows(posed.row), moved)
    since_first = slice(int(posed.row[0]), None)
    colours = _status_colours(camera_statuses(playback, space)[since_first])
    stream.send_columns(path, clock.at_rows(since_first), rr.Pinhole.columns(color=colours))


def _send_points(stream: rr.RecordingStream, path: str, clock: _Clock, points: Appearing, radius: float) -> None:
    if not len(points):
        return
    stream.log(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(radius)), static=True)
    row, count = np.unique(points.row, return_counts=True)
    colours = np.array(SUBMAP_COLOURS, np.uint32)[points.submap % len(SUBMAP_COLOURS)]
    columns = rr.Points3D.columns(positions=points.xyz, colors=colours)
    stream.send_columns(path, clock.at_rows(row), columns.partition(count))


# --- what belongs to a frame


def _send_frames(stream: rr.RecordingStream, clock: _Clock, playback: Playback) -> None:
    rows = playback.rows
    series = {
        MATCHES: ([row.n_matches for row in rows], MATCH_COLOUR, "matches"),
        INLIERS: ([row.n_inliers for row in rows], STATUS_COLOURS[FrameStatus.TRACKED], "inliers"),
        LATENCY: ([row.latency_ms for row in rows], STATUS_COLOURS[FrameStatus.BYPASSED], "latency in ms"),
    }
    for path, (values, colour, name) in series.items():
        stream.log(path, rr.SeriesLines(colors=_colour(colour), names=name), static=True)
        if rows:
            stream.send_columns(path, clock.at_rows(slice(None)), rr.Scalars.columns(scalars=np.array(values, float)))
    words = [f"{status}: {meaning}" for status, meaning in MEANING.items()]
    colours = _status_colours(list(MEANING))
    stream.log(STATUS, rr.StateConfiguration(values=list(map(str, MEANING)), labels=words, colors=colours), static=True)
    changes = list(stretches([row.status for row in rows]))
    if changes:
        at = clock.at_rows(np.array([stretch.start for stretch in changes]))
        stream.send_columns(STATUS, at, rr.StateChange.columns(state=[str(stretch.value) for stretch in changes]))


def _send_events(stream: rr.RecordingStream, clock: _Clock, events: Sequence[dict[str, Any]]) -> None:
    """Send each event at the frame that it names: reverse tracking names frames before those that it came after."""
    if not events:
        return
    times = clock.at(np.array([float(e["timestamp_s"]) for e in events]), np.array([int(e["frame"]) for e in events]))
    text = [_event_line(event) for event in events]
    level = [LEVELS.get(event["event"], "INFO") for event in events]
    stream.send_columns(EVENTS, times, rr.TextLog.columns(text=text, level=level))


def _event_line(event: dict[str, Any]) -> str:
    where = "" if event.get("submap") is None else f" (submap {event['submap']})"
    words = event_words(event)
    return f"{str(event['event']).replace('_', ' ')}{where}{': ' if words else ''}{words}"


# --- how it is laid out


def _layout(playback: Playback) -> rrb.Blueprint:
    """Space to the left, all that appears with time kept; numbers, statuses and events to the right."""
    since_start = [
        rrb.VisibleTimeRange(
            timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
        for timeline in (TIME, FRAME)
    ]
    spaces = [
        rrb.Spatial3DView(
            origin=entity(space),
            name="main map" if space.submap is None else f"submap {space.submap}, not linked",
            time_ranges=since_start,
        )
        for space in playback.spaces
    ]
    beside = rrb.Vertical(
        rrb.StateTimelineView(origin=STATUS, name="status"),
        rrb.TimeSeriesView(origin="matches", name="landmarks matched, and in agreement"),
        rrb.TimeSeriesView(origin=LATENCY, name="latency"),
        rrb.TextLogView(origin=EVENTS, name="events"),
        row_shares=[1, 2, 2, 3],
    )
    views = rrb.Horizontal(spaces[0] if len(spaces) == 1 else rrb.Tabs(*spaces), beside, column_shares=[3, 2])
    return rrb.Blueprint(views, rrb.TimePanel(timeline=TIME), collapse_panels=True)


def _status_colours(statuses: Iterable[FrameStatus | None]) -> NDArray[np.uint32]:
    colours = [ELSEWHERE if status is None else STATUS_COLOURS[status] for status in statuses]
    return np.array(colours, np.uint32)


def _colour(rgba: int) -> NDArray[np.uint32]:
    return np.array([rgba], np.uint32)
