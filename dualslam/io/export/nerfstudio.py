"""Nerfstudio's ``transforms.json`` (docs.nerf.studio, "Data conventions"): cameras look along -z, y points up."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dualslam.io.atomic import write_text
from dualslam.io.export.colmap import image_name, mask_path
from dualslam.io.export.decimals import DECIMALS
from dualslam.io.export.exported_map import ExportedMap
from dualslam.io.export.ply import write_ply

POINTS = "points.ply"
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(exported: ExportedMap, out: Path) -> None:
    """Write ``transforms.json`` and ``points.ply`` into a folder; images and masks are those that are there."""
    out.mkdir(parents=True, exist_ok=True)
    width, height = exported.size_px
    frames = []
    for v, frame in enumerate(exported.frame.tolist()):
        K = exported.K[exported.camera[v]]
        mask = mask_path(image_name(frame))
        frames.append(
            {
                "file_path": f"images/{image_name(frame)}",
                "transform_matrix": (np.round(exported.T_world_cam[v] @ TO_OPENGL, DECIMALS) + 0.0).tolist(),
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2] + 0.5,
                "cy": K[1, 2] + 0.5,
            }
            | ({"mask_path": mask.as_posix()} if (out / mask).is_file() else {})
        )
    content = {"camera_model": "OPENCV", "w": width, "h": height, "ply_file_path": POINTS, "frames": frames}
    write_ply(exported, out / POINTS)
    write_text(out / "transforms.json", json.dumps(content, indent=1) + "\n")
