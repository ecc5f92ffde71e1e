"""When reverse tracking is made again, over which frames, and what the tries at a link before it count for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from statistics import NormalDist

from dualslam.atlas.trajectory import FramePose
from dualslam.core.camera.base import Camera
from dualslam.core.noise_model import GROWN
from dualslam.core.types import Failure, FailureReason, View
from dualslam.map.submap import Submap

RISK = 0.05
"""Of a wrong link, over all tries together: what the bound on its sigma, half of what counts as wrong, stands for."""


def tightened(max_sigma: float, n_tries: int) -> float:
    """Return the bound on a sigma that holds the risk of one try over `n_tries` of them (Bonferroni)."""
    z_one, z_all = (NormalDist().inv_cdf(1.0 - RISK / (2 * n)) for n in (1, max(n_tries, 1)))
    return max_sigma * z_one / z_all


class LinkTries:
    """Results of earlier tries at linking each lost map; `refused`: by lost map, those refused for the scale."""

    def __init__(self, refused: Mapping[int, int] | None = None) -> None:
        self.refused: Counter[int] = Counter(refused)
        self._held: set[int] = set()  # lost maps whose last try passed

    def copy(self) -> LinkTries:
        """Return tries that go on by themselves."""
        copied = LinkTries(self.refused)
        copied._held = set(self._held)
        return copied

    def take_in(self, old_id: int, before: LinkTries, after: LinkTries) -> None:
        """Add what a walk has tried at one lost map: it knew `before`, and knows `after` now."""
        self.refused[old_id] += after.refused[old_id] - before.refused[old_id]
        if old_id not in after._held:
            self._held.discard(old_id)
        elif old_id not in before._held:
            self._held.add(old_id)

    def note_try(self, old_id: int, reason: FailureReason) -> None:
        """Count a try that came to nothing."""
        if reason is not FailureReason.UNCONFIRMED:
            self._held.discard(old_id)
        if reason in (FailureReason.SCALE, FailureReason.SCALE_LOST):
            self.refused[old_id] += 1

    def judge(self, old_id: int, sigma_scale: float, max_sigma: float) -> Failure | None:
        """Return why a link that has passed is to be tried again, if it is.

        After refused tries it must pass twice in a row, in one walk or two. Or it must pass at once the tighter bound
        that allows for them.
        """
        n_refused = self.refused[old_id]
        if n_refused == 0 or old_id in self._held or sigma_scale <= tightened(max_sigma, n_refused + 1):
            return None
        self._held.add(old_id)
        detail = f"it holds after {n_refused} tries that were refused for the scale, and must hold again"
        return Failure(FailureReason.UNCONFIRMED, detail, {"sigma_scale": sigma_scale, "tries": n_refused + 1.0})


class RetrySchedule:
    """Knows of each submap whose walk has left something to find when the next walk is due.

    That is when the submap has grown at its live end, or its camera has been calibrated. A walk whose link its own
    pixels refuse, as they contradict the camera, waits for another camera: growth alone links none. So does one that
    held all keyframes of the lost maps, and these left the scale open.

    `keyframes`: live keyframes at which a walk is made again, see `RecoveryConfig.retry_keyframes`.
    """

    def __init__(self, keyframes: tuple[int, ...]) -> None:
        self._keyframes = keyframes
        self._starts: dict[int, int] = {}
        self._tried: dict[int, tuple[int, Camera, bool, bool]] = {}
        self._stopped_at: dict[int, int | None] = {}

    def start_of(self, submap: Submap, newest_id: int) -> int:
        """Return the keyframe that the submap's first walk started from: `newest_id`, if this is the first."""
        return self._starts.setdefault(submap.id, newest_id)

    def n_live(self, submap: Submap, now: int) -> int:
        """Count the keyframes from the start to frame `now`: not those that walks have added."""
        return sum(self._starts[submap.id] <= k <= now for k in submap.keyframes)

    def leave_open(
        self, submap_id: int, n_live: int, camera: Camera, needs_camera: bool = False, stopped_at: int | None = None
    ) -> None:
        """Note that a walk which knew so many live keyframes, and this camera, has left something to find.

        `needs_camera`: no later one does better under this camera. `stopped_at`: the frame at which it stopped, before
        it met a lost map. If the one before it stopped there too, growth changes nothing.
        """
        is_stuck = stopped_at is not None and stopped_at == self._stopped_at.get(submap_id)
        self._stopped_at[submap_id] = stopped_at
        self._tried[submap_id] = n_live, camera, needs_camera or is_stuck, is_stuck

    def take_if_due(self, submap: Submap, now: int, camera: Camera, last_chance: bool = False) -> bool:
        """Return whether the next walk is due; if so it is off the list, until it too leaves something to find.

        `last_chance`: the submap grows no more, so that less growth since the last walk will do.
        """
        if submap.id not in self._tried:
            return False
        tried_with, tried_camera, needs_camera, is_stuck = self._tried[submap.id]
        n_live = self.n_live(submap, now)
        due = not needs_camera and any(tried_with < n <= n_live for n in self._keyframes)
        due |= camera != tried_camera
        due |= last_chance and not is_stuck and bool(self._keyframes) and n_live >= GROWN * tried_with
        if due:
            del self._tried[submap.id]
        return due


def as_far_as_it_leads(
    views: Iterable[View], poses: Mapping[int, FramePose], submap: Submap, linked: Collection[int]
) -> Iterator[View]:
    """Yield the views, latest first, up to where only frames of another map follow, which are not this one's to pose.

    - `submap`: the one that the walk sets out from.
    - `linked`: submaps that are one map with it: as far as this one has keyframes there as well, their frames count.
    """
    oldest = min(submap.keyframes)

    def leads_on(view: View) -> bool:
        posed_in = poses[view.index].submap_id if view.index in poses else submap.id
        return posed_in == submap.id or (posed_in in linked and view.index >= oldest)

    return takewhile(leads_on, views)


def way_to_gaps(views: Sequence[View], posed: Collection[int], keyframe_ids: Collection[int]) -> list[View]:
    """Return, of the views in the order of a walk, those without a pose that a keyframe leads to, and what leads there.

    It begins with the last keyframe before the first of them. Between gaps it goes by the keyframes, and by the last
    frame before each gap.

    `posed`: frames that have a pose. `keyframe_ids`: the submap's.
    """
    lacking = [view.index not in posed and view.index not in keyframe_ids for view in views]
    places = [i for i, view in enumerate(views) if view.index in keyframe_ids]
    gaps = [i for i, lacks in enumerate(lacking) if lacks and places and i > places[0]]
    if not gaps:
        return []
    first, last = max(i for i in places if i < gaps[0]), gaps[-1]
    wanted = {*places, *gaps, *(i - 1 for i in gaps)}
    return [views[i] for i in range(first, last + 1) if i in wanted]
