"""Whether the arrays of a stored submap fit together: what they index is there, and what is computed with is finite."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.map.submap import Submap
from dualslam.map.tables import Table

Arrays = Mapping[str, NDArray[Any]]


def check_submap(arrays: Arrays) -> None:
    """Refuse arrays that no submap would give.

    Raises
    ------
    KeyError
        If one is missing.
    ValueError
        If one is of another shape or type, not finite, or points at what is not there.
    """
    fresh = Submap(0, np.eye(3), np.zeros_like(arrays["landmarks_descriptor"][:0]).reshape(-1)[:0])
    n_landmarks = _check_table(arrays, "landmarks_", fresh.landmarks, but="descriptor")
    _check_table(arrays, "observations_", fresh.observations)
    n_keyframes = len(arrays["kf_id"])
    _check_shape(arrays, ["kf_id", "kf_timestamp_s", "kf_n_features"], (n_keyframes,))
    _check_shape(arrays, ["kf_T_submap_kf"], (n_keyframes, 4, 4))
    _check_shape(arrays, ["K"], (3, 3))
    n_features = np.asarray(arrays["kf_n_features"], np.int64)
    if (n_features < 0).any():
        raise ValueError("kf_n_features is negative")
    features = [name for name in arrays if name.startswith("features_")]
    _check_length(arrays, ["kf_landmark_of", *features], int(n_features.sum()))
    alive = np.asarray(arrays["landmarks_alive"], bool)
    for name, values in (
        *((name, arrays[name]) for name in ("K", "kf_timestamp_s", "kf_T_submap_kf")),
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
            _check_length(arrays, [prefix + name], n)
        elif found.dtype.kind != column.dtype.kind:
            raise ValueError(f"{prefix + name} is of type {found.dtype}")
        else:
            _check_shape(arrays, [prefix + name], (n, *column.shape[1:]))
    return n


def _check_shape(arrays: Arrays, names: Iterable[str], shape: tuple[int, ...]) -> None:
    for name in names:
        if arrays[name].shape != shape:
            raise ValueError(f"{name} is of shape {arrays[name].shape} where {shape} is due")


def _check_length(arrays: Arrays, names: Iterable[str], n: int) -> None:
    for name in names:
        if arrays[name].ndim == 0 or len(arrays[name]) != n:
            raise ValueError(f"{name} has {arrays[name].shape} entries where {n} are due")


def _check_index(name: str, index: NDArray[Any], low: int, end: int) -> None:
    numbers = np.asarray(index, np.int64)
    if len(numbers) and not (low <= numbers.min() and numbers.max() < end):
        raise ValueError(f"{name} points at what is not there")
