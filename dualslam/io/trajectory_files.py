"""Trajectories in the two formats that the field's tools read: TUM lines and KITTI rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.errors import InputError, OutputError
from dualslam.core.geometry.se3 import from_parts
from dualslam.core.geometry.so3 import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from dualslam.core.trajectory import Trajectory as Trajectory  # read and written here
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.io.atomic import write_text

MAX_DT_S = 0.02
"""Largest gap in time between a frame and its true pose."""
MAX_BEGIN_GAP_S = 1e6
"""Frames and true poses that begin farther apart, eleven days, are on different clocks."""


# --- TUM


def read_tum(path: str | Path, *, skip_nan: bool = False, allow_empty: bool = False) -> Trajectory:
    """Read ``t tx ty tz qx qy qz qw`` lines (``#`` starts a comment), sorted by time.

    - `skip_nan`: leave out lines that hold a NaN (TUM-Mono marks unknown poses so) instead of refusing the file.
    - `allow_empty`: take a file without lines for a trajectory without poses: a run that could not pose a frame leaves
      one.

    Raises `InputError` if the file is missing, empty or holds a line that is no pose.
    """
    table = read_number_table(path, 8, "a TUM trajectory (t tx ty tz qx qy qz qw)", allow_empty)
    if skip_nan:
        table = table[np.isfinite(table).all(axis=1)]
    _refuse_not_finite(path, table)
    norm = np.linalg.norm(table[:, 4:8], axis=1)
    if (norm < 0.5).any():
        bad = int(np.argmax(norm < 0.5)) + 1
        raise InputError(
            f"{path}: the quaternion of pose {bad} has a norm near zero; columns are t tx ty tz qx qy qz qw."
        )
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Trajectory(table[:, 0].copy(), from_parts(matrix_from_quat_xyzw(table[:, 4:8]), table[:, 1:4]))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file atomically; every number reads back as the very same float, times with 9 decimals or more."""
    _check_finite(path, trajectory.timestamps_s, trajectory.T_world_cam)
    quat_xyzw = quat_xyzw_from_matrix(trajectory.T_world_cam[:, :3, :3])
    lines = [
        " ".join([_exact(t, 9), *(_exact(x) for x in T[:3, 3]), *(_exact(x) for x in q)])
        for t, T, q in zip(trajectory.timestamps_s, trajectory.T_world_cam, quat_xyzw, strict=True)
    ]
    write_text(Path(path), "".join(line + "\n" for line in lines))


# --- KITTI


def read_kitti(path: str | Path) -> FloatArray:
    """Read KITTI poses: one line of 12 numbers (a 3x4 matrix by rows, camera to world) each. Returns (N, 4, 4)."""
    table = read_number_table(path, 12, "a KITTI pose file (12 numbers a line)")
    _refuse_not_finite(path, table)
    rows = table.reshape(-1, 3, 4)
    return from_parts(rows[:, :, :3], rows[:, :, 3])


def write_kitti(path: str | Path, T_world_cam: FloatArray, frames: ArrayLike, frames_path: str | Path) -> None:
    """Write 3x4 rows, and beside them the source index of the frame that each row belongs to, one a line."""
    index: IntArray = np.asarray(frames, np.int64)
    if len(index) != len(T_world_cam):
        raise OutputError(f"{path}: {len(T_world_cam)} poses for {len(index)} frames; each pose needs its frame.")
    _check_finite(path, T_world_cam)
    rows = T_world_cam[:, :3, :].reshape(-1, 12)
    write_text(Path(path), "".join(" ".join(_exact(x) for x in row) + "\n" for row in rows))
    write_text(Path(frames_path), "".join(f"{i}\n" for i in index.tolist()))


# --- association


def nearest_in_time(times_s: FloatArray, query_s: FloatArray) -> IntArray:
    """Return for each query the index of the nearest of the ascending `times_s` (ties: the earlier)."""
    if len(times_s) == 1:
        return np.zeros(len(query_s), np.int64)
    right = np.clip(np.searchsorted(times_s, query_s), 1, len(times_s) - 1)
    return np.where(np.abs(times_s[right - 1] - query_s) <= np.abs(times_s[right] - query_s), right - 1, right)


def associate(reference_s: FloatArray, query_s: FloatArray, max_dt_s: float) -> tuple[IntArray, BoolArray]:
    """Find for each query time the nearest reference time.

    Returns rows of `reference_s` (Q,), and which of them are at most `max_dt_s` apart from the query (Q,).
    """
    if len(reference_s) == 0:
        return np.zeros(len(query_s), np.int64), np.zeros(len(query_s), bool)
    index = nearest_in_time(reference_s, query_s)
    return index, np.abs(reference_s[index] - query_s) <= max_dt_s


# --- numbers and text


def read_number_table(path: str | Path, columns: int, what: str, allow_empty: bool = False) -> FloatArray:
    """Read lines of `columns` numbers, separated by blanks or commas; ``#`` starts a comment.

    Returns (N, columns) float64.

    Raises `InputError`: naming the file and the line that is not `what`.
    """
    rows: list[list[float]] = []
    for number, line in numbered_lines(path):
        words = line.replace(",", " ").split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise InputError(f"{path}, line {number}: {line[:60]!r} is not a line of {what}.") from None
        if len(row) != columns:
            raise InputError(f"{path}, line {number}: {len(row)} numbers where {columns} are due in {what}.")
        rows.append(row)
    if not rows and not allow_empty:
        raise InputError(f"{path} is empty: it should be {what}.")
    return np.array(rows).reshape(-1, columns)


def numbered_lines(path: str | Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that has any; ``#`` starts a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if content := line.split("#", 1)[0].strip():
            yield number, content


def read_text(path: str | Path) -> str:
    """Read a text file, or say in one sentence why not."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file.") from None
    except OSError as e:
        raise InputError(f"{path} cannot be read: {e.strerror or e}.") from e


def _exact(x: float, min_digits: int | None = None) -> str:
    # The shortest decimal that parses back to the same float; plain decimals, as some readers know no exponents.
    return np.format_float_positional(x, unique=True, trim="k" if min_digits else "0", min_digits=min_digits)


def _refuse_not_finite(path: str | Path, table: FloatArray) -> None:
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite)) + 1
        raise InputError(f"{path}: pose {bad} holds a value that is not finite; remove the line.")


def _check_finite(path: str | Path, *arrays: FloatArray) -> None:
    if not all(np.isfinite(a).all() for a in arrays):
        raise OutputError(f"{path}: a pose to be written holds a value that is not finite; nothing was written.")
