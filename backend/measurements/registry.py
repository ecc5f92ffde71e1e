"""Measurements by name: the built-in ones, and those of other packages (entry points)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any

import numpy as np

from dualslam.backend.measurements.base import Measurement, Mount
from dualslam.core.config.problems import nearest_of
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, so3
from dualslam.core.metric_problem import MeasurementRow, MeasurementSource, RowSource

ENTRY_POINT_GROUP = "dualslam.measurements"
"""A package offers one by ``[project.entry-points."dualslam.measurements"] kind = "module:Class"``."""

_OURS = "dualslam.backend.measurements"
BUILT_IN: Mapping[str, str] = {
    "position": f"{_OURS}.kinds:Position",
    "relative_pose": f"{_OURS}.kinds:RelativePose",
    "rotation_rate": f"{_OURS}.kinds:RotationRate",
    "direction": f"{_OURS}.kinds:Direction",
    "height": f"{_OURS}.kinds:Height",
    "distance": f"{_OURS}.kinds:Distance",
    "same_place": f"{_OURS}.kinds:SamePlace",
}
MOUNT = "mount"
"""The kind of a line that says how the sensor of the lines after it is fixed to the camera."""
MOUNT_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def known_kinds() -> list[str]:
    """Kinds that a file may hold, sorted."""
    return sorted({*BUILT_IN, *entry_points(group=ENTRY_POINT_GROUP).names})


def measurement_class(kind: str, where: str = "") -> type[Any]:
    """Return the class of a kind: a built-in one, an entry point's, or ``module:Class``.

    Raises `InputError` if there is none, or it cannot be imported.
    """
    at = f"{where}: " if where else ""
    try:
        module, _, name = BUILT_IN.get(kind, kind).rpartition(":")
        if module:
            found = getattr(importlib.import_module(module), name)
        else:
            found = next((e.load() for e in entry_points(group=ENTRY_POINT_GROUP, name=kind)), None)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        raise InputError(f"{at}the measurement {kind!r} cannot be imported: {error}.") from error
    if found is None:
        known = known_kinds()
        raise InputError(
            f"{at}no measurement is called {kind!r}{nearest_of(kind, known)}; known: {', '.join(known)}, {MOUNT}."
        )
    if not isinstance(found, type) or not hasattr(found, "of_row"):
        raise InputError(f"{at}{kind!r} is no measurement: it has no of_row.")
    return found


def readings_of(source: RowSource) -> MeasurementSource:
    """Make the readings of a file's lines.

    Raises `InputError`, naming the line: of an unknown kind, too few numbers, or a sigma that is not above 0.
    """
    mount = Mount()
    classes: dict[str, type[Any]] = {}
    readings: list[Measurement] = []
    for row in source.rows:
        if row.kind == MOUNT:
            mount = _mount(row)
            continue
        if row.kind not in classes:
            classes[row.kind] = measurement_class(row.kind, row.where)
        cls = classes[row.kind]
        _check(row, cls.columns)
        try:
            reading = cls.of_row(row.values, mount)
        except (ValueError, TypeError, IndexError, ArithmeticError) as error:
            raise InputError(f"{row.where}: no {row.kind}: {error}.") from error
        if not (np.isfinite(reading.sigmas).all() and (reading.sigmas > 0).all()):
            raise InputError(f"{row.where}: the sigmas of a {row.kind} must be above 0.")
        readings.append(reading)
    if not readings:
        raise InputError(f"{source.name} holds no measurements; kinds: {', '.join(known_kinds())}.")
    return MeasurementSource(source.name, readings, source.has_clock, source.origin)


def _check(row: MeasurementRow, columns: Sequence[str]) -> None:
    if len(row.values) != len(columns):
        raise InputError(
            f"{row.where}: {row.kind} takes {len(columns)} numbers ({', '.join(columns)}), not {len(row.values)}."
        )
    for name, value in zip(columns, row.values, strict=True):
        if not math.isfinite(value):
            raise InputError(f"{row.where}: {name} of a {row.kind} is {value}; remove the line.")


def _mount(row: MeasurementRow) -> Mount:
    _check(row, MOUNT_COLUMNS)
    quat = np.asarray(row.values[3:])
    if not abs(float(np.linalg.norm(quat)) - 1.0) < 1e-2:
        raise InputError(f"{row.where}: the quaternion of a mount (x, y, z, w) must have length 1.")
    return Mount(se3.from_parts(so3.matrix_from_quat_xyzw(quat), row.values[:3]), True)
