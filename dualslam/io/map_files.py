"""Maps on the disk: numpy archives without pickles, and JSON for what is not an array."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import fields
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError, OutputError
from dualslam.core.types import Features, Keyframe
from dualslam.io.atomic import atomic_file, write_text
from dualslam.io.map_checks import check_submap
from dualslam.io.trajectory_files import read_text
from dualslam.map.anchors import Anchor, RelativePose
from dualslam.map.submap import Submap
from dualslam.map.tables import Table

Arrays = Mapping[str, NDArray[Any]]

METADATA = "map.json"
MAP_FORMAT = 2
"""Of what `save_map` writes; 1, without connections that can be bent, is read as well."""
SUBMAP_FORMAT = 3
"""Of a submap's arrays. 2, which marks nothing invalid, is read as well."""
_FEATURE_FIELDS = tuple(f.name for f in fields(Features))


# --- arrays


def save_arrays(path: str | Path, arrays: Arrays) -> None:
    """Write named arrays as one ``.npz``, atomically.

    Raises `OutputError` if an array holds Python objects, which only a pickle could keep.
    """
    path = Path(path)
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise OutputError(f"{path}: the array {name} holds Python objects; maps are written without pickles.")
    with atomic_file(path) as file:
        np.savez(file, allow_pickle=False, **{name: np.asarray(a) for name, a in arrays.items()})


def load_arrays(
    path: str | Path, names: Iterable[str] | None = None, optional: Iterable[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read an ``.npz`` of `save_arrays`, or some of its arrays and those `optional` ones that are there; never by
    unpickling.
    """
    try:
        # Opened here, as numpy leaves the file open where it is no archive.
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            there = [name for name in optional if name in archive.files]
            return {name: archive[name] for name in (archive.files if names is None else [*names, *there])}
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path.") from None
    except (
        OSError, ValueError, zipfile.BadZipFile, zlib.error, EOFError, KeyError, TypeError, AttributeError, RuntimeError
    ) as e:  # fmt: skip
        # Where numpy sees no archive of its own it speaks of pickles, and of how to load one unsafely.
        problem = "it is no archive of arrays" if isinstance(e, ValueError) and "pickle" in str(e) else str(e)
        problem = (getattr(e, "strerror", None) or problem).rstrip(".")
        raise InputError(f"{path} is no map file, or is damaged: {problem}. Give another map, or make it again.") from e


def save_map(folder: str | Path, arrays: Mapping[str, Arrays], metadata: Mapping[str, Any]) -> None:
    """Write groups of arrays as ``<group>.npz`` and the metadata as ``map.json``.

    The metadata comes last and names the groups, so a map whose writing was interrupted is not taken for a whole one.
    Where the folder has a map already the new files stand beside the old ones (``<group>.1.npz``) until the metadata
    names them: interrupted, the old map is there as it was.
    """
    folder = Path(folder)
    names = {}
    for group in arrays:
        free = chain([f"{group}.npz"], (f"{group}.{n}.npz" for n in count(1)))
        names[group] = next(name for name in free if not (folder / name).exists())
    for group, content in arrays.items():
        save_arrays(folder / names[group], content)
    files = {group: name for group, name in names.items() if name != f"{group}.npz"}
    document = {"format": MAP_FORMAT, "groups": sorted(arrays), "metadata": to_plain(metadata)}
    document |= {"files": files} if files else {}
    groups = set(arrays)
    with suppress(InputError):  # no map before, or one that cannot be read
        groups |= read_index(folder)[0].keys()
    write_text(folder / METADATA, json.dumps(document, indent=2, allow_nan=False) + "\n")
    for path in sorted(folder.glob("*.npz")):  # of the map before, and of saves that were interrupted
        group, *number = path.stem.split(".", maxsplit=1)
        if group in groups and path.name != names.get(group) and (not number or number[0].isdecimal()):
            path.unlink()


def load_map(folder: str | Path) -> tuple[dict[str, dict[str, NDArray[Any]]], dict[str, Any]]:
    """Read what `save_map` wrote: groups of arrays, and metadata."""
    files, metadata = read_index(folder)
    return {group: load_arrays(path) for group, path in files.items()}, metadata


def read_index(folder: str | Path) -> tuple[dict[str, Path], dict[str, Any]]:
    """Read where the groups of arrays are that `save_map` wrote, and the metadata, but no arrays."""
    path = Path(folder) / METADATA
    text = read_text(path)
    try:
        document = json.loads(text)
        version = int(document.get("format", 1))
        groups, metadata = list(document["groups"]), dict(document["metadata"])
        named = {str(group): Path(str(name)).name for group, name in document.get("files", {}).items()}
        if not all(isinstance(group, str) for group in groups):
            raise TypeError("a group is named by a word")
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        raise InputError(
            f"{path} is not the metadata of a map, or is damaged. Give another map, or make it again."
        ) from None
    if version > MAP_FORMAT:
        raise InputError(f"{path} is of format {version}, newer than this version of dualslam reads ({MAP_FORMAT}).")
    return {group: path.with_name(named.get(group, f"{group}.npz")) for group in groups}, metadata


def to_plain(value: Any) -> Any:
    """Return `value` as JSON knows it: numpy numbers and arrays become Python's, NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(v) for v in value]
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, bool | int | float):
        return value
    return str(value)


# --- submaps


def submap_to_arrays(submap: Submap) -> dict[str, NDArray[Any]]:
    """Return everything that a submap holds as flat arrays; features of all keyframes stand one after the other."""
    keyframes = list(submap.keyframes.values())
    ids = [kf.id for kf in keyframes]
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(SUBMAP_FORMAT),
        "id": np.array(submap.id),
        "K": submap.K,
        "gauge": np.array(submap.gauge, np.int64),
        "condemned": np.array(sorted(submap.condemned), np.int64),
        "kf_id": np.array(ids, np.int64),
        "kf_timestamp_s": np.array([kf.timestamp_s for kf in keyframes], np.float64),
        "kf_T_submap_kf": submap.keyframe_poses(ids),
        "kf_n_features": np.array([len(kf.features) for kf in keyframes], np.int64),
        "kf_landmark_of": np.concatenate([np.zeros(0, np.int64), *(submap.landmark_of[k] for k in ids)]),
        "anchor_id": np.array(list(submap.anchors), np.int64),
        "anchor_kf": np.array([a.keyframe_id for a in submap.anchors.values()], np.int64),
        "anchor_T_kf_cam": np.array([a.T_kf_cam for a in submap.anchors.values()], np.float64).reshape(-1, 4, 4),
        "relative_id": np.array(list(submap.relative_poses), np.int64),
        "relative_kf": np.array([r.keyframe_id for r in submap.relative_poses.values()], np.int64),
        "relative_T_ref_kf": np.array([r.T_ref_kf for r in submap.relative_poses.values()]).reshape(-1, 4, 4),
        "relative_covariance": np.array([r.covariance for r in submap.relative_poses.values()]).reshape(-1, 6, 6),
    }
    for name in _FEATURE_FIELDS if keyframes else ():
        arrays[f"features_{name}"] = np.concatenate([getattr(kf.features, name) for kf in keyframes])
    arrays |= {f"landmarks_{name}": column for name, column in submap.landmarks.columns().items()}
    arrays |= {f"observations_{name}": column for name, column in submap.observations.columns().items()}
    return arrays


def submap_from_arrays(arrays: Arrays) -> Submap:
    """Make the submap of `submap_to_arrays` again.

    Raises `KeyError`, `ValueError` if an array is missing or of another shape.
    """
    if int(arrays["format"]) != SUBMAP_FORMAT:
        raise ValueError(f"format {int(arrays['format'])} where {SUBMAP_FORMAT} is due")
    check_submap(arrays)
    landmarks, observations = _group(arrays, "landmarks_"), _group(arrays, "observations_")
    descriptors = landmarks["descriptor"]
    submap = Submap(int(arrays["id"]), arrays["K"], np.zeros(descriptors.shape[1:], descriptors.dtype))
    submap.gauge = (int(arrays["gauge"][0]), int(arrays["gauge"][1]))
    submap.condemned = set(arrays["condemned"].tolist())
    ends = np.cumsum(arrays["kf_n_features"]).tolist()
    features = _group(arrays, "features_")
    rows = zip([0, *ends[:-1]], ends, arrays["kf_id"].tolist(), arrays["kf_timestamp_s"].tolist(), strict=False)
    for row, (start, end, keyframe_id, timestamp_s) in enumerate(rows):
        # Copies, so that one keyframe that is kept does not hold the arrays of all.
        own = Features(**{name: features[name][start:end].copy() for name in _FEATURE_FIELDS})
        submap.add_keyframe(Keyframe(keyframe_id, timestamp_s, own), arrays["kf_T_submap_kf"][row])
        submap.landmark_of[keyframe_id] = arrays["kf_landmark_of"][start:end].copy()
    for anchor_id, keyframe_id, T_kf_cam in zip(
        arrays["anchor_id"].tolist(), arrays["anchor_kf"].tolist(), arrays["anchor_T_kf_cam"], strict=True
    ):
        submap.anchors[anchor_id] = Anchor(keyframe_id, T_kf_cam.copy())
    known = (arrays[f"relative_{name}"] for name in ("kf", "T_ref_kf", "covariance"))
    for k, ref, T_ref_kf, covariance in zip(arrays["relative_id"].tolist(), *known, strict=True):
        submap.relative_poses[k] = RelativePose(int(ref), T_ref_kf.copy(), covariance.copy())
    submap.landmarks = Table.from_columns(landmarks)
    submap.observations = Table.from_columns(observations)
    return submap


def save_submap(path: str | Path, submap: Submap) -> None:
    """Write a submap, with the features of its keyframes, as one ``.npz``."""
    save_arrays(path, submap_to_arrays(submap))


def load_submap(path: str | Path) -> Submap:
    """Read a submap that `save_submap` wrote: equal to it in every array."""
    arrays = load_arrays(path)
    try:
        return submap_from_arrays(arrays)
    except (KeyError, ValueError, IndexError) as e:
        raise InputError(f"{path} is no submap of this version, or is damaged: {e}.") from e


def _group(arrays: Arrays, prefix: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
