"""Whether the arrays of a stored map fit together: what they index is there, and what is computed with is finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.map.submap import Submap
from dualslam.map.tables import Table

Arrays = Mapping[str, NDArray[Any]]
Rows = Mapping[str, tuple[str, tuple[int, ...]]]
"""Arrays of one length, by name: the kind of their numbers (as `numpy.dtype.kind`) and the shape of a row."""

LINK_ROWS: Rows = {
    "ab": ("i", (2,)),
    "S_a_b": ("f", (4, 4)),
    "covariance": ("f", (7, 7)),
    "keyframes_ab": ("i", (2,)),
    "doubtful": ("b", ()),
    "rejected": ("b", ()),
    "is_sure": ("b", ()),
}
PLACED_ROWS: Rows = {"placed": ("i", ()), "S_world_submap": ("f", (4, 4))}
WARP_ROWS: Rows = {"warp": ("i", (2,)), "warp_S": ("f", (4, 4))}
HELD_ROWS: Rows = {"held": ("i", (2,))}
FRAME_ROWS: Rows = {
    "index": ("i", ()),
    "timestamp_s": ("f", ()),
    "submap": ("i", ()),
    "keyframe": ("i", ()),
    "T_kf_cam": ("f", (4, 4)),
}
_SUBMAP_ROWS: tuple[Rows, ...] = (
    {"kf_id": ("i", ()), "kf_timestamp_s": ("f", ()), "kf_n_features": ("i", ()), "kf_T_submap_kf": ("f", (4, 4))},
    {"anchor_id": ("i", ()), "anchor_kf": ("i", ()), "anchor_T_kf_cam": ("f", (4, 4))},
    {
        "relative_id": ("i", ()),
        "relative_kf": ("i", ()),
        "relative_T_ref_kf": ("f", (4, 4)),
        "relative_covariance": ("f", (6, 6)),
    },
    {"kf_landmark_of": ("i", ())},
    {"gauge": ("i", ())},
    {"condemned": ("i", ())},
    {"K": ("f", (3,))},
)


def check_rows(arrays: Arrays, *groups: Rows) -> None:
    """Refuse arrays of another kind or shape than they are written in, and numbers that are not finite.

    Arrays that are not there pass: which may be missing is for the reader to know.

    Raises `ValueError`.
    """
    for rows in groups:
        there = {name: row for name, row in rows.items() if name in arrays}
        n = next((len(arrays[name]) if arrays[name].ndim else 0 for name in there), 0)
        for name, (kind, shape) in there.items():
            found = arrays[name]
            if found.dtype.kind != kind:
                raise ValueError(f"{name} is of type {found.dtype}")
            _check_shape(arrays, name, (n, *shape))
            if not np.isfinite(found).all():
                raise ValueError(f"{name} holds a number that is not finite")
            # By its volume: a similarity keeps the sense of turning, and its scale is above 0.
            if shape == (4, 4) and not (np.linalg.det(found[:, :3, :3]) > 0).all():
                raise ValueError(f"{name} holds a matrix that is no transform")


def check_submap(arrays: Arrays) -> None:
    """Refuse arrays that no submap would give.

    Raises `KeyError` if one is missing.
    Raises `ValueError` if one is of another shape or type, not finite, or points at what is not there.
    """
    check_rows(arrays, *_SUBMAP_ROWS)
    fresh = Submap(0, np.eye(3), np.zeros_like(arrays["landmarks_descriptor"][:0]).reshape(-1)[:0])
    n_landmarks = _check_table(arrays, "landmarks_", fresh.landmarks, but="descriptor")
    _check_table(arrays, "observations_", fresh.observations)
    _check_shape(arrays, "K", (3, 3))
    n_features = np.asarray(arrays["kf_n_features"], np.int64)
    if (n_features < 0).any():
        raise ValueError("kf_n_features is negative")
    features = [name for name in arrays if name.startswith("features_")]
    for name in ("kf_landmark_of", *features):
        _check_length(arrays, name, int(n_features.sum()))
    alive = np.asarray(arrays["landmarks_alive"], bool)
    for name, values in (
        *((name, arrays[name]) for name in features if name != "features_descriptors"),
        ("landmarks_xyz_mu", arrays["landmarks_xyz_mu"][alive]),
    ):
        if not np.isfinite(np.asarray(values, np.float64)).all():
            raise ValueError(f"{name} holds a number that is not finite")
    _check_index("kf_landmark_of", arrays["kf_landmark_of"], -1, n_landmarks)
    seen = np.asarray(arrays["observations_alive"], bool)
    _check_index("observations_landmark", arrays["observations_landmark"][seen], 0, n_landmarks)
    if not _are_features(arrays["observations_kf"][seen], arrays["observations_feature"][seen], arrays, n_features):
        raise ValueError("an observation is of no feature of a keyframe")


def _are_features(kf: NDArray[Any], feature: NDArray[Any], arrays: Arrays, n_features: NDArray[np.int64]) -> bool:
    """Whether each pair of a keyframe's id and a feature's number is of a feature that the keyframe has."""
    if not len(kf):
        return True
    if not len(n_features):
        return False
    order = np.argsort(arrays["kf_id"], kind="stable")
    ids = arrays["kf_id"][order]
    at = np.maximum(np.searchsorted(ids, kf, side="right") - 1, 0)
    return bool(np.all((ids[at] == kf) & (feature >= 0) & (feature < n_features[order][at])))


def _check_table(arrays: Arrays, prefix: str, like: Table, but: str = "") -> int:
    """Check the columns of a table, each against a fresh one (`but`: its rows may be anything); return its length."""
    columns = like.columns()
    n = len(arrays[prefix + next(iter(columns))])
    for name, column in columns.items():
        found = arrays[prefix + name]
        if name == but:
            _check_length(arrays, prefix + name, n)
        elif found.dtype.kind != column.dtype.kind:
            raise ValueError(f"{prefix + name} is of type {found.dtype}")
        else:
            _check_shape(arrays, prefix + name, (n, *column.shape[1:]))
    return n


def _check_shape(arrays: Arrays, name: str, shape: tuple[int, ...]) -> None:
    if arrays[name].shape != shape:
        raise ValueError(f"{name} is of shape {arrays[name].shape} where {shape} is due")


def _check_length(arrays: Arrays, name: str, n: int) -> None:
    if arrays[name].ndim == 0 or len(arrays[name]) != n:
        raise ValueError(f"{name} has {arrays[name].shape} entries where {n} are due")


def _check_index(name: str, index: NDArray[Any], low: int, end: int) -> None:
    numbers = np.asarray(index, np.int64)
    if len(numbers) and not (low <= numbers.min() and numbers.max() < end):
        raise ValueError(f"{name} points at what is not there")
