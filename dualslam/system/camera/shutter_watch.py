"""The shutter of a live map: how long its images were read is asked of the map itself, and taken out of all it is in.

Pairs of frames give a readout time to five or ten milliseconds, if the camera turns fast. A map tells it to a fraction
of one (`frontends/tracking/map_readout.py`). Where few landmarks are seen from both sides of a fast turn, each
millisecond moves the scale behind it by 4 %.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp
from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.base import Camera
from dualslam.core.errors import SolverError
from dualslam.core.estimates import ReadoutEstimate
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.interfaces import Shutter, VisualOdometry
from dualslam.core.jobs import JobKind
from dualslam.core.noise_model import GATE_SIGMAS, INFLATION
from dualslam.core.types import Failure, FloatArray, Track
from dualslam.map.frame_observations import Change
from dualslam.map.submap import Submap
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.manager import Recoveries
from dualslam.system.state import State

MAX_GAP_S = 0.2
"""Between two frames whose poses tell how the camera turns."""


def turn_rates(submap: Submap, poses: Iterable[FramePose]) -> dict[int, FloatArray]:
    """Return how the camera turns at the frames that a submap has posed (rad/s, in its own axes), by their index."""
    posed = sorted((p for p in poses if p.submap_id == submap.id), key=attrgetter("index"))
    if len(posed) < 2:
        return {}
    t = np.array([p.timestamp_s for p in posed])
    R = np.array([_orientation(submap, p) for p in posed])
    n = np.arange(len(posed))
    apart = np.abs(np.diff(t)) > MAX_GAP_S
    first = n - ~np.concatenate([[True], apart])
    last = n + ~np.concatenate([apart, [True]])
    told = n[t[first] != t[last]]
    first, last = first[told], last[told]
    rates = _rate(R[first], R[last], (t[last] - t[first])[:, None])
    return {posed[i].index: rate for i, rate in zip(told.tolist(), rates, strict=True)}


def with_turn_of_poses(
    track: Track, submap: Submap, before: FramePose | None, shutter: Shutter, camera: Camera
) -> Track:
    """Return a frame that is to become a keyframe with the turn taken out of its pixels that its pose tells.

    Matches to the frame before tell it before there is a pose, with a part of the motion in it.

    - `submap`: in which the frame is posed.
    - `before`: of the frame before it.
    - `camera`: that rectified the frame's pixels.
    """
    view = track.view
    if view.turn_rad is None or before is None or before.submap_id != submap.id:
        return track
    gap_s = view.timestamp_s - before.timestamp_s
    if not 0 < abs(gap_s) <= MAX_GAP_S:
        return track
    turn_rad = shutter.readout_s * _rate(_orientation(submap, before), se3.rotation(track.T_cam_submap).T, gap_s)
    features = shutter.moved(view.features, camera, turn_rad - view.turn_rad)
    return replace(track, view=replace(view, features=features, turn_rad=turn_rad))


def _orientation(submap: Submap, pose: FramePose) -> FloatArray:
    return se3.rotation(submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam))


def _rate(R_before: FloatArray, R_after: FloatArray, gap_s: FloatArray | float) -> FloatArray:
    """Return the turn from one orientation to another, for each second, in the axes of the first."""
    rate: FloatArray = so3.log(R_before.swapaxes(-1, -2) @ R_after) / gap_s
    return rate


log = logging.getLogger(__name__)

FIRST_KEYFRAMES, GROWTH, SOON = 15, 2.0, 1.4
"""Keyframes at which a map is asked first, and how many times as many it has at each next time; and where it was
changed: what it had refused as outliers was by the shutter of before, and the first answer errs towards that."""

MAX_SIGMA_S = 0.004
"""Inflated. If the camera turns too slowly to fix a readout time to this, other errors of the pixels pass for one. A
rendered street, which hardly turns, gave -0.020 s with 0.008 claimed. There it does not matter either."""


class ShutterWatch:
    """Asks live submaps how long their images were read, and takes the answer in between two frames.

    `recoveries`: knows the lost submaps, which are to be linked with the live one and must have the same pixels.
    """

    def __init__(self, state: State, recoveries: Recoveries, connections: Connections) -> None:
        self._record, self._buffer, self._desk = state.record, state.buffer, state.parts.desk
        self._calibration, self._shutter = state.parts.calibration, state.parts.shutter
        self._new_graph, self._recoveries, self._connections = state.parts.new_graph, recoveries, connections
        self._due_at: dict[int, float] = {}  # by submap, keyframes
        self._asked: dict[int, tuple[object, float, Camera]] = {}  # by submap: what, and of which pixels

    def ask_if_due(self, live: VisualOdometry) -> None:
        """Ask the live submap where it is time to."""
        submap = live.submap
        n = len(submap.keyframes)
        if self._shutter.is_stated or self._desk.n_open(JobKind.READOUT, submap.id):
            return
        with self._record.timer.measure("shutter"):
            if n >= self._due_at.get(submap.id, FIRST_KEYFRAMES):
                self._due_at[submap.id] = GROWTH * n
                question = self._shutter.ask(
                    submap, turn_rates(submap, self._record.poses.values()), self._calibration.camera
                )
                if not isinstance(question, Failure):
                    self._asked[submap.id] = question, self._shutter.readout_s, self._calibration.camera
                    self._desk.submit(JobKind.READOUT, question, of=submap.id)

    def collect(self, live: VisualOdometry, now: FrameStamp, wait: bool = False) -> None:
        """Take in what the live submap has answered; `wait`: for a limited time, for what is open."""
        for ended in self._desk.drain(JobKind.READOUT) if wait else self._desk.poll(JobKind.READOUT):
            asked = self._asked.get(live.submap.id)
            # An answer of another map, or of other pixels, is no answer.
            if asked == (ended.work, self._shutter.readout_s, self._calibration.camera):
                with self._record.timer.measure("shutter"):
                    self._take_answer(ended.result, live, now)

    def _take_answer(self, answer: ReadoutEstimate | Failure, live: VisualOdometry, now: FrameStamp) -> None:
        submap = live.submap
        if isinstance(answer, Failure) or not _is_sure(answer):
            return
        readout_s = self._shutter.readout_s + answer.more_s
        if not self._change(submap, answer.more_s, now, live):
            return
        self._due_at[submap.id] = SOON * len(submap.keyframes)
        submaps = self._record.atlas.submaps
        changed = [m for m in self._recoveries.waiting if self._change(submaps[m], answer.more_s, now)]
        self._take(readout_s)
        sigma_s = INFLATION * answer.sigma_s
        self._record.event(EventKind.SHUTTER_FOUND, now, submap.id, readout_s=readout_s, sigma_s=sigma_s, lost=changed)

    def _change(self, submap: Submap, more_s: float, now: FrameStamp, live: VisualOdometry | None = None) -> bool:
        """Change a submap, in which `live` goes on if it is given; return whether it could be solved."""
        changed, graph = submap.copy(), self._new_graph()
        changed.relative_poses = {}  # they were measured with the pixels of before
        changes = self._changes(submap, more_s)
        for k in changes.keys() & changed.keyframes.keys():
            keyframe = changed.keyframes[k]
            changed.keyframes[k] = replace(keyframe, features=changes[k](keyframe.features))
        try:
            changed.apply_estimate(*graph.rebuild(changed).values)
        except SolverError as error:
            log.warning("submap %d keeps its shutter: %s", submap.id, error)
            return False
        before = submap.copy()
        submap.take_over(changed)
        self._record.change_pixels(submap.id, changes.get)
        if live is not None:
            live.adopt(graph, before)
        self._connections.follow(before, submap, now)
        return True

    def _changes(self, submap: Submap, more_s: float) -> dict[int, Change]:
        """Return what takes so much more of the readout out of a submap's frames, where it is known how they turned."""
        move, camera = self._shutter.moved, self._calibration.camera
        rates = turn_rates(submap, self._record.poses.values())
        return {i: partial(move, camera=camera, turn_rad=more_s * rate) for i, rate in rates.items()}

    def _take(self, readout_s: float) -> None:
        """Let the buffered frames and those to come be read in the time that was found."""
        rates: dict[int, FloatArray] = {}
        for submap in self._record.atlas.submaps.values():
            rates.update(turn_rates(submap, self._record.poses.values()))
        camera = self._calibration.camera
        known = {i: rates[i] for i in self._buffer.indices if i in rates}
        self._shutter.take(readout_s, known, self._buffer.newest(2), camera.K)
        correct_views(self._buffer, self._shutter, camera)


def correct_views(buffer: FrameBuffer, shutter: Shutter, camera: Camera) -> None:
    """Let the buffered views be read in the time that the shutter has now."""
    correction = shutter.correction(buffer.indices, camera)
    if correction is None:
        buffer.change_all(lambda views: shutter.all_corrected(views, camera))
    else:
        buffer.map_later(correction, "shutter")


def _is_sure(answer: ReadoutEstimate) -> bool:
    """Whether a map is to be changed by what it says."""
    sigma_s = INFLATION * answer.sigma_s
    return sigma_s < MAX_SIGMA_S and abs(answer.more_s) > GATE_SIGMAS * sigma_s
