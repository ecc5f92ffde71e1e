"""The formats by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dualslam.io.export.bal import write_bal
from dualslam.io.export.colmap import write_colmap
from dualslam.io.export.exported_map import ExportedMap
from dualslam.io.export.g2o import write_g2o
from dualslam.io.export.nerfstudio import write_nerfstudio
from dualslam.io.export.ply import write_ply


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A way to write a map."""

    write: Callable[[ExportedMap, Path], None]  # takes the map and the path
    is_folder: bool = False  # whether the path is a folder; else one file
    has_images: bool = False  # whether the views' images belong to it
    has_colours: bool = False  # whether its points have colours
    next_command: str = ""  # where and what to type next, with the path as ``{out}``; empty if there is none


GSPLAT = (
    "in a checkout of gsplat (github.com/nerfstudio-project/gsplat): "
    "python examples/simple_trainer.py default --data_factor 1 --data_dir {out} --result_dir {out}_splat"
)
NERFSTUDIO = "with nerfstudio installed: ns-train splatfacto --data {out}"

FORMATS = {
    "bal": ExportFormat(write_bal),
    "colmap": ExportFormat(write_colmap, True, True, True, GSPLAT),
    "g2o": ExportFormat(write_g2o),
    "nerfstudio": ExportFormat(write_nerfstudio, True, True, True, NERFSTUDIO),
    "ply": ExportFormat(write_ply, has_colours=True),
}
