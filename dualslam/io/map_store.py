"""A run's map on the disk: submaps and links as plain arrays, and the way back."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas, Link, LinkKind, joined
from dualslam.atlas.stored_map import StoredMap
from dualslam.atlas.trajectory import FramePose
from dualslam.atlas.warp import Warp
from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import camera_from_dict
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.colours import load_colours
from dualslam.io.map_checks import FRAME_ROWS, HELD_ROWS, LINK_ROWS, PLACED_ROWS, WARP_ROWS, check_rows
from dualslam.io.map_files import (
    METADATA,
    Arrays,
    load_arrays,
    load_map,
    read_index,
    save_map,
    submap_from_arrays,
    submap_to_arrays,
)
from dualslam.io.run_folder import MAP
from dualslam.map.submap import Submap

LINKS, FRAMES, SUBMAP, SOLUTION = "links", "frames", "submap_", "solution"
_OTHER = (LINKS, FRAMES, SOLUTION)
_EARLIER_SURE = 0.025
"""Standard deviation of the scale up to which versions that did not save `is_sure` relied on a link."""


def submap_path(folder: Path, submap_id: int) -> Path:
    """Where the arrays of a submap are in a ``map`` folder, or would be: the metadata may lack it."""
    name = f"{SUBMAP}{submap_id:02d}"
    return read_index(folder)[0].get(name, folder / f"{name}.npz")


class _Groups(Mapping[str, dict[str, NDArray[Any]]]):
    """Groups of arrays of which those of a submap are made when they are asked for: one copy in memory at a time."""

    def __init__(self, submaps: Mapping[int, Submap]) -> None:
        self.small: dict[str, dict[str, NDArray[Any]]] = {}
        self._submaps = {f"{SUBMAP}{m:02d}": submap for m, submap in submaps.items()}

    def __getitem__(self, name: str) -> dict[str, NDArray[Any]]:
        return self.small[name] if name in self.small else submap_to_arrays(self._submaps[name])

    def __iter__(self) -> Iterator[str]:
        return iter([*self._submaps, *self.small])

    def __len__(self) -> int:
        return len(self._submaps) + len(self.small)


def save_atlas(folder: str | Path, atlas: Atlas, poses: dict[int, FramePose], camera: Camera | None = None) -> None:
    """Write submaps, links and the frames' poses relative to their keyframes: arrays without pickles."""
    groups = _Groups(atlas.submaps)
    links = atlas.links
    groups.small[LINKS] = {
        "ab": np.array([(link.a, link.b) for link in links], np.int64).reshape(-1, 2),
        "S_a_b": np.array([link.S_a_b for link in links], np.float64).reshape(-1, 4, 4),
        "covariance": np.array([link.covariance for link in links], np.float64).reshape(-1, 7, 7),
        "keyframes_ab": np.array([(link.keyframe_a, link.keyframe_b) for link in links], np.int64).reshape(-1, 2),
        "doubtful": np.array([link.doubtful for link in links], bool),
        "rejected": np.array([link.rejected for link in links], bool),
        "is_sure": np.array([link.is_sure for link in links], bool),
    }
    groups.small[SOLUTION] = _solution_arrays(atlas)
    ordered = list(poses.values())
    groups.small[FRAMES] = {
        "index": np.array([p.index for p in ordered], np.int64),
        "timestamp_s": np.array([p.timestamp_s for p in ordered], np.float64),
        "submap": np.array([p.submap_id for p in ordered], np.int64),
        "keyframe": np.array([p.keyframe_id for p in ordered], np.int64),
        "T_kf_cam": np.array([p.T_kf_cam for p in ordered], np.float64).reshape(-1, 4, 4),
    }
    metadata: dict[str, Any] = {
        "link_kinds": [str(link.kind) for link in links],
        "link_keyframes": [link.keyframes for link in links],
        "camera": None if camera is None else camera.to_dict(),
    }
    save_map(folder, groups, metadata)


def load_atlas(folder: str | Path) -> StoredMap:
    """Read a map that `save_atlas` wrote, from a run folder or its ``map`` folder.

    Raises `InputError` if there is no map, or it is damaged.
    """
    folder = _map_folder(folder)
    groups, metadata = load_map(folder)
    with _naming_damage(folder):
        atlas = Atlas()
        for name in sorted(groups.keys() - set(_OTHER)):
            atlas.add(submap_from_arrays(groups[name]))
        _join(atlas, atlas.submaps, groups[LINKS], groups[SOLUTION], metadata)
        frames = groups[FRAMES]
        check_rows(frames, FRAME_ROWS)
        columns = (frames[name].tolist() for name in ("index", "timestamp_s", "submap", "keyframe"))
        rows = zip(*columns, frames["T_kf_cam"], strict=True)
        _check_frames(frames, atlas)
        poses = {index: FramePose(index, t, m, k, T_kf_cam) for index, t, m, k, T_kf_cam in rows}
        camera = _camera(metadata)
    return StoredMap(atlas, poses, camera, load_colours(folder))


def load_camera(folder: str | Path) -> Camera | None:
    """Read the camera of a map, from a run folder or its ``map`` folder, and nothing larger; None where it has none.

    Raises `InputError` if there is no map, or it is damaged.
    """
    folder = _map_folder(folder)
    _, metadata = read_index(folder)
    with _naming_damage(folder):
        return _camera(metadata)


def load_placement(folder: Path, submap_ids: Iterable[int | None]) -> tuple[list[int], Mapping[int, FloatArray]]:
    """Read how a map's submaps are joined, from its ``map`` folder, and nothing larger.

    - `submap_ids`: of them the first is asked about; None counts as no submap.

    Returns list of int, mapping of int to (4, 4): what is joined with it, and each one's transform into their world.
    Both are empty where there is no map, or it lacks the submap.

    Raises `InputError` if the map is damaged.
    """
    asked = min((m for m in submap_ids if m is not None), default=None)
    if asked is None or not (folder / METADATA).is_file():
        return [], {}
    files, metadata = read_index(folder)
    with _naming_damage(folder):
        ids = sorted(int(name.removeprefix(SUBMAP)) for name in files if name not in _OTHER)
        atlas = Atlas()
        _join(atlas, ids, load_arrays(files[LINKS]), load_arrays(files[SOLUTION]), metadata)
        component = next((c for c in joined(ids, atlas.believed) if asked in c), [])
        return component, atlas.S_world_submap(component) if component else {}


def _solution_arrays(atlas: Atlas) -> dict[str, NDArray[Any]]:
    """Return what the solutions of an atlas have left: placements, bends, and which keyframes hold them."""
    warps = [(m, i, S) for m, warp in atlas.warps.items() for i, S in zip(warp.index.tolist(), warp.S, strict=True)]
    held = [(m, k) for m, keyframe_ids in atlas.held.items() for k in sorted(keyframe_ids)]
    return {
        "placed": np.array(list(atlas.placement), np.int64),
        "S_world_submap": np.array(list(atlas.placement.values()), np.float64).reshape(-1, 4, 4),
        "warp": np.array([(m, i) for m, i, _ in warps], np.int64).reshape(-1, 2),
        "warp_S": np.array([S for _, _, S in warps], np.float64).reshape(-1, 4, 4),
        "held": np.array(held, np.int64).reshape(-1, 2),
    }


def _join(atlas: Atlas, ids: Collection[int], links: Arrays, solution: Arrays, metadata: Mapping[str, Any]) -> None:
    """Fill in how the submaps of an atlas are joined."""
    check_rows(links, LINK_ROWS)
    for link in _links(links, metadata):
        if not {link.a, link.b} <= set(ids):
            raise ValueError(f"a link joins the submaps {link.a} and {link.b}, of which one is not there")
        atlas.link(link)
    check_rows(solution, PLACED_ROWS, WARP_ROWS, HELD_ROWS)
    atlas.placement = dict(zip(solution["placed"].tolist(), solution["S_world_submap"], strict=True))
    for m in np.unique(solution["warp"][:, 0]).tolist():
        own = solution["warp"][:, 0] == m
        atlas.warps[m] = Warp(solution["warp"][own, 1], solution["warp_S"][own])
    for m in np.unique(solution["held"][:, 0]).tolist():
        atlas.held[m] = frozenset(solution["held"][solution["held"][:, 0] == m, 1].tolist())


def _links(arrays: Arrays, metadata: Mapping[str, Any]) -> list[Link]:
    ab, S_a_b, covariance = arrays["ab"].tolist(), arrays["S_a_b"], arrays["covariance"]
    kinds = [LinkKind(kind) for kind in metadata["link_kinds"]]
    ends, rejected = arrays["keyframes_ab"].tolist(), arrays["rejected"].tolist()
    doubtful = arrays["doubtful"].tolist() if "doubtful" in arrays else [k is not LinkKind.ROLLOVER for k in kinds]
    is_sure = arrays["is_sure"].tolist() if "is_sure" in arrays else [C[6, 6] <= _EARLIER_SURE**2 for C in covariance]
    rows = zip(ab, S_a_b, covariance, kinds, metadata["link_keyframes"], ends, doubtful, rejected, is_sure, strict=True)
    links = []
    for (a, b), S, C, kind, shared, (k_a, k_b), may_doubt, refused, sure in rows:
        links.append(Link(a, b, S, C, kind, tuple(map(int, shared)), k_a, k_b, may_doubt, refused, sure))
    return links


def _check_frames(frames: Arrays, atlas: Atlas) -> None:
    for m, k in set(zip(frames["submap"].tolist(), frames["keyframe"].tolist(), strict=True)):
        try:
            atlas.submaps[m].keyframe_for(k)
        except KeyError:
            raise ValueError(f"a frame hangs on keyframe {k} of submap {m}, which is not there") from None


def _map_folder(folder: str | Path) -> Path:
    """Return the map's own folder, given that or the run's."""
    folder = Path(folder)
    own = folder / MAP if (folder / MAP).is_dir() else folder
    if not (own / METADATA).is_file():
        what = "holds no map" if folder.is_dir() else "does not exist or is no folder"
        raise InputError(f"{folder} {what}: there is no {METADATA}. Give the folder of a run that has ended.")
    return own


@contextmanager
def _naming_damage(folder: Path) -> Iterator[None]:
    """Say of arrays or metadata that do not fit together in which folder they are."""
    try:
        yield
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise InputError(
            f"{folder} is no map of this version, or is damaged: {problem}. Give another map, or make it again."
        ) from error


def _camera(metadata: Mapping[str, Any]) -> Camera | None:
    if metadata.get("camera") is None:
        return None
    try:
        return camera_from_dict(metadata["camera"])
    except (AttributeError, InputError) as error:
        raise ValueError(f"{METADATA}: {error}") from error
