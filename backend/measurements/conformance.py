"""Does a measurement keep what `Measurement` promises? For ours, and for other packages'.

In a test of another package::

    from dualslam.backend.measurements.conformance import CHECKS

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_measurement_conforms(check):
        check(MyMeasurement)

Each check raises `NotConforming` and says what is wrong. The poses are drawn with a fixed seed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dualslam.backend.measurements.base import Gauge, Measurement
from dualslam.core.conformance import NotConforming, expect
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FloatArray

SIGMA = 0.1
STEP, TOLERANCE = 1e-6, 1e-5
"""Of central differences, and how far a Jacobian may differ from them, relative to its largest number."""
TIMES_S = (1.0, 2.5)


def _poses(seed: int = 0) -> FloatArray:
    return np.asarray(se3.exp(np.random.default_rng(seed).normal(size=(2, se3.DOF)) * np.repeat([0.6, 3.0], 3)))


def _exact(cls: type[Measurement], T: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """Return the exact reading at poses, those that it is about, and zeros for its shared unknowns."""
    reading = cls.simulate(TIMES_S, T, SIGMA)
    return reading, T[: len(reading.times_s)], np.zeros(len(cls.shared_sigmas))


def check_declaration(cls: type[Measurement]) -> None:
    """Check that kind, columns, units and sigmas are there and fit each other."""
    reading, T, shared = _exact(cls, _poses())
    expect(bool(cls.kind) and "," not in cls.kind, "kind is a word")
    r, J = reading.residual(T, shared)
    expect(r.shape == (len(cls.units),), f"{len(cls.units)} units for a residual of shape {r.shape}")
    expect(set(cls.units) <= {"m", "rad"}, "units are m or rad")
    expect(np.shape(reading.sigmas) == r.shape, "one sigma for each component of the residual")
    expect(bool((np.asarray(reading.sigmas) > 0).all()), "sigmas are above 0")
    expect(J.shape == (len(r), se3.DOF * len(T) + len(shared)), f"the Jacobian has shape {J.shape}")
    expect(1 <= len(reading.times_s) <= 2, "a measurement is about one or two poses")


def check_zero_at_truth(cls: type[Measurement]) -> None:
    """Check that an exact reading has no residual; one of the same place is made at one pose."""
    T = _poses(1)
    for at in (T, np.stack((T[0], T[0]))):
        reading, poses, shared = _exact(cls, at)
        if np.abs(reading.residual(poses, shared)[0]).max() < 1e-9:
            return
    raise NotConforming("the residual of an exact reading is not zero")


def check_jacobian(cls: type[Measurement]) -> None:
    """Check the Jacobian against central differences, away from the truth."""
    reading, _, _ = _exact(cls, _poses(2))
    T = _poses(2) @ se3.exp(0.05 * np.random.default_rng(3).normal(size=(2, se3.DOF)))
    T = T[: len(reading.times_s)]
    shared = 0.01 * np.ones(len(cls.shared_sigmas))
    J = reading.residual(T, shared)[1]

    def moved(step: FloatArray) -> FloatArray:
        n = se3.DOF * len(T)
        return np.asarray(reading.residual(T @ se3.exp(step[:n].reshape(-1, se3.DOF)), shared + step[n:])[0])

    numerical = np.stack([moved(d) - moved(-d) for d in STEP * np.eye(J.shape[1])], axis=1) / (2 * STEP)
    off = float(np.abs(J - numerical).max())
    expect(off < TOLERANCE * max(1.0, float(np.abs(numerical).max())), f"the Jacobian is off by {off:.2g}")


def check_gauge(cls: type[Measurement]) -> None:
    """Check that moving all poses together changes the residual where `fixes` says so, and nowhere else."""
    moves = {
        Gauge.TRANSLATION: [se3.from_parts(np.eye(3), d) for d in np.eye(3)],
        Gauge.ROTATION: [se3.from_parts(so3.exp(0.3 * d), np.zeros(3)) for d in np.eye(3)],
        Gauge.SCALE: [sim3.from_parts(1.2, np.eye(3), np.zeros(3))],
    }
    for seed in (4, 5):
        reading, T, shared = _exact(cls, _poses(seed))
        before = reading.residual(T, shared)[0]
        for gauge, several in moves.items():
            after = np.array([reading.residual(sim3.act_on_pose(S, T), shared)[0] for S in several])
            change = float(np.abs(after - before).max())
            if gauge in cls.fixes:
                expect(change > 1e-6, f"it is said to fix the {gauge}, and does not feel it")
            elif not (gauge is Gauge.SCALE and "m" in cls.units and not cls.fixes):  # lengths that are to be 0
                expect(change < 1e-9, f"it feels the {gauge}, which it is not said to fix")


def check_units(cls: type[Measurement]) -> None:
    """Check that components in rad do not depend on the unit of length, and no component grows faster than its unit."""
    reading, T, shared = _exact(cls, _poses(6))
    J = reading.residual(T, shared)[1]
    grown = sim3.act_on_pose(sim3.from_parts(2.0, np.eye(3), np.zeros(3)), T)
    change = np.abs(reading.residual(grown, shared)[0] - reading.residual(T, shared)[0])
    for i, unit in enumerate(cls.units):
        if unit == "rad":
            expect(float(change[i]) < 1e-9, f"component {i} is in rad and depends on lengths")
        else:
            by_length = np.abs(J[i, : se3.DOF * len(T)].reshape(len(T), 2, 3)[:, 1]).max()
            expect(1e-3 < by_length < 10.0, f"component {i} changes by {by_length:.3g} m a metre")


CHECKS: tuple[Callable[[type[Any]], None], ...] = (
    check_declaration,
    check_zero_at_truth,
    check_jacobian,
    check_gauge,
    check_units,
)
"""Each takes a class; that a tenth of wrong readings does no harm is the joint graph's part."""
