"""The formats by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dualslam.export.bal import write_bal
from dualslam.export.colmap import write_colmap
from dualslam.export.exported_map import ExportedMap
from dualslam.export.g2o import write_g2o
from dualslam.export.nerfstudio import write_nerfstudio
from dualslam.export.ply import write_ply


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A way to write a map.

    Attributes
    ----------
    write : callable
        Takes the map and the path.
    is_folder : bool
        Whether the path is a folder; else one file.
    has_images : bool
        Whether the keyframes' images belong to it.
    """

    write: Callable[[ExportedMap, Path], None]
    is_folder: bool = False
    has_images: bool = False


FORMATS = {
    "bal": ExportFormat(write_bal),
    "colmap": ExportFormat(write_colmap, is_folder=True, has_images=True),
    "g2o": ExportFormat(write_g2o),
    "nerfstudio": ExportFormat(write_nerfstudio, is_folder=True, has_images=True),
    "ply": ExportFormat(write_ply),
}
