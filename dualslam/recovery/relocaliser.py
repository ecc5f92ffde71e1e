"""Looking for the map that was lost last, until another has started: seen twice in a row, it is continued."""

from __future__ import annotations

from collections.abc import Callable

from dualslam.core.config.settings import Config
from dualslam.core.interfaces import Seeker, SubmapGraph, VisualOdometry
from dualslam.core.support import judge_track
from dualslam.core.types import View
from dualslam.map.submap import Submap


class Relocaliser:
    """Shows each frame without a map to a front end that finds its submap again wherever it is seen.

    `new_relocaliser`: makes that front end of a submap and its graph.
    """

    def __init__(self, new_relocaliser: Callable[[Submap, SubmapGraph], Seeker], config: Config) -> None:
        self._new_frontend = new_relocaliser
        self._config = config
        self._after = config.recovery.relocalise_after if config.recovery.enabled else None
        self._frontend: VisualOdometry | None = None
        self._n_unseen = 0  # frames since the loss that show something, without a start
        self._sighted = False  # whether the last one has shown the map

    @property
    def relocaliser(self) -> VisualOdometry | None:
        """The front end that is shown the frames; none where no map is looked for."""
        return self._frontend

    def begin(self, lost: VisualOdometry) -> None:
        """Look for the map of a front end that has lost it, from now on; no longer for any other."""
        self.end()
        if self._after is not None:
            self._frontend = self._new_frontend(lost.submap, lost.graph)
            self._frontend.start_at(lost.reference_id)

    def end(self) -> None:
        """Look for no map any more."""
        self._frontend, self._n_unseen, self._sighted = None, 0, False

    def note(self, view: View) -> bool:
        """Count a frame without a map; return whether it is to be shown.

        It is not as long as another map may soon start (`recovery.relocalise_after`).
        """
        if self._frontend is None or self._after is None:
            return False
        self._n_unseen += len(view.features) >= self._config.tracking.min_inliers
        return self._n_unseen > self._after

    def sighted(self, view: View) -> VisualOdometry | None:
        """Return the front end that may continue in its map with this frame, if the one before was found there."""
        if self._frontend is None:
            return None
        if self._sighted:
            self._sighted = False
            return self._frontend
        self._sighted = bool(judge_track(self._frontend.track(view), self._config.health))
        return None
