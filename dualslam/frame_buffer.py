"""The frames that a walk back in time can still read: features of the last seconds, in both directions of time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

from dualslam.core.types import View


class FrameBuffer:
    """Views of the last `duration_s` seconds of video, and of all frames since the live submap was lost.

    Parameters
    ----------
    duration_s : float
        Video time that is kept (the paper's k frames).
    max_views : int
        Hard bound on the number of views; beyond it the oldest go, also while frozen.
    """

    def __init__(self, duration_s: float, max_views: int) -> None:
        self._duration_s = duration_s
        self._views: deque[View] = deque(maxlen=max_views)
        self._frozen = False

    def __len__(self) -> int:
        return len(self._views)

    def append(self, view: View) -> None:
        """Take the newest view in and, unless frozen, let go of those that are older than the buffer's duration."""
        self._views.append(view)
        while not self._frozen and abs(view.timestamp_s - self._views[0].timestamp_s) > self._duration_s:
            self._views.popleft()

    def freeze(self) -> None:
        """Stop letting go of old views (a track was lost): K = k + k_r."""
        self._frozen = True

    def thaw(self) -> None:
        """Let the buffer be a queue again."""
        self._frozen = False

    def map(self, change: Callable[[View], View]) -> None:
        """Put what `change` makes of it into the place of each view."""
        self._views = deque((change(view) for view in self._views), self._views.maxlen)

    def backwards_from(self, index: int) -> Iterator[View]:
        """Yield the views that came before frame `index`, the latest first."""
        seen = False
        for view in reversed(self._views):
            if seen:
                yield view
            seen = seen or view.index == index
