"""Removal of pixels that stand still from frames and map, back to before they were found."""

from __future__ import annotations

import numpy as np

from dualslam.core.events import EventKind
from dualslam.core.types import BoolArray, View
from dualslam.map.submap import Submap
from dualslam.system.starting import Starting
from dualslam.system.state import State


class Masking:
    """Follows what is known to stand still."""

    def __init__(self, state: State, starting: Starting) -> None:
        self._state = state
        self._starting = starting
        self._hidden: BoolArray | None = None
        self._camera_stands = False

    def follow(self, view: View) -> None:
        """Take in what has become known by a frame, which is not buffered yet."""
        state, scene = self._state, self._state.parts.scene
        if scene.camera_stands is not self._camera_stands:
            self._camera_stands = scene.camera_stands
            kind = EventKind.CAMERA_STANDS if scene.camera_stands else EventKind.CAMERA_MOVES
            state.record.event(kind, view, None)
        if scene.hidden is self._hidden:
            return
        self._hidden = scene.hidden
        share = 0.0 if scene.hidden is None else float(scene.hidden.mean())
        n_removed = 0
        if scene.hidden is not None and state.live is None:
            # Frames that no map knows by their features are masked, and a start is looked for anew.
            known = {k for submap in state.record.atlas.submaps.values() for k in submap.keyframes}
            state.buffer.change_all(lambda views: [v if v.index in known else scene.masked(v) for v in views])
            self._starting.begin_again()
        elif state.live is not None:
            n_removed = self._clean(state.live.submap)
        submap_id = None if state.live is None else state.live.submap.id
        state.record.event(EventKind.MASKED, view, submap_id, share=share, observations_removed=n_removed)

    def _clean(self, submap: Submap) -> int:
        """Remove the observations of what stands still from a map; return their number."""
        scene, observations = self._state.parts.scene, submap.observations
        rows = np.flatnonzero(observations["alive"])
        keyframe, feature = observations["kf"][rows], observations["feature"][rows]
        still = np.zeros(len(rows), np.bool_)
        for k in np.unique(keyframe).tolist():
            of_k = keyframe == k
            still[of_k] = ~scene.shows(submap.keyframes[k].features)[feature[of_k]]
        submap.remove_outliers(rows[still])
        return int(still.sum())
