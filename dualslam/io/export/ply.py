"""The map's points with their colours as a PLY file, binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualslam.io.atomic import write_bytes
from dualslam.io.export.exported_map import ExportedMap

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")], align=False
)


def write_ply(exported: ExportedMap, out: Path) -> None:
    """Write one file."""
    colours = ("red", "green", "blue")
    vertices = np.empty(len(exported.xyz), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = exported.xyz[:, axis]
    for channel, name in enumerate(colours):
        vertices[name] = exported.colour[:, channel]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in "xyz"] + [f"property uchar {name}" for name in colours]
    write_bytes(out, ("\n".join([*head, "end_header"]) + "\n").encode() + vertices.tobytes())
