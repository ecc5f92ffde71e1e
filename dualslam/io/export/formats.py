"""The formats by name, and the writers of those that are one file or two."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from dualslam.atlas.node_views import MIN_SHARED
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray
from dualslam.io.atomic import write_bytes, write_text
from dualslam.io.export.colmap import DECIMALS, decimals, image_name, mask_path, write_colmap
from dualslam.io.export.exported_map import ExportedMap

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")], align=False
)
LOOKS_BACK = np.diag([1.0, -1.0, -1.0])
POINTS = "points.ply"
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
GSPLAT = (
    "in a checkout of gsplat (github.com/nerfstudio-project/gsplat): "
    "python examples/simple_trainer.py default --data_factor 1 --data_dir {out} --result_dir {out}_splat"
)
NERFSTUDIO = "with nerfstudio installed: ns-train splatfacto --data {out}"


def write_ply(exported: ExportedMap, out: Path) -> None:
    """Write the points with their colours as a binary PLY file."""
    colours = ("red", "green", "blue")
    vertices = np.empty(len(exported.xyz), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = exported.xyz[:, axis]
    for channel, name in enumerate(colours):
        vertices[name] = exported.colour[:, channel]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in "xyz"] + [f"property uchar {name}" for name in colours]
    write_bytes(out, ("\n".join([*head, "end_header"]) + "\n").encode() + vertices.tobytes())


def write_bal(exported: ExportedMap, out: Path) -> None:
    """Write Bundle Adjustment in the Large (grail.cs.washington.edu/projects/bal): the problem for another solver.

    Observations come first, then cameras (rotation vector, translation, f, k1, k2), then points. A camera looks along
    -z, has one focal length, and its image's origin is the principal point, y upwards. Where fx and fy differ, v is
    brought to the scale of u.
    """
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


def write_g2o(exported: ExportedMap, out: Path) -> None:
    """Write the pose graph of the keyframes, which GTSAM, g2o and Ceres read; a vertex has its keyframe's number.

    Edges join keyframes that see `MIN_SHARED` landmarks in common, and each with the next. They say where the map has
    them, with an information that grows with the landmarks in common: the map is the optimum.
    """
    frames = exported.frame.tolist()
    lines = [f"VERTEX_SE3:QUAT {k} {_pose(T)}" for k, T in zip(frames, exported.T_world_cam, strict=True)]
    for a, b, n in edges(exported):
        T_a_b = se3.inverse(exported.T_world_cam[a]) @ exported.T_world_cam[b]
        information = np.diag([float(max(n, 1))] * 6)[np.triu_indices(6)]
        lines.append(f"EDGE_SE3:QUAT {frames[a]} {frames[b]} {_pose(T_a_b)} " + " ".join(f"{x:g}" for x in information))
    write_text(out, "\n".join(lines) + "\n")


def edges(exported: ExportedMap) -> list[tuple[int, int, int]]:
    """Return pairs of views (rows, a < b) with the number of points that both see."""
    n = len(exported.frame)
    sees = csr_array((np.ones(len(exported.view), np.int64), (exported.view, exported.point)), (n, len(exported.xyz)))
    shared = (sees @ sees.T).toarray()
    joined = np.triu(shared >= MIN_SHARED, 1)
    joined[np.arange(n - 1), np.arange(1, n)] = True
    return [(int(a), int(b), int(shared[a, b])) for a, b in zip(*np.nonzero(joined), strict=True)]


def _pose(T: FloatArray) -> str:
    quat = so3.quat_xyzw_from_matrix(T[:3, :3])
    return decimals((*T[:3, 3], *quat))


def write_nerfstudio(exported: ExportedMap, out: Path) -> None:
    """Write ``transforms.json`` and ``points.ply`` into a folder; images and masks are those that are there.

    See docs.nerf.studio, "Data conventions": cameras look along -z, y points up.
    """
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


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A way to write a map."""

    write: Callable[[ExportedMap, Path], None]  # takes the map and the path
    is_folder: bool = False  # whether the path is a folder; else one file
    has_images: bool = False  # whether the views' images belong to it
    has_colours: bool = False  # whether its points have colours
    next_command: str = ""  # where and what to type next, with the path as ``{out}``; empty if there is none


FORMATS = {
    "bal": ExportFormat(write_bal),
    "colmap": ExportFormat(write_colmap, True, True, True, GSPLAT),
    "g2o": ExportFormat(write_g2o),
    "nerfstudio": ExportFormat(write_nerfstudio, True, True, True, NERFSTUDIO),
    "ply": ExportFormat(write_ply, has_colours=True),
}
