"""Bundle Adjustment in the Large (grail.cs.washington.edu/projects/bal): the whole problem, for another solver.

A BAL camera looks along -z, has one focal length, and its image's origin is the principal point, y upwards. Where fx
and fy differ, v is brought to the scale of u.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.io.atomic import write_text
from dualslam.io.export.exported_map import ExportedMap

LOOKS_BACK = np.diag([1.0, -1.0, -1.0])


def write_bal(exported: ExportedMap, out: Path) -> None:
    """Write one file: observations, then cameras (rotation vector, translation, f, k1, k2), then points."""
    K = exported.K[exported.camera[exported.view]]
    x = exported.uv_px[:, 0] - K[:, 0, 2]
    y = -(exported.uv_px[:, 1] - K[:, 1, 2]) * K[:, 0, 0] / K[:, 1, 1]
    T_cam_world = se3.inverse(exported.T_world_cam)
    R, t = LOOKS_BACK @ T_cam_world[:, :3, :3], T_cam_world[:, :3, 3] @ LOOKS_BACK
    lines = [f"{len(exported.frame)} {len(exported.xyz)} {len(exported.view)}"]
    rows = zip(exported.view.tolist(), exported.point.tolist(), x.tolist(), y.tolist(), strict=True)
    lines += [f"{v} {p} {a!r} {b!r}" for v, p, a, b in rows]
    f = exported.K[exported.camera, 0, 0]
    cameras = np.column_stack([so3.log(R), t, f, np.zeros((len(f), 2))])
    lines += [repr(number) for number in (*cameras.ravel().tolist(), *exported.xyz.ravel().tolist())]
    write_text(out, "\n".join(lines) + "\n")
