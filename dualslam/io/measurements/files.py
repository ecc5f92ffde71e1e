"""Measurements from files: our CSV, GPX, a drone's SRT, EXIF, KITTI's oxts, EuRoC's imu0, TUM's accelerometer.

Each becomes lines of the CSV's kinds (docs/measurements.md). Formats without sigmas take the one that is given.
"""

from __future__ import annotations

import csv
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, so3
from dualslam.core.metric_problem import MeasurementRow, RowSource
from dualslam.core.types import FloatArray
from dualslam.io.bags import is_bag_file
from dualslam.io.camera_text import parse_yaml
from dualslam.io.euroc import body_from_camera
from dualslam.io.images import list_images
from dualslam.io.measurements.bag_topics import read_bag
from dualslam.io.measurements.geodetic import Geodetic, to_enu
from dualslam.io.trajectory_files import read_number_table, read_text

VERTICAL = 2.0
"""A satellite receiver's height is about twice as uncertain as its place."""
DOWN = (0.0, 0.0, -1.0)
_CUE = re.compile(r"(\d+):(\d+):(\d+)[,.](\d+)\s*-->")
_NUMBER = r"\s*[:=]?\s*([-+]?\d+\.?\d*)"
_LATITUDE, _LONGITUDE = (re.compile(name + _NUMBER, re.I) for name in ("latitude", r"long(?:i)?tude"))
_HEIGHT = re.compile(r"(?:abs_alt|altitude)" + _NUMBER, re.I)
_GPS_TRIPLE = re.compile(r"GPS\s*\(\s*([-+\d.]+)\s*,\s*([-+\d.]+)\s*,\s*([-+\d.]+)")


def read_measurements(
    path: Path,
    sigma: float | None = None,
    clock_offset_s: float = 0.0,
    frame_times_s: FloatArray | None = None,
    origin: Geodetic | None = None,
) -> RowSource:
    """Read a file or folder of measurements.

    - `sigma`: for formats that state none: metres of a position, rad/s of a gyroscope, rad of an accelerometer's
      direction.
    - `clock_offset_s`: added to the times.
    - `frame_times_s` (F,): times of the source's images, for measurements that belong to images and not to times.
    - `origin` (float, float, float): of east, north and up; the first position if it is not given.

    Raises `InputError`: naming the file and the line.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; give a file of measurements.")
    if is_bag_file(path) if path.is_file() else (path / "metadata.yaml").is_file():
        rows, llh = read_bag(path, sigma)
        source = _geodetic(path, llh, origin, rows)
    elif path.is_dir():
        source = _of_folder(path, sigma, frame_times_s, origin)
    elif path.suffix.lower() == ".gpx":
        source = _geodetic(path, _gpx(path, sigma), origin)
    elif path.suffix.lower() == ".srt":
        source = _geodetic(path, _srt(path, sigma), origin)
    else:
        source = _text(path, sigma)
    if not clock_offset_s:
        return source
    rows = [_shifted(row, clock_offset_s) for row in source.rows]
    return RowSource(source.name, rows, source.has_clock, source.origin)


def _shifted(row: MeasurementRow, offset_s: float) -> MeasurementRow:
    n = 0 if row.kind == "mount" else 2 if row.kind in ("relative_pose", "distance", "same_place") else 1
    values = tuple(v + offset_s if i < n else v for i, v in enumerate(row.values))
    return MeasurementRow(row.kind, values, row.where)


def needed(sigma: float | None, path: Path) -> float:
    """Return a sigma that has to be given.

    Raises `InputError` if it was not.
    """
    if sigma is None or not sigma > 0:
        raise InputError(f"{path} states no sigmas; give --sigma (metres of a position; rad/s, rad of an IMU).")
    return sigma


# --- text


def _text(path: Path, sigma: float | None) -> RowSource:
    lines = read_text(path).splitlines()
    head = " ".join(lines[:4]).lower()
    if "w_rs_s" in head:
        return RowSource(str(path), _euroc(path, lines, sigma))
    if "timestamp ax ay az" in head:
        return RowSource(str(path), _tum(path, needed(sigma, path)))
    rows = []
    for number, fields in enumerate(csv.reader(lines), 1):
        fields = [field.strip() for field in fields]
        if not fields or not fields[0] or fields[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        rows.append(MeasurementRow(fields[0], _floats(fields[1:], where), where))
    times_are_frames = any(line.replace(" ", "").lower() == "#clock:camera" for line in lines[:20])
    return RowSource(str(path), rows, not times_are_frames)


def _floats(words: Sequence[str], where: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        raise InputError(f"{where}: {', '.join(words)[:60]!r} are not all numbers.") from None


def _euroc(path: Path, lines: Sequence[str], sigma: float | None) -> list[MeasurementRow]:
    """Return the gyroscope of EuRoC's ``imu0/data.csv``; its noise from ``sensor.yaml`` where that is beside it."""
    sensor_path = path.parent / "sensor.yaml"
    rows = []
    if sensor_path.is_file():
        sensor = parse_yaml(sensor_path, read_text(sensor_path))
        if sigma is None and "gyroscope_noise_density" in sensor:
            sigma = float(sensor["gyroscope_noise_density"]) * math.sqrt(float(sensor.get("rate_hz", 200)))
        camera_path = path.parent.parent / "cam0" / "sensor.yaml"
        if camera_path.is_file():
            T_cam_body = se3.inverse(body_from_camera(parse_yaml(camera_path, read_text(camera_path)), camera_path))
            rows.append(MeasurementRow("mount", _mount(T_cam_body), str(camera_path)))
    sigma = needed(sigma, path)
    for number, line in enumerate(lines, 1):
        words = line.split("#", 1)[0].split(",")
        if len(words) < 4:
            continue
        where = f"{path}, line {number}"
        t_ns, *rates = _floats(words[:4], where)
        rows.append(MeasurementRow("rotation_rate", (t_ns * 1e-9, *rates, sigma), where))
    return rows


def _mount(T: FloatArray) -> tuple[float, ...]:
    return (*T[:3, 3].tolist(), *so3.quat_xyzw_from_matrix(T[:3, :3]).tolist())


def _tum(path: Path, sigma: float) -> list[MeasurementRow]:
    """Return gravity from TUM's ``accelerometer.txt``: what it measures at rest points up."""
    table = -read_number_table(path, 4, "TUM's accelerometer.txt (timestamp ax ay az)")
    return [MeasurementRow("direction", (-t, *down, *DOWN, sigma), str(path)) for t, *down in table.tolist()]


# --- latitude, longitude, height


Fix = tuple[float, float, float, float, float, float]
"""Time, latitude, longitude, height, horizontal and vertical sigma."""


def _geodetic(
    path: Path, fixes: Sequence[Fix], origin: Geodetic | None, others: Sequence[MeasurementRow] = (), clock: bool = True
) -> RowSource:
    if not fixes:
        return RowSource(str(path), list(others), clock)
    table = np.array(fixes)
    if (np.abs(table[:, 1]) > 90).any():
        swapped = "; they seem to be swapped" if (np.abs(table[:, 2]) <= 90).all() else ""
        raise InputError(f"{path}: a latitude is beyond 90 degrees{swapped}; correct the file.")
    at = origin or (float(table[0, 1]), float(table[0, 2]), float(table[0, 3]))
    enu = to_enu(table[:, 1:4], at)
    rows = [
        MeasurementRow("position", (t, *xyz, h, h, v), str(path))
        for t, xyz, h, v in zip(
            table[:, 0].tolist(), enu.tolist(), table[:, 4].tolist(), table[:, 5].tolist(), strict=True
        )
    ]
    return RowSource(str(path), [*others, *rows], clock, at)


def _gpx(path: Path, sigma: float | None) -> list[Fix]:
    try:
        root = ET.fromstring(read_text(path))
    except ET.ParseError as error:
        raise InputError(f"{path} is no GPX: {error}.") from error
    fixes: list[Fix] = []
    for point in root.iter():
        if point.tag.rpartition("}")[2] not in ("trkpt", "rtept", "wpt"):
            continue
        texts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        where = f"{path}, point {len(fixes) + 1}"
        if "time" not in texts:
            raise InputError(f"{where} has no time; record the track with times.")
        lat, lon, h = _floats([point.get("lat", ""), point.get("lon", ""), texts.get("ele", "0")], where)
        s = needed(sigma, path)
        fixes.append((_epoch_s(texts["time"], where), lat, lon, h, s, VERTICAL * s))
    return fixes


def _epoch_s(text: str, where: str) -> float:
    try:
        time = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        raise InputError(f"{where}: {text!r} is no time such as 2024-05-01T12:00:00Z.") from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _srt(path: Path, sigma: float | None) -> list[Fix]:
    """Return the fixes of a drone's subtitles; their times count from the start of the video."""
    fixes: list[Fix] = []
    for block in re.split(r"\n\s*\n", read_text(path).replace("\r", "")):
        cue = _CUE.search(block)
        triple = _GPS_TRIPLE.search(block)
        found = [pattern.search(block) for pattern in (_LATITUDE, _LONGITUDE, _HEIGHT)]
        if cue is None or (triple is None and (found[0] is None or found[1] is None)):
            continue
        h, m, s, ms = cue.groups()
        t = 3600 * int(h) + 60 * int(m) + int(s) + float(f"0.{ms}")
        if triple is not None:  # older ones write longitude first
            longitude, latitude, height = (float(x) for x in triple.groups())
        else:
            latitude, longitude, height = (float(each.group(1)) if each else 0.0 for each in found)
        if latitude or longitude:  # no fix yet
            s_m = needed(sigma, path)
            fixes.append((t, latitude, longitude, height, s_m, VERTICAL * s_m))
    if not fixes:
        raise InputError(f"{path} holds no positions: its subtitles state no latitude and longitude.")
    return fixes


# --- folders


def _of_folder(path: Path, sigma: float | None, times_s: FloatArray | None, origin: Geodetic | None) -> RowSource:
    if (path / "imu0" / "data.csv").is_file() or (path / "mav0" / "imu0" / "data.csv").is_file():
        base = path if (path / "imu0").is_dir() else path / "mav0"
        return _text(base / "imu0" / "data.csv", sigma)
    oxts = path / "oxts" if (path / "oxts" / "data").is_dir() else path
    if (oxts / "data").is_dir() and any((oxts / "data").glob("*.txt")):
        return _oxts(oxts, sigma, times_s, origin)
    fixes: list[Fix] = []
    paths = list_images(path)
    if times_s is None or len(times_s) != len(paths):
        n = "unknown" if times_s is None else len(times_s)
        raise InputError(f"{path} has {len(paths)} images, the source {n}: EXIF positions belong to the source's own.")
    for image, t in zip(paths, times_s.tolist(), strict=True):
        llh = _exif(image)
        if llh is not None:
            s = needed(sigma, path)
            fixes.append((t, *llh, s, VERTICAL * s))
    if not fixes:
        raise InputError(f"{path}: no image has a position in its EXIF data, and it holds no other measurements.")
    return _geodetic(path, fixes, origin, clock=False)


def _exif(path: Path) -> Geodetic | None:
    try:
        with Image.open(path) as image:
            told: Any = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None
    tag = ExifTags.GPS
    try:
        degrees = [
            sum(float(part) / 60**i for i, part in enumerate(told[value])) * (-1 if told.get(ref) in minus else 1)
            for value, ref, minus in (
                (tag.GPSLatitude, tag.GPSLatitudeRef, ("S",)),
                (tag.GPSLongitude, tag.GPSLongitudeRef, ("W",)),
            )
        ]
        height = float(told.get(tag.GPSAltitude, 0.0)) * (-1 if told.get(tag.GPSAltitudeRef) in (1, b"\x01") else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return degrees[0], degrees[1], height


def _oxts(folder: Path, sigma: float | None, times_s: FloatArray | None, origin: Geodetic | None) -> RowSource:
    """Return positions of KITTI's raw data; their sigma is the packet's ``pos_accuracy`` unless one is given."""
    packets = sorted((folder / "data").glob("*.txt"))
    stamps = folder / "timestamps.txt"
    frame_bound = times_s is not None and len(times_s) == len(packets)
    if frame_bound and times_s is not None:
        times = times_s.tolist()
    elif stamps.is_file():
        lines = read_text(stamps).split("\n")
        times = [_epoch_s(line.strip()[:26], str(stamps)) for line in lines if line.strip()]
    else:
        raise InputError(f"{folder} has {len(packets)} packets and no timestamps.txt; fetch it again.")
    if len(times) != len(packets):
        raise InputError(f"{stamps} has {len(times)} times for {len(packets)} packets; fetch it again.")
    fixes: list[Fix] = []
    for packet, t in zip(packets, times, strict=True):
        values = _floats(read_text(packet).split(), str(packet))
        if len(values) < 24:
            raise InputError(f"{packet}: {len(values)} numbers; a packet has 30.")
        s = sigma or max(values[23], 0.01)
        fixes.append((t, values[0], values[1], values[2], s, VERTICAL * s))
    return _geodetic(folder, fixes, origin, clock=not frame_bound)
