"""A live map that comes to what a joined map of an earlier run shows: the run goes on in that one.

Without it each run would map the place once more, from the seam between two submaps on, and a map that is used many
times would grow by a submap with each use.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.types import Failure, FloatArray, Track
from dualslam.map.record import Record
from dualslam.places.sightings import SAME_WITHIN, Relocalised, Sighting, Sightings, median_depth, same_pose


class Handover:
    """Looks, where a keyframe is due, whether another submap has the place already.

    Parameters
    ----------
    record : Record
    sightings : Sightings
    earlier : set of int
        The submaps that earlier runs have left.
    """

    def __init__(self, record: Record, sightings: Sightings, earlier: Set[int]) -> None:
        self._record = record
        self._sightings = sightings
        self._earlier = earlier
        self._sighting: Sighting | None = None
        self._asked_at: tuple[int, int] | None = None  # submap and keyframe since which nothing else is asked

    def waits(self, track: Track, live: VisualOdometry, K: FloatArray) -> bool:
        """Return whether another submap seems to show what a frame shows for which a keyframe is due.

        The keyframe waits then for `follow` to be sure of it. It is asked once for each keyframe of the live map.

        Parameters
        ----------
        track : Track
            Of the frame, in the live map.
        live : VisualOdometry
        K : (3, 3)
            Intrinsics of the frame.
        """
        here = live.submap.id, live.reference_id
        self._forget_another(live)
        if self._sighting is not None or self._asked_at == here:
            return self._sighting is not None
        self._asked_at = here
        others = self._joined(live.submap.id) & self._earlier - {live.submap.id}
        if not others:
            return False
        self._sightings.take_in(live.submap)
        found = self._sightings.find(track.view, K, sorted(others))
        if found is not None and self._has(track, live, found, found.tracks[-1][0]):
            self._sighting = found
        return self._sighting is not None

    def follow(self, track: Track, live: VisualOdometry) -> Relocalised | None:
        """Show the frame to the submap that seems to have the place; return it once frames in a row say so.

        They must say the same as the live map and what joins the two: what does not is a loop to be closed first.
        """
        self._forget_another(live)
        sighting = self._sighting
        if sighting is None or sighting.tracks[-1][0].view.index == track.view.index:
            return None
        found = self._sightings.follow(sighting, track.view)
        if found is None:
            return None
        self._sighting = None
        if isinstance(found, Failure) or not self._has(track, live, sighting, found.track):
            return None
        return found

    def _forget_another(self, live: VisualOdometry) -> None:
        """Forget what was seen from another live map."""
        if self._asked_at is not None and self._asked_at[0] != live.submap.id:
            self._sighting = self._asked_at = None

    def _joined(self, submap_id: int) -> set[int]:
        return set(next(c for c in self._record.atlas.components() if submap_id in c))

    def _has(self, track: Track, live: VisualOdometry, sighting: Sighting, other: Track) -> bool:
        """Whether the other submap needs no keyframe of a frame, and puts it where the live one does."""
        if sighting.odometry.keyframe_due(other):
            return False
        sighting.odometry.go_by_known(other)  # from there it is to follow
        a, b = live.submap, sighting.odometry.submap
        component = sorted(self._joined(a.id))
        if b.id not in component:
            return False
        S_world = self._record.atlas.S_world_submap(component)
        S_a_b = sim3.inverse(S_world[a.id]) @ S_world[b.id]
        there = sim3.act_on_pose(S_a_b, se3.inverse(other.T_cam_submap))
        return same_pose(np.asarray(there), se3.inverse(track.T_cam_submap), SAME_WITHIN * median_depth(a, track))
