"""Join test: the gates that two maps pass before they are joined, or a frame before it is posed, and their evidence.

A gate that is passed need not be sure: the scale of a link may be known too loosely to be relied on, and well enough
to join. What is joined so carries a doubt.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from dualslam.core.chi_square import CHI2_99
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.decisions import Gate
from dualslam.core.noise_model import GATE_SIGMAS, GROUP, MAJORITY, MAX_SLIP, TINY
from dualslam.core.types import Failure, FailureReason
from dualslam.linking.motion import Motion

MAX_DRIFT, MAX_DRIFT_DEG, MAX_DRIFT_LOG_SCALE = 0.5, 60.0, math.log(3.0)
"""Largest drift of a map between two places, if it was never lost there: a share of the way, a turn, a log-scale. Two
neighbouring copies of a thing are half the way apart. The largest drift of a real sequence is 47 % in scale."""
PAIR_CHI2 = CHI2_99[3]
"""Gate of a matched pair's squared Mahalanobis distance: chi-square, 3 degrees of freedom, 99 %."""
PIXEL_CHI2 = CHI2_99[2]
"""Gate of a squared whitened reprojection residual: chi-square, 2 degrees of freedom, 99 %."""
MIN_PAIRS_PER_KEYFRAME = 8
"""Matched landmarks that a keyframe must hold to have a say (four fix a similarity with one to spare)."""
MAX_MISFITS = 1
"""Keyframes in a row that may disagree before this counts as a change point: one can be wrong by itself."""
MIN_TIES = 10
"""Landmarks that keyframes on both sides of a place in the old map must see in agreement with their pixels. With fewer
the old map is broken there, and its newer part counts as suspected."""
LOOK_BACK = 2 * GROUP
"""Keyframes of the old map, older than the oldest shared one, among which a break is still looked for."""
MINORITY_DEFORMATION = 0.03
"""Relative deformation (standard deviation) of a map beyond a place where it hands on fewer than half of what its
keyframes see. Where an occluder comes in, maps of rendered worlds lost up to 8 % of their scale and claimed 0.9 %."""
MIN_IMAGE_SPREAD = 0.25
"""Share of the image, along either axis, that 90 % of the agreeing landmarks must cover, of the keypoints' own."""
MAX_SCALE = 50.0
"""Largest scale, and inverse of the smallest: that is the ratio of the depths at the submaps' starts."""
MAX_HYPOTHESES = 512
"""Triplets that RANSAC draws at most."""


@dataclass(frozen=True, slots=True)
class JoinGate:
    """One condition of a join: comparisons all of which must hold, and what a refusal says."""

    compared: tuple[Gate, ...]  # by their names in the event log
    reason: FailureReason  # of a refusal
    detail: str  # what a refusal says
    sure: bool = True  # whether the join may be relied on, as far as this gate goes
    logged: dict[str, float] = field(default_factory=dict)  # what else was measured, for the event log alone

    @classmethod
    def at_most(
        cls, name: str, value: float, limit: float, reason: FailureReason, detail: str, sure: float | None = None
    ) -> JoinGate:
        """Return a gate that a value passes up to a limit; it is sure up to `sure`."""
        return cls((Gate(name, value, "<=", limit),), reason, detail, value <= (limit if sure is None else sure))

    @classmethod
    def at_least(cls, name: str, value: float, limit: float, reason: FailureReason, detail: str) -> JoinGate:
        """Return a gate that a value passes from a limit on."""
        return cls((Gate(name, value, ">=", limit),), reason, detail)

    @property
    def passed(self) -> bool:
        """Whether all comparisons hold."""
        return all(gate.passed for gate in self.compared)


@dataclass(frozen=True, slots=True)
class LinkEvidence:
    """All gates of a join, in the order in which they were asked."""

    gates: tuple[JoinGate, ...]

    @classmethod
    def of(cls, gates: Iterable[JoinGate]) -> LinkEvidence:
        """Return the evidence of some gates, up to the first that is not passed: a refusal needs no more."""
        asked = []
        for gate in gates:
            asked.append(gate)
            if not gate.passed:
                break
        return cls(tuple(asked))

    @property
    def is_accepted(self) -> bool:
        """Whether all gates are passed."""
        return all(gate.passed for gate in self.gates)

    @property
    def is_sure(self) -> bool:
        """Whether it may be relied on, too."""
        return all(gate.passed and gate.sure for gate in self.gates)

    @property
    def comparisons(self) -> tuple[Gate, ...]:
        """The gates as written to ``decisions.jsonl``."""
        return tuple(gate for asked in self.gates for gate in asked.compared)

    @property
    def numbers(self) -> dict[str, float]:
        """The measured values, for the event log."""
        compared = {gate.name: gate.value for gate in self.comparisons}
        return compared | {name: n for gate in self.gates for name, n in gate.logged.items()}

    def refusal(self, numbers: dict[str, float] | None = None) -> Failure | None:
        """Return why the join is not made; `numbers`: for the event log, besides."""
        return None if self.is_accepted else self.doubt(numbers)

    def doubt(self, numbers: dict[str, float] | None = None) -> Failure | None:
        """Return why the join is not to be relied on, whether it is made or not: by the first such gate."""
        gate = next((gate for gate in self.gates if not (gate.passed and gate.sure)), None)
        if gate is None:
            return None
        return Failure(gate.reason, gate.detail, self.numbers | (numbers or {}), gates=self.comparisons)


# --- the gates


def support_gate(n_keyframes: int, needed: int) -> JoinGate:
    """Return the gate of the keyframes that agree one by one."""
    detail = f"{n_keyframes} keyframes agree, {needed} needed"
    return JoinGate.at_least("n_agreeing_keyframes", n_keyframes, needed, FailureReason.AGREEMENT, detail)


def similarity_gates(scale: float, rotation_deg: float, position: float, config: LinkingConfig) -> list[JoinGate]:
    """Return the gates of a similarity's standard deviations; those of scale and position are relative."""
    return [
        JoinGate.at_most(
            "sigma_scale",
            scale,
            config.max_joined_scale_sigma,
            FailureReason.SCALE,
            f"scale known to {scale:.1%}",
            config.max_scale_sigma,
        ),
        JoinGate.at_most(
            "sigma_rot_deg",
            rotation_deg,
            config.max_rotation_sigma_deg,
            FailureReason.DEGENERATE,
            f"rotation known to {rotation_deg:.2f} deg",
        ),
        JoinGate.at_most(
            "sigma_trans_rel",
            position,
            config.wrong_position,
            FailureReason.DEGENERATE,
            f"position known to {position:.1%}",
            config.max_position_sigma,
        ),
    ]


def live_scale_gate(sigma: float, detail: str, reason: FailureReason, config: LinkingConfig) -> JoinGate:
    """Return the gate of the scale at the live end of the new map."""
    return JoinGate.at_most(
        "sigma_scale", sigma, config.max_joined_scale_sigma, reason, detail, config.max_live_scale_sigma
    )


def parting_gate(log_scale: float, sigma_old: float, sigma_new: float, n_parted: int) -> JoinGate:
    """Return the gate of two maps that agree, and part at newer keyframes: it must be the old one that gave way.

    If the new one is bent in between, the link is wrong at the live end, for which it is made. Each map's share of the
    difference is in proportion to its variance between the two places. So the old map is to blame only if it is the
    looser one by far. If the scales differ by more than the variances allow, one map is broken without knowing it.

    - `log_scale`: by which they part.
    - `sigma_old`, `sigma_new`: how well each holds the scale from where they agree to where they part.
    - `n_parted`: keyframes there.
    """
    sigma = math.hypot(sigma_old, sigma_new)
    possible = Gate("log_scale", abs(log_scale), "<=", GATE_SIGMAS * sigma)
    by_old = Gate("held_old", sigma_old, ">", GATE_SIGMAS * sigma_new)  # not where both are infinite
    detail = f"the maps part at {n_parted} newer keyframes, and either may be the bent one"
    if not possible.passed:
        detail = f"the maps part by {log_scale:+.0%} in scale at {n_parted} newer keyframes, and neither is torn"
    logged = {"held_new": sigma_new, "parted": float(n_parted)}
    return JoinGate((possible, by_old), FailureReason.AGREEMENT, detail, logged=logged)


def drift_gate(share_of_way: float, turn_deg: float, log_scale: float) -> JoinGate:
    """Return the gate of what a map that was never lost between two places can have drifted.

    A lost turn or scale displaces what comes after it: at most by as much as if all was lost at the beginning.

    - `share_of_way`: distance between where the map and where the pixels put a place, over the length of the way.
    - `turn_deg`, `log_scale`: between the two, as well.
    """
    limit = min(MAX_DRIFT, MAX_SLIP + math.radians(turn_deg) + math.expm1(abs(log_scale)))
    compared = (
        Gate("drift", share_of_way, "<=", limit),
        Gate("drift_rot_deg", turn_deg, "<=", MAX_DRIFT_DEG),
        Gate("drift_log_scale", abs(log_scale), "<=", MAX_DRIFT_LOG_SCALE),
    )
    detail = (
        f"the map would have drifted by {share_of_way:.0%} of the way, {turn_deg:.0f} deg"
        f" and {math.expm1(log_scale):+.0%} in scale"
    )
    return JoinGate(compared, FailureReason.CONTRADICTION, detail)


def ambiguity_gate(support: int, first_support: int) -> JoinGate:
    """Return the gate of a second similarity, by the landmarks that it and the first one explain."""
    compared = (Gate("second_support", support, "<", MAJORITY * first_support),)
    detail = f"a second pose explains {support} landmarks, the first {first_support}"
    return JoinGate(compared, FailureReason.AMBIGUOUS_MODEL, detail, logged={"first_support": float(first_support)})


def judge_motion(motions: Iterable[Motion]) -> LinkEvidence:
    """Judge the camera's motion across gaps and seams: of two maps, of frames that change to another, or in one."""
    return LinkEvidence.of(map(motion_gate, motions))


def motion_gate(motion: Motion) -> JoinGate:
    """Return the gate of one motion: off by no more than the run itself explains."""
    times = motion.off_mu / max(motion.usual_mu, TINY)
    detail = f"the camera is {times:.0f} times further from where its velocities lead than elsewhere"
    compared = (Gate("leap_off", motion.off_mu, "<=", motion.allowed_mu),)
    logged = {"leap_usual": motion.usual_mu, "leap_asked": float(motion.n_asked)}
    return JoinGate(compared, FailureReason.LEAP, detail, logged=logged)
