"""Registration of frames in a finished map, as structure from motion does it: one by one, the surest first.

Each frame is posed by all keyframes that it resembles together, whatever their order, becomes a keyframe, and shows the
way to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from dualslam.core.config.settings import HealthConfig
from dualslam.core.interfaces import Registrar
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, Track, View
from dualslam.core.walk_news import REGISTRATION, WalkNews
from dualslam.map.landmark_views import landmark_covariances, resection_covariance
from dualslam.map.submap import Submap

MIN_PARALLAX_DEG = 1.5
"""Angle under which a landmark must have been seen to count. At 1 px and a focal length of 700 px its depth is known to
8 %. With less, poses and points confirm each other at any scale."""
NEAR, REACH = 5, 6
"""Keyframes nearest in time that a frame is matched with, and how many frames away they are at most."""
ALIKE = 8
"""Keyframes that it resembles and is matched with."""
MAX_SIGMA = 0.01
"""Of a position, relative to the depth of what is seen there."""
EXPLAINED = 0.9
"""Share of the matched landmarks that a pose must explain, as far as these are known. One relative pose explains all
matches of two images, so few are wrong. Where more disagree, the landmarks contradict each other."""
ADJUSTED_WITH = 8
"""Covisible keyframes that are adjusted with a new one."""
MAX_KEYFRAMES = 1000
"""Keyframes of a submap that takes no more frames: as many as its graph can be solved with."""
GROWTH = 1.1
"""All is adjusted again where the map has so many times the keyframes."""


@dataclass(slots=True)
class Registration:
    """Registers frames in one submap, which it changes."""

    submap: Submap
    views: dict[int, View]  # frames that may be registered, by their number
    alike: Mapping[int, list[int]]  # for each frame and keyframe those that it resembles, the best first
    registrar: Registrar
    adjust: Callable[[Submap, Collection[int]], None]  # adjusts keyframes in place, removes what does not fit
    health: HealthConfig
    watch: Callable[[WalkNews], None]  # receives the news of each frame that is registered
    added: list[int] = field(default_factory=list)  # frames that were registered, in their order
    _tracks: dict[int, Track] = field(default_factory=dict)  # of frames that may be registered now
    _repeated: set[int] = field(default_factory=set)  # frames for which two poses stood

    def run(self) -> None:
        """Register all frames that can be."""
        if any(self._ask(i) for i in sorted(self.views)):
            self.registrar.densify()
            self._grow()

    def run_without(self, frames: Collection[int]) -> None:
        """Remove registered frames from the submap, and register others that can be."""
        for i in set(frames) & set(self.added):
            self.submap.remove_keyframe(i, next(k for k in self.submap.keyframes_near(i) if k != i))
            del self.submap.anchors[i], self.views[i]
            self.added.remove(i)
        self._grow()

    # --- steps

    def _grow(self) -> None:
        due = set(self.views)
        n_asked = n_adjusted = self._adjust_all()
        while len(self.submap.keyframes) < MAX_KEYFRAMES:
            for i in sorted(due):
                self._ask(i)
            due.clear()
            best = max(self._tracks, key=lambda i: (self._tracks[i].n_inliers, -i), default=None)
            if best is None:
                if len(self.submap.keyframes) == n_asked:
                    return
                due = set(self.views)
                n_asked = n_adjusted = self._adjust_all()
                self._repeated.clear()  # the map shows more now, by which two poses differ
                continue
            # The map has grown, or was adjusted, since the frame was posed.
            if not self._ask(best) or self._is_repeated(best):
                continue
            self._add(best)
            self.added.append(best)
            self._report(best, len(self.added))
            due = self._beside(best)
            if len(self.submap.keyframes) >= GROWTH * n_adjusted:
                n_adjusted = self._adjust_all()

    def _adjust_all(self) -> int:
        """Adjust all keyframes; return how many there are."""
        self.adjust(self.submap, self.submap.keyframes)
        return len(self.submap.keyframes)

    def _report(self, i: int, n_added: int) -> None:
        T = self.submap.T_submap_kf[i].astype(np.float32)
        self.watch(WalkNews(self.submap.id, REGISTRATION, i, True, n_added, T, T[None, :3, 3]))

    def _keyframes_for(self, i: int) -> list[int]:
        """Return the keyframes that a frame is matched with."""
        sound = self.submap.keyframes.keys() - self.submap.condemned
        near = [k for k in self.submap.keyframes_near(i) if k in sound and abs(k - i) <= REACH][:NEAR]
        alike = [k for k in self.alike.get(i, ()) if k in sound and k not in near]
        return near + alike[:ALIKE]

    def _beside(self, i: int) -> set[int]:
        """Return the frames that may be registered and are matched with a keyframe."""
        near = set(range(i - REACH, i + REACH + 1))
        return (near | {j for j in self.views if i in self.alike.get(j, ())}) & self.views.keys()

    def _ask(self, i: int) -> bool:
        """Pose a frame by the current submap; return whether it is sure."""
        self._tracks.pop(i, None)
        keyframes = self._keyframes_for(i)
        if i in self.submap.keyframes or i in self._repeated or not keyframes:
            return False
        track = judge_track(self.registrar.pose(self.views[i], keyframes), self.health)
        if isinstance(track, Failure) or track.n_inliers < EXPLAINED * track.n_matches or not self._is_sure(track):
            return False
        self._tracks[i] = track
        return True

    def _is_sure(self, track: Track) -> bool:
        """Whether the pose is known, as uncertain as the landmarks are that it stands on."""
        submap, seen = self.submap, track.seen_ids
        sigma = track.view.features.sigma_px[track.landmark_ids >= 0]
        covariance = resection_covariance(submap, seen, sigma, track.T_cam_submap, landmark_covariances(submap, seen))
        if covariance is None:
            return False
        depth = float(np.median(submap.depths(seen, track.T_cam_submap)))
        return float(np.sqrt(np.trace(covariance[3:, 3:]))) < MAX_SIGMA * depth

    def _is_repeated(self, i: int) -> bool:
        """Whether another pose explains nearly as much of a frame, which is not asked any more then."""
        why = self.registrar.refuse_repeated(self._tracks[i], self._keyframes_for(i))
        if why is not None:
            self._repeated.add(i)
            del self._tracks[i]
        return why is not None

    def _add(self, i: int) -> None:
        track, others = self._tracks.pop(i), self._keyframes_for(i)
        self.registrar.insert(track)
        covisible = self.submap.covisible(track.seen_ids)[0].tolist()
        free = [i, *(k for k in covisible if k != i)][: ADJUSTED_WITH + 1]
        self.adjust(self.submap, free)
        self.registrar.extend(i, others)
