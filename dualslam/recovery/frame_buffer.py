"""The frames that reverse tracking can still read: features and grey images, in both directions of time.

K = k + k_r frames: the last k while all is well, and all that came since while the live submap is lost. Of frames that
came too late to be tracked it has the image alone. Memory has a hard bound. A long loss reaches it, and then the frames
of the loss give way: a recovery needs the k frames before it, which the old map saw, and the newest, with which the new
map starts. In order:

1. frames that came too late are dropped, the oldest first;
2. images are packed (`GreyImage.pack`), the oldest first: nothing is lost but time;
3. images of the stretch are dropped, each time the one whose neighbours stay closest together;
4. then whole frames of the stretch, in the same way;
5. where the bound does not even hold the rest, the oldest images, and at last the oldest frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from dualslam.core.resources import MB
from dualslam.core.types import LateFrame, View

SLOW_HZ = 5.0
"""Half the rate of the slowest usual recording. A slower clock leaves as many frames as this rate: not a handful."""


class FrameBuffer:
    """Views of the last `duration_s` seconds of video, and of all frames since a live submap was last there.

    - `duration_s`: video time that is kept (the paper's k frames); at least as many frames as `SLOW_HZ` gives in it.
    - `max_mb`: hard bound on the memory of features and images, mebibytes, also while frozen.

    - `nbytes`, `peak_bytes`: memory of features and images, now and at most so far.
    """

    def __init__(self, duration_s: float, max_mb: float) -> None:
        self.nbytes = 0
        self.peak_bytes = 0
        self.duration_s = duration_s
        self._max_bytes = max_mb * MB
        self._views: deque[View] = deque()
        self._late: deque[LateFrame] = deque()
        self._frozen = False
        self._before_loss: int | None = None  # the newest frame that came before it
        self._stale: set[int] = set()  # frames that are still to be changed
        self._change: Callable[[View], View] = lambda view: view
        self._subject = ""  # of that change

    def __len__(self) -> int:
        return len(self._views)

    def __iter__(self) -> Iterator[View]:
        """From the oldest to the newest, without those that came too late."""
        self.settle()
        return iter(self._views)

    @property
    def indices(self) -> list[int]:
        """Of these frames."""
        return [view.index for view in self._views]

    @property
    def late(self) -> tuple[LateFrame, ...]:
        """The frames that came too late, from the oldest to the newest."""
        return tuple(self._late)

    @property
    def numbers(self) -> dict[str, float]:
        """Its contents, for the event log."""
        images = sum(view.image is not None for view in self._views)
        return {"frames": len(self._views), "images": images, "buffer_mb": self.nbytes / MB}

    def append(self, view: View) -> None:
        """Take the newest view in and, unless frozen, let go of those that are older than the buffer's duration."""
        self._views.append(view)
        self.nbytes += view.nbytes
        n_least = SLOW_HZ * self.duration_s
        while not self._frozen and len(self._views) > n_least and self._age_s(self._views[0]) > self.duration_s:
            self.nbytes -= self._views.popleft().nbytes
        while self._late and self._late[0].index < self._views[0].index:
            self.nbytes -= self._late.popleft().nbytes
        if self.nbytes > self._max_bytes:
            self._make_room()
        self.peak_bytes = max(self.peak_bytes, self.nbytes)

    def append_late(self, frame: LateFrame) -> None:
        """Take in a frame that came too late to be tracked."""
        self._late.append(frame)
        self.nbytes += frame.nbytes

    def freeze(self) -> None:
        """Stop dropping old views: the newest one was lost, or there has been no map yet. K = k + k_r."""
        if not self._frozen:
            self._frozen = True
            self._before_loss = self._views[-2].index if len(self._views) > 1 else None

    def thaw(self) -> None:
        """Let the buffer be a queue again."""
        self._frozen = False

    def clear(self) -> None:
        """Let go of all views."""
        self._views.clear()
        self._late.clear()
        self._stale.clear()
        self.nbytes = 0

    def change_all(self, change: Callable[[Iterable[View]], Iterable[View]]) -> None:
        """Put what `change` makes of the views, oldest first, into their places."""
        self.settle()
        self._views = deque(change(self._views))
        self.nbytes = sum(view.nbytes for view in self._views) + sum(frame.nbytes for frame in self._late)

    def map_later(self, change: Callable[[View], View], subject: str) -> None:
        """Do the same in slices (`settle`), and what is left as soon as somebody looks.

        `change` must be idempotent. It replaces an unfinished one of the same `subject`, and follows one of another.
        """
        if subject != self._subject:
            self.settle()
        self._change, self._subject, self._stale = change, subject, set(self.indices)

    def newest(self, n: int) -> list[View]:
        """Return so many of the newest views, from the oldest to the newest, whatever is still to be done to others."""
        first = max(len(self._views) - n, 0)
        self.settle(sum(view.index in self._stale for view in islice(self._views, first, None)))
        return list(islice(self._views, first, None))

    def settle(self, n_at_most: int | None = None) -> None:
        """Change so many views of those that are still to be changed, the newest first; by default all."""
        if not self._stale:
            return
        n_left = len(self._stale) if n_at_most is None else n_at_most
        stale = [place for place in reversed(range(len(self._views))) if self._views[place].index in self._stale]
        for place in stale[:n_left]:
            view = self._views[place]
            self._views[place] = changed = self._change(view)
            self.nbytes += changed.nbytes - view.nbytes
            self._stale.remove(view.index)
        if len(stale) <= n_left:
            self._stale.clear()  # the rest has been let go of

    def backwards_from(self, index: int) -> Iterator[View]:
        """Yield the views that came before frame `index`, the latest first."""
        self.settle()
        seen = False
        for view in reversed(self._views):
            if seen:
                yield view
            seen = seen or view.index == index

    # --- the bound

    def _age_s(self, view: View) -> float:
        # Absolute: time may run either way.
        return abs(self._views[-1].timestamp_s - view.timestamp_s)

    def _make_room(self) -> None:
        """Give up what is needed least until the bound holds; the newest view always stays whole."""
        while self._late and self.nbytes > self._max_bytes:
            self.nbytes -= self._late.popleft().nbytes
        views = list(self._views)
        for i, view in enumerate(views[:-1]):
            if self.nbytes > self._max_bytes and view.image is not None:
                self._put(views, i, replace(view, image=view.image.pack()))
        stretch = self._stretch(views)
        for drop in (_without_image, _without_view):
            while self.nbytes > self._max_bytes and (place := _densest(views, stretch, drop)) is not None:
                self._put(views, place, drop(views[place]))
                if drop is _without_view:
                    stretch = range(stretch.start, stretch.stop - 1)
        for drop in (_without_image, _without_view):
            place = 0
            while self.nbytes > self._max_bytes and place < len(views) - 1:
                n = len(views)
                self._put(views, place, drop(views[place]))
                place += len(views) == n
        self._views = deque(views)

    def _put(self, views: list[View], place: int, view: View | None) -> None:
        """Put a view, or nothing, into the place of another."""
        self.nbytes -= views[place].nbytes
        if view is None:
            del views[place]
        else:
            views[place] = view
            self.nbytes += view.nbytes

    def _stretch(self, views: list[View]) -> range:
        """Places of the frames since the loss that are older than the newest `duration_s`."""
        if not self._frozen:
            return range(0)
        start = next((i + 1 for i, view in enumerate(views) if view.index == self._before_loss), 0)
        recent = next((i for i, view in enumerate(views) if self._age_s(view) <= self.duration_s), len(views))
        return range(start, max(start, recent))


def _without_image(view: View) -> View | None:
    return replace(view, image=None)


def _without_view(view: View) -> View | None:
    return None


def _densest(views: list[View], stretch: range, drop: Callable[[View], View | None]) -> int | None:
    """Place of the view of the stretch whose neighbours, counting those that have what is dropped, are closest."""
    have = [i for i, view in enumerate(views) if drop is _without_view or view.image is not None]
    inner = [n for n in range(1, len(have) - 1) if have[n] in stretch]
    if not inner:
        return None
    time_s = np.array([views[i].timestamp_s for i in have])
    gap_s = [abs(time_s[n + 1] - time_s[n - 1]) for n in inner]
    return have[inner[int(np.argmin(gap_s))]]
