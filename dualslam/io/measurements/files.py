"""Measurements from files: our CSV, GPX, a drone's SRT, EXIF, KITTI's oxts, EuRoC's imu0, TUM's accelerometer, bags.

Each parser gives rows of the CSV's kinds (docs/measurements.md), or of `FIX`: latitude, longitude and height, which
become positions here. Formats without sigmas take the one that is given.
"""

from __future__ import annotations

import csv
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
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
from dualslam.io.measurements.bag_topics import bag_rows
from dualslam.io.measurements.geodetic import FIX, Geodetic, fix_row, required_sigma, to_enu
from dualslam.io.trajectory_files import read_number_table, read_text

DOWN = (0.0, 0.0, -1.0)
N_TIMES = {"mount": 0, "relative_pose": 2, "distance": 2, "same_place": 2}
"""Leading values that are times; one in other kinds."""
_CUE = re.compile(r"(\d+):(\d+):(\d+)[,.](\d+)\s*-->")
_NUMBER = r"\s*[:=]?\s*([-+]?\d+\.?\d*)"
_LLH = [re.compile(name + _NUMBER, re.I) for name in ("latitude", r"long(?:i)?tude", "(?:abs_alt|altitude|barometer)")]
_GPS_TRIPLE = re.compile(r"GPS\s*\(\s*([-+\d.]+)\s*,\s*([-+\d.]+)\s*,\s*([-+\d.]+)")
_ABOVE_START = re.compile(r"\bH\s+([-+]?\d+\.?\d*)\s*m")
"""Of subtitles in which the third number of a triple may be the count of satellites."""

Rows = list[MeasurementRow]


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
    rows, has_clock = _rows(path, sigma, frame_times_s)
    llh = np.array([row.values[1:4] for row in rows if row.kind == FIX]).reshape(-1, 3)
    if (np.abs(llh[:, 0]) > 90).any():
        swapped = "; they seem to be swapped" if (np.abs(llh[:, 1]) <= 90).all() else ""
        raise InputError(f"{path}: a latitude is beyond 90 degrees{swapped}; correct the file.")
    at = (origin or (float(llh[0, 0]), float(llh[0, 1]), float(llh[0, 2]))) if len(llh) else None
    enu = iter(to_enu(llh, at).tolist() if at else ())

    def placed(row: MeasurementRow) -> MeasurementRow:
        if row.kind == FIX:
            t, _, _, _, h, v = row.values
            row = MeasurementRow("position", (t, *next(enu), h, h, v), row.where)
        n = N_TIMES.get(row.kind, 1)
        return replace(row, values=(*(t + clock_offset_s for t in row.values[:n]), *row.values[n:]))

    return RowSource(str(path), [placed(row) for row in rows], has_clock, at)


def _rows(path: Path, sigma: float | None, times_s: FloatArray | None) -> tuple[Rows, bool]:
    """Return the rows of a path, and whether they have a clock of their own."""
    if is_bag_file(path) if path.is_file() else (path / "metadata.yaml").is_file():
        return bag_rows(path, sigma), True
    if path.is_dir():
        for imu in (path / "imu0" / "data.csv", path / "mav0" / "imu0" / "data.csv"):
            if imu.is_file():
                return _euroc(imu, read_text(imu), sigma), True
        oxts = path / "oxts" if (path / "oxts" / "data").is_dir() else path
        packets = sorted((oxts / "data").glob("*.txt"))
        return _oxts(oxts, packets, sigma, times_s) if packets else (_exif(path, sigma, times_s), False)
    text = read_text(path)
    head = " ".join(text.splitlines()[:4]).lower()
    if path.suffix.lower() == ".gpx":
        return _gpx(path, text, sigma), True
    if path.suffix.lower() == ".srt":
        return _srt(path, text, sigma), True
    if "w_rs_s" in head:
        return _euroc(path, text, sigma), True
    if "timestamp ax ay az" in head:
        return _tum(path, required_sigma(sigma, path)), True
    return _csv(path, text)


def _csv(path: Path, text: str) -> tuple[Rows, bool]:
    lines = text.splitlines()
    rows = []
    for number, words in enumerate(csv.reader(lines), 1):
        kind, *numbers = [word.strip() for word in words] or [""]
        if kind and not kind.startswith("#"):
            where = f"{path}, line {number}"
            rows.append(MeasurementRow(kind, _floats(numbers, where), where))
    return rows, not any(line.replace(" ", "").lower() == "#clock:camera" for line in lines[:20])


def _floats(words: Sequence[str], where: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        raise InputError(f"{where}: {', '.join(words)[:60]!r} are not all numbers.") from None


def _epoch_s(text: str, where: str) -> float:
    try:
        time = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        raise InputError(f"{where}: {text!r} is no time such as 2024-05-01T12:00:00Z.") from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _euroc(path: Path, text: str, sigma: float | None) -> Rows:
    """Return the gyroscope of EuRoC's ``imu0/data.csv``; its noise from ``sensor.yaml`` where that is beside it."""
    rows = []
    sensor_path, camera_path = path.parent / "sensor.yaml", path.parent.parent / "cam0" / "sensor.yaml"
    if sensor_path.is_file():
        sensor = parse_yaml(sensor_path, read_text(sensor_path))
        if sigma is None and "gyroscope_noise_density" in sensor:
            sigma = float(sensor["gyroscope_noise_density"]) * math.sqrt(float(sensor.get("rate_hz", 200)))
        if camera_path.is_file():
            T = se3.inverse(body_from_camera(parse_yaml(camera_path, read_text(camera_path)), camera_path))
            mount = (*T[:3, 3].tolist(), *so3.quat_xyzw_from_matrix(T[:3, :3]).tolist())
            rows.append(MeasurementRow("mount", mount, str(camera_path)))
    sigma = required_sigma(sigma, path)
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split(",")
        if len(words) >= 4:
            where = f"{path}, line {number}"
            t_ns, *rates = _floats(words[:4], where)
            rows.append(MeasurementRow("rotation_rate", (t_ns * 1e-9, *rates, sigma), where))
    return rows


def _tum(path: Path, sigma: float) -> Rows:
    """Return gravity from TUM's ``accelerometer.txt``: what it measures at rest points up."""
    table = -read_number_table(path, 4, "TUM's accelerometer.txt (timestamp ax ay az)")
    return [MeasurementRow("direction", (-t, *down, *DOWN, sigma), str(path)) for t, *down in table.tolist()]


def _gpx(path: Path, text: str, sigma: float | None) -> Rows:
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path} is no GPX: {error}.") from error
    rows: Rows = []
    for point in root.iter():
        if point.tag.rpartition("}")[2] not in ("trkpt", "rtept", "wpt"):
            continue
        texts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        where = f"{path}, point {len(rows) + 1}"
        if "time" not in texts:
            raise InputError(f"{where} has no time; record the track with times.")
        llh = _floats([point.get("lat", ""), point.get("lon", ""), texts.get("ele", "0")], where)
        rows.append(fix_row(path, _epoch_s(texts["time"], where), llh, sigma))
    return rows


def _srt(path: Path, text: str, sigma: float | None) -> Rows:
    """Return the fixes of a drone's subtitles; their times count from the start of the video."""
    rows: Rows = []
    for block in re.split(r"\n\s*\n", text.replace("\r", "")):
        cue, triple = _CUE.search(block), _GPS_TRIPLE.search(block)
        found = [pattern.search(block) for pattern in _LLH]
        if cue is None or (triple is None and (found[0] is None or found[1] is None)):
            continue
        llh = [float(each.group(1)) if each else 0.0 for each in found]
        if triple is not None:  # older ones write longitude first
            height = found[2] or _ABOVE_START.search(block)
            llh = [float(triple.group(i)) for i in (2, 1, 3)]
            llh[2] = float(height.group(1)) if height else llh[2]
        if llh[0] or llh[1]:  # otherwise there is no fix yet
            h, m, s, ms = cue.groups()
            rows.append(fix_row(path, 3600 * int(h) + 60 * int(m) + int(s) + float(f"0.{ms}"), llh, sigma))
    if not rows:
        raise InputError(f"{path} holds no positions: its subtitles state no latitude and longitude.")
    return rows


def _exif(path: Path, sigma: float | None, times_s: FloatArray | None) -> Rows:
    """Return the positions in the data of images, at the images' own times."""
    images = list_images(path / "images" if (path / "images").is_dir() else path)
    if times_s is None or len(times_s) != len(images):
        n = "unknown" if times_s is None else len(times_s)
        raise InputError(f"{path} has {len(images)} images, the source {n}: EXIF positions belong to the source's own.")
    found = [(t, _exif_llh(image)) for t, image in zip(times_s.tolist(), images, strict=True)]
    rows = [fix_row(path, t, llh, sigma) for t, llh in found if llh is not None]
    if not rows:
        raise InputError(f"{path}: no image has a position in its EXIF data, and it holds no other measurements.")
    return rows


def _exif_llh(path: Path) -> Geodetic | None:
    try:
        with Image.open(path) as image:
            told: Any = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None
    tag = ExifTags.GPS
    try:
        latitude, longitude = (
            sum(float(x) / 60**i for i, x in enumerate(told[value])) * (-1 if told.get(ref) == minus else 1)
            for value, ref, minus in (
                (tag.GPSLatitude, tag.GPSLatitudeRef, "S"),
                (tag.GPSLongitude, tag.GPSLongitudeRef, "W"),
            )
        )
        height = float(told.get(tag.GPSAltitude, 0.0)) * (-1 if told.get(tag.GPSAltitudeRef) in (1, b"\x01") else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return latitude, longitude, height


def _oxts(folder: Path, packets: list[Path], sigma: float | None, times_s: FloatArray | None) -> tuple[Rows, bool]:
    """Return positions of KITTI's raw data; their sigma is the packet's ``pos_accuracy`` unless one is given."""
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
    rows: Rows = []
    for packet, t in zip(packets, times, strict=True):
        values = _floats(read_text(packet).split(), str(packet))
        if len(values) < 24:
            raise InputError(f"{packet}: {len(values)} numbers; a packet has 30.")
        rows.append(fix_row(packet, t, values[:3], sigma or max(values[23], 0.01)))
    return rows, not frame_bound
