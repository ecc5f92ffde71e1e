"""A first similarity from a map to the frame of measurements, their clocks' offsets and their sensors' mounts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np
from scipy.special import fdtri

from dualslam.backend.measurements.base import Gauge, Mount
from dualslam.backend.measurements.path import CameraPath, Term, attach
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, pose_by_node
from dualslam.core.noise_model import TINY
from dualslam.core.types import Failure, FloatArray

POSITION = "position"
MAX_OFFSET_S, OFFSET_STEP_S = 2.0, 0.25
"""Clocks that were set by hand differ by no more. The joint graph refines what the grid finds."""
QUANTILE_99 = 2.33
"""Of the normal distribution."""
N_ROUNDS = 12
"""Of reweighting; the weights settle to a percent within ten."""
LINE = 0.02
"""Second over first singular value of rotations, below which the turn about their one axis is not seen."""
N_SCREENED = 60
"""Readings by which starting rotations are compared where there are no positions."""


@dataclass(frozen=True, slots=True, eq=False)
class MetricStart:
    """Where the joint graph starts."""

    S_metric_world: FloatArray  # (4, 4)
    sources: Sequence[MeasurementSource]  # without what a frozen receiver repeated, sensors' mounts filled in
    offsets_s: list[float]
    n_repeated: int  # positions that were left out as repeated


def find_start(
    problem: MetricProblem,
    path: CameraPath,
    sources: Sequence[MeasurementSource],
    known_offsets_s: Mapping[str, float],
) -> MetricStart:
    """Find it; `known_offsets_s` by source.

    Raises `InputError`: no overlap in time, a receiver that never moves, mirrored axes of a gyroscope.
    """
    for source in sources:
        _check(source, path)
    n = sum(len(s.readings) for s in sources)
    sources = [_without_repeats(s) for s in sources]
    n_repeated = n - sum(len(s.readings) for s in sources)
    up = up_of(problem)
    offsets = [known_offsets_s[s.name] if s.name in known_offsets_s else _offset(path, s, up) for s in sources]
    sources = [_with_mounts(path, s, offset) for s, offset in zip(sources, offsets, strict=True)]
    aligned = (_align(*_positions(path, s, offset), up) for s, offset in zip(sources, offsets, strict=True))
    S = next((S for S in aligned if S is not None), None)
    S = _by_rigid_fits(problem, path, sources, offsets) if S is None else S
    return MetricStart(S, sources, offsets, n_repeated)


def _without_repeats(source: MeasurementSource) -> MeasurementSource:
    """Return the readings in order of time; positions that repeat the one before to the last digit say nothing new."""
    readings: list[Any] = sorted(source.readings, key=lambda r: r.times_s[0])
    places = [tuple(r.xyz_m) if r.kind == POSITION else None for r in readings]
    kept = [r for r, p, before in zip(readings, places, [None, *places], strict=False) if p is None or p != before]
    return replace(source, readings=kept)


def _check(source: MeasurementSource, path: CameraPath) -> None:
    """Refuse readings that do not overlap with the video, and positions that are all of one place."""
    times = np.array([t for r in source.readings for t in r.times_s])
    reach = MAX_OFFSET_S if source.has_clock else 0.0
    first, last = path.span_s
    if ((times < first - reach) | (times > last + reach)).all():
        together = first - times.min()
        advice = f"give --clock-offset SECONDS, which is added to them ({together:.1f} if both began together)"
        for unit, per_s in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
            if 0.5 < np.ptp(times) / (per_s * max(last - first, TINY)) < 2.0:
                advice = f"they seem to be in {unit}; write seconds"
        raise InputError(
            f"{source.name}: its times, {times.min():.1f} to {times.max():.1f} s, do not overlap those of the video, "
            f"{first:.1f} to {last:.1f} s; {advice}."
        )
    readings = [r for r in source.readings if r.kind == POSITION]
    p, sigma = np.array([r.xyz_m for r in readings]), np.array([r.sigmas for r in readings])
    if len(p) < 3:
        return
    dof = 3 * (len(p) - 1)
    chi2 = float((((p - p.mean(axis=0)) / sigma) ** 2).sum())
    if chi2 <= dof + QUANTILE_99 * np.sqrt(2.0 * dof):
        raise InputError(
            f"{source.name}: its {len(p)} positions lie within their sigmas of each other: the receiver did not move, "
            "or was frozen; they say nothing of the scale."
        )


def _positions(path: CameraPath, source: MeasurementSource, offset_s: float) -> tuple[FloatArray, FloatArray, float]:
    """Return camera centres in the world, the positions measured there (N, 3), and the median of their sigmas."""
    readings = [r for r in source.readings if r.kind == POSITION]
    times = np.array([r.t_s for r in readings]) + offset_s
    known = path.knows(times) if len(times) else np.zeros(0, bool)
    if not known.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), 0.0
    p, sigma = np.array([r.xyz_m for r in readings])[known], np.array([r.sigmas for r in readings])[known]
    return se3.translation(path.at(times[known])[0]), p, float(np.median(sigma))


def _align(c: FloatArray, p: FloatArray, sigma: float, up: FloatArray | None) -> FloatArray | None:
    """Align camera centres with positions of which less than half are wrong; None where they have no extent.

    Each position counts once more, a sigma higher: the camera's up fixes the turn of a straight path about itself.
    """
    if len(c) < 3:
        return None
    found = None
    r = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    for _ in range(N_ROUNDS):
        w = (1.0 + (r / max(float(np.median(r)), TINY)) ** 2) ** -2
        w /= w.sum()
        scale = np.sqrt((w @ (p - w @ p) ** 2).sum() / max(float((w @ (c - w @ c) ** 2).sum()), TINY**2))
        for above in (np.array([0.0, -1.0, 0.0]) if up is None else up, np.array([1.0, 0.0, 0.0])):
            raised = np.concatenate((c, c + above * sigma / scale)), np.concatenate((p, p + [0.0, 0.0, sigma]))
            fit = umeyama(*raised, np.tile(w, 2))
            if not isinstance(fit, Failure):
                found = fit.S_dst_src
                break
        if found is None:
            return None
        r = np.linalg.norm(sim3.act(found, c) - p, axis=1)
    return found


def up_of(problem: MetricProblem) -> FloatArray | None:
    """Return the mean of the image's up in the world, where it is the same all along."""
    up = -problem.T_world_cam[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.5 else None


# --- clocks and mounts


def _offset(path: CameraPath, source: MeasurementSource, up: FloatArray | None) -> float:
    """Return the offset of a source's clock at which its readings agree best with the map, to a quarter of a second.

    It is 0 where no other fits better than by chance (F-test at 99 %): a path of constant speed and turn shows none.
    """
    if not source.has_clock:
        return 0.0
    grid = np.arange(-MAX_OFFSET_S, MAX_OFFSET_S + 1e-9, OFFSET_STEP_S)
    grid = grid[np.argsort(np.abs(grid), kind="stable")]
    # The same readings at each offset: those near the ends of the video, or of a gap in it, would come and go.
    times = np.array([(r.times_s[0], r.times_s[-1]) for r in source.readings]).reshape(-1, 2)
    known = path.knows(times[:, :, None] + grid).all(axis=(1, 2))
    inner = [source.readings[i] for i in np.flatnonzero(known).tolist()]
    common = replace(source, readings=inner)
    costs = [_offset_cost(path, common, float(offset), up) for offset in grid]
    best = int(np.argmin(costs))
    dof = len(inner) - 8 / 3  # a reading counts once; the similarity and the offset take eight of three numbers each
    if dof <= 0:
        return 0.0
    ratio = (costs[0] / max(costs[best], TINY)) ** 2
    return float(grid[best]) if (ratio - 1.0) * dof > fdtri(1.0, dof, 0.99) else 0.0


def _offset_cost(path: CameraPath, source: MeasurementSource, offset_s: float, up: FloatArray | None) -> float:
    c, p, sigma = _positions(path, source, offset_s)
    S = _align(c, p, sigma, up)
    if S is not None:
        return float(np.median(np.linalg.norm(sim3.act(S, c) - p, axis=1)))
    rates = [np.linalg.norm(t, axis=1) for t in _turns(path, source, offset_s)]
    return float(np.median(np.abs(rates[0] - rates[1]))) if len(rates[0]) else 0.0


def _turns(path: CameraPath, source: MeasurementSource, offset_s: float) -> tuple[FloatArray, FloatArray]:
    """Return rotation vectors that sensors measured, and the camera's over the same times (N, 3)."""
    readings = [r for r in source.readings if hasattr(r, "turn_rad") and len(r.times_s) == 2]
    readings = readings[:: max(len(readings) // 2000, 1)]
    t = np.array([r.times_s for r in readings]).reshape(-1, 2) + offset_s
    known = path.knows(t[:, 0]) & path.knows(t[:, 1]) if len(t) else np.zeros(0, bool)
    if not known.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    measured = np.array([r.turn_rad for r in readings])[known]
    a, twist, _ = path.at(t[known, 0])
    b = path.at(t[known, 1])[0]
    at_once = t[known, 1] == t[known, 0]
    turned = so3.log(se3.rotation(a).swapaxes(1, 2) @ se3.rotation(b))
    return measured, np.where(at_once[:, None], twist[:, :3], turned)


def _with_mounts(path: CameraPath, source: MeasurementSource, offset_s: float) -> MeasurementSource:
    """Estimate how sensors that measure turns are turned against the camera, where no mount is given."""
    turnable = {id(r) for r in source.readings if hasattr(r, "turn_rad") and not r.mount.is_given}
    measured, seen = _turns(path, source, offset_s) if turnable else (np.zeros((0, 3)),) * 2
    if len(measured) < 3:
        return source
    bias = np.zeros(3)
    for _ in range(3):
        U, values, Vt = np.linalg.svd(seen.T @ (measured - bias))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        if source.has_clock and (measured != 0).any():
            bias = np.median(measured - seen @ R, axis=0)
    if values[1] < LINE * values[0]:
        return source  # it turned about one axis only
    if np.linalg.det(U @ Vt) < 0 and values[2] > 0.1 * values[1]:
        raise InputError(f"{source.name}: the axes of its rotations are mirrored; they must be right-handed.")
    mount = Mount(se3.from_parts(R, np.zeros(3)), False)
    return replace(source, readings=[replace(r, mount=mount) if id(r) in turnable else r for r in source.readings])


# --- without positions


def _by_rigid_fits(
    problem: MetricProblem, path: CameraPath, sources: Sequence[MeasurementSource], offsets_s: Sequence[float]
) -> FloatArray:
    """Return the similarity that fits all readings best, from many rotations where some of them fix it."""
    terms = [t for t in attach(path, sources, offsets_s)[0] if not t.reading.shared_sigmas]
    poses = [sim3.act_on_pose(problem.S_world_node[list(t.nodes)], t.T_node_cam) for t in terms]
    starts = [so3.IDENTITY]
    if any(Gauge.ROTATION in t.reading.fixes for t in terms):
        signed = [np.diag(s) @ np.eye(3)[list(p)] for p in permutations(range(3)) for s in product((1, -1), repeat=3)]
        starts = [R for R in signed if np.linalg.det(R) > 0]
    apart = [
        (t.reading.distance_m, float(np.linalg.norm(se3.translation(T[1]) - se3.translation(T[0]))))
        for t, T in zip(terms, poses, strict=True)
        if hasattr(t.reading, "distance_m")
    ]
    s = float(np.median([length / seen for length, seen in apart if length > 0 and seen > 0] or [1.0]))
    middle = np.median(se3.translation(problem.T_world_cam), axis=0)
    every = max(len(terms) // N_SCREENED, 1)
    fits = [_rigid_fit(terms[::every], poses[::every], sim3.from_parts(s, R, middle - s * R @ middle)) for R in starts]
    return _rigid_fit(terms, poses, min(fits, key=lambda fit: fit[1])[0])[0]


def _rigid_fit(terms: Sequence[Term], T_world: Sequence[FloatArray], S: FloatArray) -> tuple[FloatArray, float]:
    """Fit one similarity to readings by robust Gauss-Newton; return it and the robust cost."""
    cost = 0.0
    for _ in range(N_ROUNDS):
        H, g, cost = 1e-6 * np.eye(sim3.DOF), np.zeros(sim3.DOF), 0.0
        for term, T_w in zip(terms, T_world, strict=True):
            T = sim3.act_on_pose(S, T_w)
            r, J = term.reading.residual(T, np.zeros(0))
            J = J @ np.vstack([pose_by_node(float(sim3.scale(S)), each) for each in T_w])
            r, J = r / term.reading.sigmas, J / term.reading.sigmas[:, None]
            weight = 1.0 / (1.0 + float(r @ r) / 9.0)
            cost -= float(np.log(weight))
            H += weight * J.T @ J
            g += weight * J.T @ r
        step = -np.linalg.solve(H, g)
        S = S @ sim3.exp(step * min(1.0, 1.0 / max(float(np.abs(step[[0, 1, 2, 6]]).max()), TINY)))
    return S, cost
