"""Files of measurements: each format gives the rows that it states, and a wrong line is named."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from dualslam.core.errors import InputError
from dualslam.core.trajectory import Trajectory
from dualslam.io.measurements import read_measurements
from dualslam.io.measurements.geodetic import from_enu, to_enu
from dualslam.io.metric_files import GEOJSON, GPX, TRAJECTORY_METRIC, write_metric
from dualslam.io.trajectory_files import read_tum

ORIGIN = (48.1, 11.6, 520.0)


def test_degrees_and_metres_are_inverse_and_right():
    enu = np.random.default_rng(0).normal(size=(20, 3)) * [3000.0, 3000.0, 100.0]
    llh = from_enu(enu, ORIGIN)
    assert np.abs(to_enu(llh, ORIGIN) - enu).max() < 1e-6
    # A minute of latitude is a nautical mile, to the flattening of the earth.
    assert abs(to_enu(np.array([[48.1 + 1 / 60, 11.6, 520.0]]), ORIGIN)[0, 1] - 1852.0) < 5.0


def test_csv_rows_keep_their_place_and_the_offset_moves_times_alone(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# clock: camera\n\nposition, 1.5, 1,2,3, .1,.1,.2\ndistance,1,4,7,0.1\nmount,0,0,0,0,0,0,1\n")
    source = read_measurements(path, clock_offset_s=10.0)
    assert [row.kind for row in source.rows] == ["position", "distance", "mount"]
    assert source.rows[0].values == (11.5, 1, 2, 3, 0.1, 0.1, 0.2)
    assert source.rows[1].values == (11.0, 14.0, 7.0, 0.1)
    assert source.rows[2].values == (0, 0, 0, 0, 0, 0, 1)
    assert source.rows[0].where.endswith("line 3")
    assert source.has_clock is False


def gpx(points: str) -> str:
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'


POINT = '<trkpt lat="{}" lon="{}"><ele>520</ele><time>2026-05-01T12:00:0{}Z</time></trkpt>'


def test_gpx_becomes_metres_from_its_first_point(tmp_path):
    path = tmp_path / "a.gpx"
    path.write_text(gpx(POINT.format(48.1, 11.6, 0) + POINT.format(48.1, 11.601, 1)))
    source = read_measurements(path, sigma=3.0)
    assert source.origin == ORIGIN
    first, second = (row.values for row in source.rows)
    assert first[1:4] == (0.0, 0.0, 0.0)
    assert second[0] - first[0] == 1.0
    assert second[1] == pytest.approx(74.5, abs=0.2)
    assert second[4:] == (3.0, 3.0, 6.0)


def test_subtitles_of_both_kinds(tmp_path):
    block = "{n}\n00:00:0{n},500 --> 00:00:0{n},533\n{text}\n\n"
    new = "[iso : 100] [latitude: 48.1{n}] [longitude: 11.6] [rel_alt: 1.2 abs_alt: 520.0]"
    path = tmp_path / "a.srt"
    path.write_text("".join(block.format(n=n, text=new.format(n=n)) for n in (1, 2)))
    rows = read_measurements(path, sigma=2.0).rows
    assert [row.values[0] for row in rows] == [1.5, 2.5]
    assert rows[1].values[2] == pytest.approx(1112, abs=3)
    for text in ("GPS(11.6,48.1,520)", "GPS (11.6, 48.1, 14), D 2.1m, H 520.0m", "GPS(11.6,48.1,14) BAROMETER:520.0"):
        path.write_text(block.format(n=1, text=text))
        assert read_measurements(path, sigma=2.0).origin == ORIGIN


def test_exif_positions_have_the_images_times(tmp_path):
    (tmp_path / "images").mkdir()
    for i, minutes in enumerate((6.0, 6.1)):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update({1: "S", 2: (48.0, minutes, 0.0), 3: "E", 4: (11.0, 36.0, 0.0), 6: 520.0})
        Image.new("L", (8, 8)).save(tmp_path / "images" / f"{i}.jpg", exif=exif)
    source = read_measurements(tmp_path, 3.0, frame_times_s=np.array([0.0, 0.5]))
    within = read_measurements(tmp_path / "images", 3.0, frame_times_s=np.array([0.0, 0.5]))
    assert [row.values for row in within.rows] == [row.values for row in source.rows]
    assert source.has_clock is False
    assert source.origin == (-48.1, 11.6, 520.0)
    assert source.rows[1].values[0] == 0.5
    assert source.rows[1].values[2] == pytest.approx(-185.3, abs=0.5)
    with pytest.raises(InputError, match="2 images, the source 3"):
        read_measurements(tmp_path, 3.0, frame_times_s=np.zeros(3))


def test_oxts_euroc_and_tum(tmp_path):
    data = tmp_path / "oxts" / "data"
    data.mkdir(parents=True)
    for i in range(2):
        numbers = [48.1 + 1e-5 * i, 11.6, 520.0, *[0.0] * 20, 0.05, *[0.0] * 6]
        (data / f"{i:010d}.txt").write_text(" ".join(map(str, numbers)))
    (tmp_path / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389445\n")
    rows = read_measurements(tmp_path).rows
    assert rows[1].values[0] - rows[0].values[0] == pytest.approx(0.1)
    assert rows[1].values[2] == pytest.approx(1.112, abs=0.01)
    assert rows[1].values[4:] == (0.05, 0.05, 0.1)
    imu = tmp_path / "mav0" / "imu0"
    imu.mkdir(parents=True)
    (imu / "data.csv").write_text("#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a\n1000000000,.1,.2,.3,9.8\n")
    (imu / "sensor.yaml").write_text("rate_hz: 200\ngyroscope_noise_density: 1.0e-4\n")
    (row,) = read_measurements(imu / "data.csv").rows
    assert row.values == pytest.approx((1.0, 0.1, 0.2, 0.3, 1e-4 * 200**0.5))
    tum = tmp_path / "accelerometer.txt"
    tum.write_text("# accelerometer data\n# timestamp ax ay az\n5.0 0.1 -9.8 0.2\n")
    (row,) = read_measurements(tum, sigma=0.1).rows
    assert row.kind == "direction"
    assert row.values == (5.0, -0.1, 9.8, -0.2, 0, 0, -1, 0.1)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "position,1,x,3\n", "line 1.*not all numbers"),
        ("a.gpx", "<gpx", "no GPX"),
        ("a.gpx", gpx('<trkpt lat="1" lon="2"/>'), "point 1 has no time"),
        ("a.gpx", gpx(POINT.format(148.1, 11.6, 0)), "seem to be swapped"),
        ("a.srt", "hello", "no positions"),
    ],
)
def test_a_bad_file_is_refused_in_a_sentence(tmp_path, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_measurements(path, sigma=1.0)


def test_sigmas_are_required(tmp_path):
    path = tmp_path / "a.gpx"
    path.write_text(gpx(POINT.format(48.1, 11.6, 0)))
    with pytest.raises(InputError, match="give --sigma"):
        read_measurements(path)


def test_metric_files_are_read_back(tmp_path):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 10.0, 20.0]
    frames = Trajectory(np.array([2.0, 1.0, 3.0]), T, np.array([1, 0, 2]))
    write_metric(tmp_path, frames, np.arange(3.0)[:, None, None] * np.eye(6), {"g.txt": "x"}, ORIGIN)
    assert read_tum(tmp_path / TRAJECTORY_METRIC).timestamps_s.tolist() == [1.0, 2.0, 3.0]
    kept = np.load(tmp_path / "covariances.npz")
    assert kept["covariance"][:, 0, 0].tolist() == [1.0, 0.0, 2.0]
    assert kept["index"].tolist() == [0, 1, 2]
    again = read_measurements(tmp_path / GPX, sigma=1.0, origin=ORIGIN)
    assert [row.values[1] for row in again.rows] == pytest.approx([10.0, 0.0, 20.0], abs=1e-3)
    line = json.loads((tmp_path / GEOJSON).read_text())["geometry"]["coordinates"]
    assert line[1] == [11.6, 48.1, 520.0]
    assert (tmp_path / "g.txt").read_text() == "x"
