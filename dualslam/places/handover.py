"""Continue a run in the joined map of an earlier run, once the live map reaches its place."""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from dualslam.atlas.record import Record
from dualslam.core.geometry import se3, sim3
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.noise_model import SAME_WITHIN
from dualslam.core.types import Failure, FloatArray, Track, View
from dualslam.places.sightings import Relocalised, Search, Sighting, Sightings, median_depth, same_pose


class Handover:
    """Looks, where a keyframe is due, whether a submap of the `earlier` runs has the place already."""

    def __init__(self, record: Record, sightings: Sightings, earlier: Set[int]) -> None:
        self._record = record
        self._sightings = sightings
        self._earlier = earlier
        self._sighting: Sighting | None = None
        self._asked_at: tuple[int, int] | None = None  # submap and keyframe since which nothing else is asked
        self._search: Search | None = None  # one that goes on from frame to frame

    def waits(self, track: Track, live: VisualOdometry, K: FloatArray, in_parts: bool = False) -> bool:
        """Return whether another submap seems to show what a frame shows for which a keyframe is due.

        The keyframe waits then for `follow` to be sure of it. It is asked once for each keyframe of the live map.

        - `track`: of the frame, in the live map.
        - `K` (3, 3): intrinsics of the frame.
        - `in_parts`: for real time: each call asks the index, or poses the frame by one of up to three keyframes that
          it has named, and the keyframe waits meanwhile. The caller adds the submaps to the index.
        """
        self._forget_another(live)
        if self._sighting is None and self._search is not None:
            return self._search_on(self._search, track, live)
        here = live.submap.id, live.reference_id
        if self._sighting is not None or self._asked_at == here:
            return self._sighting is not None
        self._asked_at = here
        others = self._joined(live.submap.id) & self._earlier - {live.submap.id}
        if not others:
            return False
        if not in_parts:
            self._sightings.take_in(live.submap)
        search = self._sightings.search(track.view, K, sorted(others))
        if in_parts and search.candidates:
            self._search = search
            return True
        while self._sightings.go_on(search):
            pass
        self._take(search, track, live)
        return self._sighting is not None

    def _search_on(self, search: Search, track: Track, live: VisualOdometry) -> bool:
        """Pose the newest frame by the next keyframe of a search; return whether the place was found, or may be yet."""
        search.view = track.view
        as_before = all(self._record.atlas.submaps.get(m) is submap for m, submap in search.submaps.items())
        if as_before and self._sightings.go_on(search):
            self._take(search, track, live)
            search.found.clear()
            if self._sighting is None and search.candidates:
                return True
        self._search = None
        return self._sighting is not None

    def _take(self, search: Search, track: Track, live: VisualOdometry) -> None:
        """Follow what was found, where it has the place."""
        found = self._sightings.outcome(search)
        if found is not None and self._has(track, live, found, found.tracks[-1][0]):
            self._sighting = found

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

    def follow_alone(self, view: View, live: VisualOdometry) -> Relocalised | None:
        """Show a frame that the live map could not pose to the submap that both posed alike so far."""
        self._forget_another(live)
        if self._sighting is None:
            return None
        found = self._sightings.follow(self._sighting, view)
        if found is None:
            return None
        self._sighting = None
        return None if isinstance(found, Failure) else found

    def _forget_another(self, live: VisualOdometry) -> None:
        """Forget what was seen from another live map."""
        if self._asked_at is not None and self._asked_at[0] != live.submap.id:
            self._sighting = self._asked_at = self._search = None

    def _joined(self, submap_id: int) -> set[int]:
        return set(self._record.atlas.component_of(submap_id))

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
