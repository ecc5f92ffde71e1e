"""A run's map on the disk: submaps and links as plain arrays, and the way back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError
from dualslam.io.map_files import (
    Arrays,
    load_arrays,
    load_map,
    load_metadata,
    save_map,
    submap_from_arrays,
    submap_to_arrays,
)
from dualslam.io.run_folder import MAP
from dualslam.map.atlas import Atlas, Link, LinkKind
from dualslam.map.submap import Submap
from dualslam.map.trajectory import FramePose

LINKS, FRAMES, SUBMAP = "links", "frames", "submap_"
_DAMAGE = (KeyError, ValueError, IndexError, TypeError)


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """What `save_atlas` wrote: the submaps with their links, and where each frame stands."""

    atlas: Atlas
    poses: dict[int, FramePose]


def submap_path(folder: Path, submap_id: int) -> Path:
    """Where the arrays of a submap are in a ``map`` folder."""
    return folder / f"{SUBMAP}{submap_id:02d}.npz"


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


def save_atlas(folder: str | Path, atlas: Atlas, poses: dict[int, FramePose]) -> None:
    """Write submaps, links and the frames' poses relative to their keyframes: arrays without pickles."""
    groups = _Groups(atlas.submaps)
    links = atlas.links
    groups.small[LINKS] = {
        "ab": np.array([(link.a, link.b) for link in links], np.int64).reshape(-1, 2),
        "S_a_b": np.array([link.S_a_b for link in links], np.float64).reshape(-1, 4, 4),
        "covariance": np.array([link.covariance for link in links], np.float64).reshape(-1, 7, 7),
    }
    ordered = list(poses.values())
    groups.small[FRAMES] = {
        "index": np.array([p.index for p in ordered], np.int64),
        "timestamp_s": np.array([p.timestamp_s for p in ordered], np.float64),
        "submap": np.array([p.submap_id for p in ordered], np.int64),
        "keyframe": np.array([p.keyframe_id for p in ordered], np.int64),
        "T_kf_cam": np.array([p.T_kf_cam for p in ordered], np.float64).reshape(-1, 4, 4),
    }
    metadata = {"link_kinds": [str(link.kind) for link in links], "link_keyframes": [link.keyframes for link in links]}
    save_map(folder, groups, metadata)


def load_atlas(folder: str | Path) -> StoredMap:
    """Read a map that `save_atlas` wrote, from a run folder or its ``map`` folder.

    Raises
    ------
    InputError
        If there is no map, or it is damaged.
    """
    folder = Path(folder)
    if (folder / MAP).is_dir():
        folder = folder / MAP
    groups, metadata = load_map(folder)
    try:
        atlas = Atlas()
        for name in sorted(groups.keys() - {LINKS, FRAMES}):
            atlas.add(submap_from_arrays(groups[name]))
        for link in _links(groups[LINKS], metadata):
            atlas.link(link)
        frames = groups[FRAMES]
        columns = (frames[name].tolist() for name in ("index", "timestamp_s", "submap", "keyframe"))
        rows = zip(*columns, frames["T_kf_cam"], strict=True)
        poses = {index: FramePose(index, t, m, k, T_kf_cam) for index, t, m, k, T_kf_cam in rows}
    except _DAMAGE as error:
        raise InputError(f"{folder} is no map of this version, or is damaged: {error}.") from error
    return StoredMap(atlas, poses)


def load_links(folder: str | Path) -> tuple[list[int], list[Link]]:
    """Read the ids of a map's submaps and the links between them, from its ``map`` folder, and nothing larger.

    Raises
    ------
    InputError
        If there is no map, or it is damaged.
    """
    folder = Path(folder)
    groups, metadata = load_metadata(folder)
    try:
        ids = sorted(int(name.removeprefix(SUBMAP)) for name in groups if name not in (LINKS, FRAMES))
        return ids, _links(load_arrays(folder / f"{LINKS}.npz"), metadata)
    except _DAMAGE as error:
        raise InputError(f"{folder} is no map of this version, or is damaged: {error}.") from error


def _links(arrays: Arrays, metadata: Mapping[str, Any]) -> list[Link]:
    columns = arrays["ab"].tolist(), arrays["S_a_b"], arrays["covariance"]
    rows = zip(*columns, metadata["link_kinds"], metadata["link_keyframes"], strict=True)
    return [Link(a, b, S_a_b, C, LinkKind(kind), tuple(ids)) for (a, b), S_a_b, C, kind, ids in rows]
