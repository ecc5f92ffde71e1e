"""A first similarity from a map to the frame of measurements, their clocks' offsets, and what is refused outright."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np

from dualslam.backend.measurements.base import Gauge, Mount
from dualslam.backend.measurements.path import CameraPath, Term, attach, gauge_jacobian
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.umeyama import umeyama, umeyama_batch
from dualslam.core.metric_problem import MeasurementSource, MetricProblem
from dualslam.core.types import Failure, FloatArray

POSITION = "position"
MAX_OFFSET_S, OFFSET_STEP_S = 2.0, 0.25
"""Clocks that were set by hand differ by no more. The joint graph refines what the grid finds."""
CLEARLY_BETTER = 0.7
"""Ratio of median residuals at which another offset is taken: at constant speed no offset can be seen, and chance
changes the median of twenty residuals by 15 %."""
N_TRIPLES = 300
"""Alignments of three positions that are tried: with half of them wrong, one is right but for one time in 10^17."""
BEND = 0.03
"""Of the extent: how far a map of drifting scale may lie from its best similarity."""
LINE = 0.02
"""Second over first singular value of a path, below which the turn about it is not seen."""
FAR_BETTER = 0.4
"""Ratio of misfits at which another reading of the axes is the right one: noise alone changes them by a few percent."""
MIN_REPEATS = 3
"""Equal positions in a row: two may be rounding."""
N_SCREENED = 60
"""Readings by which starting rotations are compared where there are no positions."""
UPRIGHT = 0.3
"""Mean cosine between the image's up and the sky: a camera that is carried upright has more, an inverted one less."""


@dataclass(frozen=True, slots=True, eq=False)
class MetricStart:
    """Where the joint graph starts.

    Attributes
    ----------
    S_metric_world : (4, 4)
    sources : sequence of MeasurementSource
        Without what a frozen receiver repeated, sensors' mounts filled in.
    offsets_s : list of float
    frozen : int
        Readings that were left out as repeated.
    """

    S_metric_world: FloatArray
    sources: Sequence[MeasurementSource]
    offsets_s: list[float]
    frozen: int = 0


def find_start(
    problem: MetricProblem,
    path: CameraPath,
    sources: Sequence[MeasurementSource],
    known_offsets_s: Mapping[str, float],
) -> MetricStart:
    """Find it; `known_offsets_s` by source.

    Raises
    ------
    InputError
        In one sentence: no overlap in time, a receiver that never moves, mirrored or swapped axes, heights in feet.
    """
    for source in sources:
        _check_overlap(source, path)
        _check_moving(source)
    up = _up(problem)
    offsets = [known_offsets_s[s.name] if s.name in known_offsets_s else _offset(path, s, up) for s in sources]
    sources = [_with_mounts(path, s, offset) for s, offset in zip(sources, offsets, strict=True)]
    found = None
    for source, offset in zip(sources, offsets, strict=True):
        c, p, sigma, _ = _positions(path, source, offset)
        if len(p) >= 3 and found is None:
            found = _align(c, p, sigma, up)
            _check_axes(source, found, c, p, sigma, up)
    if found is None:
        found = Aligned(_by_rigid_fits(problem, path, sources, offsets), 0.0)
    kept, n = [], 0
    for source, offset in zip(sources, offsets, strict=True):
        frozen = _frozen(path, source, offset, float(sim3.scale(found.S)))
        kept.append(replace(source, readings=[r for r in source.readings if id(r) not in frozen]))
        n += len(frozen)
    return MetricStart(found.S, kept, offsets, n)


def _check_overlap(source: MeasurementSource, path: CameraPath) -> None:
    times = np.array([t for r in source.readings for t in r.times_s])
    reach = MAX_OFFSET_S if source.has_clock else 0.0
    first, last = path.span_s
    if ((times < first - reach) | (times > last + reach)).all():
        raise InputError(
            f"{source.name}: its times, {times.min():.1f} to {times.max():.1f} s, do not overlap those of the video, "
            f"{first:.1f} to {last:.1f} s; give --clock-offset SECONDS, which is added to them."
        )


# --- positions


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A similarity by positions, and the 70th percentile of their distances from it, metres."""

    S: FloatArray
    misfit_m: float


def _positions(
    path: CameraPath, source: MeasurementSource, offset_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, list[Any]]:
    """Return camera centres in the world, measured positions, their sigmas (N, 3), and the readings."""
    readings = [r for r in source.readings if r.kind == POSITION]
    times = np.array([r.t_s for r in readings]) + offset_s
    known = path.knows(times) if len(times) else np.zeros(0, bool)
    readings = [r for r, k in zip(readings, known.tolist(), strict=True) if k]
    if not readings:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), []
    c = path.at(times[known])[0][:, :3, 3]
    return c, np.array([r.xyz_m for r in readings]), np.array([r.sigmas for r in readings]), readings


def _check_moving(source: MeasurementSource) -> None:
    p = np.array([r.xyz_m for r in source.readings if r.kind == POSITION])
    if len(p) >= 3 and np.ptp(p, axis=0).max() < 3 * float(
        np.median([r.sigmas for r in source.readings if r.kind == POSITION])
    ):
        raise InputError(
            f"{source.name}: its {len(p)} positions lie within their sigmas of each other: the receiver did not move, "
            "or was frozen; they say nothing of the scale."
        )


def _tolerance(p: FloatArray, sigma: FloatArray) -> float:
    spread = float(np.linalg.norm(np.percentile(p, 90, axis=0) - np.percentile(p, 10, axis=0)))
    return max(3.0 * float(np.median(sigma)), BEND * spread)


def _align(c: FloatArray, p: FloatArray, sigma: FloatArray, up: FloatArray | None) -> Aligned:
    """Align camera centres with positions, a third of which may be wrong."""
    tolerance = _tolerance(p, sigma)
    values = np.linalg.svd(c - c.mean(axis=0), compute_uv=False)
    if len(c) < 3 or values[1] < LINE * values[0]:
        S = _along_line(c, p, up)
    else:
        rng = np.random.default_rng(0)
        triples = np.array([rng.choice(len(c), 3, replace=False) for _ in range(N_TRIPLES)])
        S_all, valid = umeyama_batch(c[triples], p[triples])
        S_all = S_all[valid]
        if not len(S_all):
            return Aligned(_along_line(c, p, up), tolerance)
        r = np.linalg.norm(sim3.act(S_all, c) - p, axis=2)
        S = S_all[int(np.minimum((r / tolerance) ** 2, 1.0).sum(axis=1).argmin())]
        for _ in range(10):
            r = np.linalg.norm(sim3.act(S, c) - p, axis=1)
            better = umeyama(c, p, 1.0 / (1.0 + (r / tolerance) ** 2) ** 2)
            if isinstance(better, Failure):
                break
            S = better.S_dst_src
    r = np.linalg.norm(sim3.act(S, c) - p, axis=1)
    return Aligned(S, float(np.percentile(r, 70)))


def _along_line(c: FloatArray, p: FloatArray, up: FloatArray | None) -> FloatArray:
    """Align a straight path: its direction, and the camera's up with that of the positions (their z axis)."""

    def frame(d: FloatArray, v: FloatArray) -> FloatArray:
        v = v - d * (d @ v)
        if np.linalg.norm(v) < 0.1:
            v = np.eye(3)[int(np.abs(d).argmin())]
            v = v - d * (d @ v)
        v = v / np.linalg.norm(v)
        return np.stack((d, v, np.cross(d, v)), axis=1)

    middle_c, middle_p = np.median(c, axis=0), np.median(p, axis=0)
    d_c = np.linalg.svd(c - middle_c)[2][0]
    along = (c - middle_c) @ d_c
    pairs = [(i, j) for i in range(len(c)) for j in range(i + max(len(c) // 3, 1), len(c))]
    steps = np.array([(p[j] - p[i]) / (along[j] - along[i]) for i, j in pairs if along[j] != along[i]])
    slope = np.median(steps, axis=0) if len(steps) else (p[-1] - p[0]) / max(float(along[-1] - along[0]), 1e-12)
    s = float(np.linalg.norm(slope))
    v_c = np.array([0.0, -1.0, 0.0]) if up is None else up
    R = frame(slope / s, np.array([0.0, 0.0, 1.0]) if up is not None else v_c) @ frame(d_c, v_c).T
    return sim3.from_parts(s, R, middle_p - s * R @ middle_c)


def _up(problem: MetricProblem) -> FloatArray | None:
    """Return the mean of the image's up in the world, where it is the same all along."""
    up = -problem.T_world_cam[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.5 else None


def _check_axes(
    source: MeasurementSource,
    found: Aligned,
    c: FloatArray,
    p: FloatArray,
    sigma: FloatArray,
    up: FloatArray | None,
) -> None:
    """Refuse positions that fit far better with their axes read otherwise."""
    middle = np.median(p, axis=0)
    sky = None if up is None or source.origin is None else float((sim3.rotation(found.S) @ up)[2])
    for words, A in _other_axes(source).items():
        other = _align(c, (p - middle) @ A.T + middle, (sigma**2 @ (A**2).T) ** 0.5, up)
        fits = other.misfit_m < FAR_BETTER * found.misfit_m and found.misfit_m > 3 * float(np.median(sigma))
        hangs = sky is not None and sky < -UPRIGHT and "swapped" in words
        if fits or (hangs and other.misfit_m < 2 * found.misfit_m):
            why = f"{found.misfit_m:.3g} m off the map as they are, {other.misfit_m:.3g} m otherwise"
            raise InputError(f"{source.name}: {words} ({why}); correct the file.")


def _other_axes(source: MeasurementSource) -> dict[str, FloatArray]:
    found = {"its axes are mirrored": np.diag([1.0, 1.0, -1.0])}
    for words, factor in (("its heights seem to be in feet", 0.3048), ("its x and y seem to be in feet", 1 / 0.3048)):
        found[words] = np.diag([1.0, 1.0, factor])
    if source.origin is not None:
        latitude, longitude = np.radians(source.origin[:2])
        A = np.eye(3)
        A[:2, :2] = [[0.0, np.cos(longitude)], [1.0 / np.cos(latitude), 0.0]]
        found = {"its latitude and longitude seem to be swapped": A} | found
    return found


def _frozen(path: CameraPath, source: MeasurementSource, offset_s: float, scale: float) -> set[int]:
    """Return the ids of positions that repeat the one before while the camera moved on."""
    c, p, sigma, readings = _positions(path, source, offset_s)
    found: set[int] = set()
    first = 0
    for i in range(1, len(p) + 1):
        if i < len(p) and (p[i] == p[first]).all():
            continue
        moved = scale * float(np.linalg.norm(c[first:i] - c[first], axis=1).max()) if i > first else 0.0
        if i - first >= MIN_REPEATS and moved > 3 * float(sigma[first].max()):
            found |= {id(r) for r in readings[first:i]}
        first = i
    return found


# --- clocks and mounts


def _offset(path: CameraPath, source: MeasurementSource, up: FloatArray | None) -> float:
    """Return the offset of a source's clock at which its readings agree best with the map, to a quarter of a second."""
    if not source.has_clock:
        return 0.0
    grid = np.arange(-MAX_OFFSET_S, MAX_OFFSET_S + 1e-9, OFFSET_STEP_S)
    grid = grid[np.argsort(np.abs(grid), kind="stable")]
    # The same readings at each offset: those near the ends of the video would come and go.
    first, last = path.span_s
    inner = [r for r in source.readings if first + MAX_OFFSET_S <= r.times_s[0] <= last - MAX_OFFSET_S]
    common = replace(source, readings=inner)
    costs = [_offset_cost(path, common, float(offset), up) for offset in grid]
    best = int(np.argmin(costs))
    return float(grid[best]) if costs[best] < CLEARLY_BETTER * costs[0] else 0.0


def _offset_cost(path: CameraPath, source: MeasurementSource, offset_s: float, up: FloatArray | None) -> float:
    c, p, sigma, _ = _positions(path, source, offset_s)
    if len(p) >= 6:
        S = _align(c, p, sigma, up).S
        r = np.linalg.norm(sim3.act(S, c) - p, axis=1)
        return float(np.median(r))
    turns = _turns(path, source, offset_s)
    if len(turns[0]) >= 6:
        rates = [np.linalg.norm(t, axis=1) for t in turns]
        return float(np.median(np.abs(rates[0] - rates[1])))
    return 0.0


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
    turned = so3.log(a[:, :3, :3].swapaxes(1, 2) @ b[:, :3, :3])
    return measured, np.where(at_once[:, None], twist[:, :3], turned)


def _with_mounts(path: CameraPath, source: MeasurementSource, offset_s: float) -> MeasurementSource:
    """Estimate how sensors that measure turns are turned against the camera, where no mount is given.

    Raises
    ------
    InputError
        If their axes are mirrored.
    """
    if not any(hasattr(r, "turn_rad") and not r.mount.is_given for r in source.readings):
        return source
    measured, seen = _turns(path, source, offset_s)
    if len(measured) < 3:
        return source
    bias = np.zeros(3)
    for _ in range(3):
        M = seen.T @ (measured - bias)
        U, values, Vt = np.linalg.svd(M)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        if source.has_clock and (measured != 0).any():
            bias = np.median(measured - seen @ R, axis=0)
    if values[1] < LINE * values[0]:
        return source  # it turned about one axis only
    if np.linalg.det(U @ Vt) < 0 and values[2] > 0.1 * values[1]:
        raise InputError(f"{source.name}: the axes of its rotations are mirrored; they must be right-handed.")
    mount = Mount(se3.from_parts(R, np.zeros(3)), False)
    turned = [
        replace(r, mount=mount) if hasattr(r, "turn_rad") and not r.mount.is_given else r for r in source.readings
    ]
    return replace(source, readings=turned)


# --- without positions


def _by_rigid_fits(
    problem: MetricProblem, path: CameraPath, sources: Sequence[MeasurementSource], offsets_s: Sequence[float]
) -> FloatArray:
    """Return the similarity that fits all readings best, from many rotations where some of them fix it."""
    terms = [t for t in attach(path, sources, offsets_s)[0] if not t.reading.shared_sigmas]
    few = terms[:: max(len(terms) // N_SCREENED, 1)]
    fixed = {g for t in terms for g in t.reading.fixes}
    starts = [np.eye(3)]
    if Gauge.ROTATION in fixed:
        signed = [np.diag(s) @ np.eye(3)[list(p)] for p in permutations(range(3)) for s in product((1, -1), repeat=3)]
        starts += [R for R in signed if np.linalg.det(R) > 0]
    middle = np.median(problem.T_world_cam[:, :3, 3], axis=0)
    s = _scale_by_lengths(problem, terms)
    fits = [
        _rigid_fit(problem, few, sim3.from_parts(s, R, middle - s * R @ middle), 8) for R in starts[: 25 if few else 1]
    ]
    best = min(fits, key=lambda fit: fit[1])[0]
    return _rigid_fit(problem, terms, best, 20)[0]


def _scale_by_lengths(problem: MetricProblem, terms: Sequence[Term]) -> float:
    """Return metres per unit by readings that state a length; 1 without any."""
    ratios = []
    for term in terms:
        length = getattr(term.reading, "distance_m", None)
        if hasattr(term.reading, "T_a_b"):
            length = float(np.linalg.norm(term.reading.T_a_b[:3, 3]))
        if length:
            T = _in_world(problem, term)
            apart = float(np.linalg.norm(T[1, :3, 3] - T[0, :3, 3]))
            ratios += [length / apart] if apart > 0 else []
    return float(np.median(ratios)) if ratios else 1.0


def _in_world(problem: MetricProblem, term: Term) -> FloatArray:
    return sim3.act_on_pose(problem.S_world_node[list(term.nodes)], term.T_node_cam)


def _rigid_fit(
    problem: MetricProblem, terms: Sequence[Term], S: FloatArray, n_iterations: int
) -> tuple[FloatArray, float]:
    """Fit one similarity to readings by robust Gauss-Newton; return it and the robust cost."""
    T_world = [_in_world(problem, term) for term in terms]
    cost = 0.0
    for _ in range(n_iterations):
        H, g, cost = 1e-6 * np.eye(7), np.zeros(7), 0.0
        centre = S[:3, 3]
        for term, T_w in zip(terms, T_world, strict=True):
            T = sim3.act_on_pose(S, T_w)
            r, J = term.reading.residual(T, np.zeros(len(term.reading.shared_sigmas)))
            J = J[:, : 6 * len(T)] @ np.vstack([gauge_jacobian(each, centre) for each in T])
            r, J = r / term.reading.sigmas, J / term.reading.sigmas[:, None]
            chi2 = float(r @ r)
            weight = 1.0 / (1.0 + chi2 / 9.0)
            cost += float(np.log1p(chi2 / 9.0))
            H += weight * J.T @ J
            g += weight * J.T @ r
        step = -np.linalg.solve(H, g)
        step *= min(1.0, 1.0 / max(float(np.abs(step[[0, 1, 2, 6]]).max()), 1e-12))
        about = se3.from_parts(np.eye(3), centre)
        S = about @ sim3.exp(step) @ se3.inverse(about) @ S
    return S, cost
