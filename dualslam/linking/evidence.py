"""Gates of links and places, and what reverse tracking decides by when a link is not made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.types import Failure, FailureReason


@dataclass(frozen=True, slots=True)
class Gate:
    """One condition of a join: its outcome, and what a refusal says."""

    passed: bool
    reason: FailureReason
    detail: str


def first_refusal(gates: Iterable[Gate], numbers: dict[str, float]) -> Failure | None:
    """Return the refusal of the first gate that is not passed; `numbers` are for the event log."""
    refused = next((gate for gate in gates if not gate.passed), None)
    return None if refused is None else Failure(refused.reason, refused.detail, numbers)


def sigma_gates(scale: float, rotation_deg: float, position: float, config: LinkingConfig) -> list[Gate]:
    """Return the gates of a similarity's sigmas; those of scale and position are relative."""
    return [
        Gate(scale <= config.max_scale_sigma, FailureReason.SCALE, f"scale known to {scale:.1%}"),
        Gate(
            rotation_deg <= config.max_rotation_sigma_deg,
            FailureReason.DEGENERATE,
            f"rotation known to {rotation_deg:.2f} deg",
        ),
        Gate(position <= config.max_position_sigma, FailureReason.DEGENERATE, f"position known to {position:.1%}"),
    ]


@dataclass(frozen=True, slots=True)
class LinkRefusal(Failure):
    """A link that is not made. `Failure.numbers` are for the event log alone.

    Attributes
    ----------
    torn_at : int or None
        The keyframe before which the new map is torn.
    walk_sigma : float
        Relative sigma of the scale that reverse tracking has handed on; 0 where another gate came first.
    """

    torn_at: int | None = None
    walk_sigma: float = 0.0
