"""Tries at a link that remember each other: what passes a 95 % gate at the sixth try has not passed a 95 % gate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from statistics import NormalDist

from dualslam.core.types import Failure, FailureReason

RISK = 0.05
"""Of a wrong link, over all tries together: what the bound on its sigma, half of what counts as wrong, stands for."""


def tightened(max_sigma: float, n_tries: int) -> float:
    """Return the bound on a sigma that holds the risk of one try over `n_tries` of them (Bonferroni)."""
    z_one, z_all = (NormalDist().inv_cdf(1.0 - RISK / (2 * n)) for n in (1, max(n_tries, 1)))
    return max_sigma * z_one / z_all


class LinkTries:
    """Results of earlier tries at linking each lost map, over all walks and attempts.

    Attributes
    ----------
    refused : Counter of int
        By lost map, the tries that were refused for the scale.
    """

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
