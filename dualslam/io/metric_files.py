"""Metric files of a run folder: trajectory (TUM, GPX, GeoJSON), covariances, the joint graph."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray
from dualslam.io.atomic import atomic_file, write_text
from dualslam.io.measurements.geodetic import Geodetic, from_enu
from dualslam.io.trajectory_files import write_tum

TRAJECTORY_METRIC, COVARIANCES = "trajectory_metric.txt", "covariances.npz"
GPX, GEOJSON = "trajectory_metric.gpx", "trajectory_metric.geojson"
METRIC_FILES = (
    *(TRAJECTORY_METRIC, COVARIANCES, GPX, GEOJSON),
    *("metric_graph.g2o", "metric_graph_gtsam.txt", "metric_values_gtsam.txt"),
)


def write_metric(
    folder: Path, frames: Trajectory, covariance: FloatArray, exports: Mapping[str, str], origin: Geodetic | None
) -> None:
    """Write them; GPX and GeoJSON where positions came as latitude and longitude.

    - `origin` (float, float, float) or None.
    - `frames`: in the frame of the measurements, metres.
    - `covariance` (F, 6, 6): of each: right perturbation, rotation (rad), then translation (metres).
    - `exports`: texts of further files by name.
    """
    write_covariances(folder, frames, covariance)
    frames = frames.in_time_order()
    write_tum(folder / TRAJECTORY_METRIC, frames)
    for name, text in exports.items():
        write_text(folder / name, text)
    if origin is not None:
        llh = from_enu(frames.T_world_cam[:, :3, 3], origin)
        write_text(folder / GPX, _gpx(frames.timestamps_s, llh))
        write_text(folder / GEOJSON, _geojson(frames, llh))


def write_covariances(folder: Path, frames: Trajectory, covariance: FloatArray) -> None:
    """Write covariances (F, 6, 6) of frames, in order of time."""
    order = frames.timestamps_s.argsort(kind="stable")
    frames, covariance = frames.in_time_order(), covariance[order]
    with atomic_file(folder / COVARIANCES) as file:
        np.savez_compressed(file, index=frames.index, timestamp_s=frames.timestamps_s, covariance=covariance)


def _gpx(times_s: FloatArray, llh: FloatArray) -> str:
    points = [
        f'<trkpt lat="{lat:.9f}" lon="{lon:.9f}"><ele>{h:.3f}</ele><time>{_iso(t)}</time></trkpt>'
        for t, (lat, lon, h) in zip(times_s.tolist(), llh.tolist(), strict=True)
    ]
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="dualslam" '
    head += 'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n'
    return head + "\n".join(points) + "\n</trkseg></trk></gpx>\n"


def _iso(t: float) -> str:
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _geojson(frames: Trajectory, llh: FloatArray) -> str:
    coordinates = [[round(lon, 9), round(lat, 9), round(h, 3)] for lat, lon, h in llh.tolist()]
    properties = {"timestamps_s": frames.timestamps_s.tolist(), "frames": frames.index.tolist()}
    geometry = {"type": "LineString", "coordinates": coordinates}
    return json.dumps({"type": "Feature", "properties": properties, "geometry": geometry}) + "\n"
