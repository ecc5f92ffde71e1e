# ruff: noqa: E501
"""Camera files as the field's tools write them: read as what they mean, or refused by the key that is not read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from dualslam.core.camera.corrected import LensCorrection, correct
from dualslam.core.camera.models import DivisionCamera, FovCamera, KannalaBrandtCamera, PinholeCamera, RadTanCamera
from dualslam.core.camera.sphere import DoubleSphereCamera, EucmCamera, OmniCamera
from dualslam.core.errors import InputError
from dualslam.io import read_camera_file
from dualslam.io.run_folder import RunFolder

PINHOLE = PinholeCamera(752, 480, 458.0, 457.0, 367.0, 248.0)
RADTAN = RadTanCamera(752, 480, 458.0, 457.0, 367.0, 248.0, k1=-0.28, k2=0.07, p1=0.0002, p2=0.00002)
FIVE = replace(RADTAN, k3=0.01)
FISHEYE = KannalaBrandtCamera(752, 480, 380.0, 381.0, 367.0, 248.0, k1=0.003, k2=0.0007, k3=-0.002, k4=0.0002)
HALF = {"cx": 366.5, "cy": 247.5}
"""The principal point (367, 248) of tools that count from the corner of the first pixel."""

OPENCV_HEAD = """%YAML:1.0
---
calibration_time: "Thu 01 Jan 2026 12:00:00 PM UTC"
nr_of_frames: 20
image_width: 752
image_height: 480
board_width: 9
board_height: 6
square_size: 0.025
fix_aspect_ratio: 1.
flags: 10
"""
OPENCV_MATRIX = """camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {fx}, 0., 367., 0., {fy}, 248., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: {n}
   cols: 1
   dt: d
   data: [ {lens} ]
avg_reprojection_error: 0.18
per_view_reprojection_errors: !!opencv-matrix
   rows: 2
   cols: 1
   dt: f
   data: [ 0.17, 0.19 ]
extrinsic_parameters: !!opencv-matrix
   rows: 1
   cols: 6
   dt: d
   data: [ 0.1, 0.2, 0.3, 1., 2., 3. ]
"""
ROS1_ECHO = """header:
  seq: 7
  stamp:
    secs: 1403715273
    nsecs: 262142976
  frame_id: "cam0"
height: 480
width: 752
distortion_model: "plumb_bob"
D: [-0.28, 0.07, 0.0002, 2.0e-05, 0.0]
K: [458.0, 0.0, 367.0, 0.0, 457.0, 248.0, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [435.2, 0.0, 367.4, 0.0, 0.0, 435.2, 252.2, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: False
---
"""
ROS2_ECHO = ROS1_ECHO.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:").replace("P:", "p:")
ROS_CALIBRATOR = """image_width: 752
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [458.0, 0.0, 367.0, 0.0, 457.0, 248.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.07, 0.0002, 2.0e-05, 0.01]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.99, 0.01, 0.0, -0.01, 0.99, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [435.2, 0.0, 367.4, 0.0, 0.0, 435.2, 252.2, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
ROS_OST = """# oST version 5.0 parameters


[image]

width
752

height
480

[narrow_stereo]

camera matrix
458.000000 0.000000 367.000000
0.000000 457.000000 248.000000
0.000000 0.000000 1.000000

distortion
-0.280000 0.070000 0.000200 0.000020 0.010000

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
435.2 0.000000 367.4 0.000000
0.000000 435.2 252.2 0.000000
0.000000 0.000000 1.000000 0.000000
"""
KALIBR = """cam0:
  T_cam_imu:
  - [0.01, -0.99, 0.01, -0.02]
  - [0.99, 0.01, -0.02, -0.06]
  - [0.02, 0.02, 0.99, 0.01]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: {camera}
  distortion_coeffs: [{lens}]
  distortion_model: {model}
  intrinsics: [{intrinsics}]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0
"""
KALIBR_2 = KALIBR + KALIBR.replace("cam0", "cam1").replace("{intrinsics}", "461.0, 460.0, 376.0, 255.0")
PIXELS = "458.0, 457.0, 367.0, 248.0"
ORB_SLAM = """%YAML:1.0

# ORB-SLAM2 and 3
Camera.type: "{type}"
Camera.fx: {fx}
Camera.fy: {fy}
Camera.cx: 367.0
Camera.cy: 248.0
{lens}
Camera.width: 752
Camera.height: 480
Camera.fps: 20.0
Camera.bf: 47.9
Camera.RGB: 1
ThDepth: 35
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
Viewer.KeyFrameSize: 0.05
Viewer.CameraSize: 0.08
Viewer.ViewpointF: 500
"""
ORB_RADTAN = "Camera.k1: -0.28\nCamera.k2: 0.07\nCamera.p1: 0.0002\nCamera.p2: 0.00002"
ORB_KB = "Camera.k1: 0.003\nCamera.k2: 0.0007\nCamera.k3: -0.002\nCamera.k4: 0.0002"
ORB_SLAM3 = """%YAML:1.0

File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 380.0
Camera1.fy: 381.0
Camera1.cx: 367.0
Camera1.cy: 248.0
Camera1.k1: 0.003
Camera1.k2: 0.0007
Camera1.k3: -0.002
Camera1.k4: 0.0002
Camera2.fx: 379.0
Camera2.fy: 379.0
Camera2.cx: 360.0
Camera2.cy: 240.0
Camera2.k1: 0.001
Camera2.k2: 0.
Camera2.k3: 0.
Camera2.k4: 0.
Camera1.overlappingBegin: 0
Camera1.overlappingEnd: 511
Camera.width: 752
Camera.height: 480
Camera.newWidth: 600
Camera.newHeight: 350
Camera.fps: 20
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
IMU.NoiseGyro: 0.00016
"""
ORB_STEREO = (
    ORB_SLAM.format(type="PinHole", fx=435.2, fy=435.2, lens="Camera.k1: 0.0\nCamera.k2: 0.0")
    + """
LEFT.height: 480
LEFT.width: 752
LEFT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.28, 0.07, 0.0002, 0.00002, 0.0]
LEFT.K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [458.0, 0.0, 367.0, 0.0, 457.0, 248.0, 0.0, 0.0, 1.0]
LEFT.R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [0.99, -0.001, 0.008, 0.001, 0.99, 0.007, -0.008, -0.007, 0.99]
LEFT.P: !!opencv-matrix
   rows: 3
   cols: 4
   dt: d
   data: [435.2, 0, 367.4, 0, 0, 435.2, 252.2, 0, 0, 0, 1, 0]
RIGHT.height: 480
RIGHT.width: 752
RIGHT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.28, 0.07, -0.0001, -3.5e-05, 0.0]
RIGHT.K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [457.5, 0.0, 379.9, 0.0, 456.1, 255.2, 0.0, 0.0, 1]
"""
)
OPENVSLAM = """Camera.name: "a fisheye"
Camera.setup: "monocular"
Camera.model: "{model}"
Camera.fx: 380.0
Camera.fy: 381.0
Camera.cx: 367.0
Camera.cy: 248.0
{lens}
Camera.fps: 20.0
Camera.cols: 752
Camera.rows: 480
Camera.color_order: "Gray"
Feature.max_num_keypoints: 1000
"""
STELLA = """Camera:
  name: "a camera"
  setup: "monocular"
  model: "radial_division"
  fx: 458.0
  fy: 457.0
  cx: 367.0
  cy: 248.0
  distortion: -0.2
  fps: 20.0
  cols: 752
  rows: 480
  color_order: "RGB"
Preprocessing:
  min_size: 800
"""
VINS_MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters:
   xi: 1.9
distortion_parameters:
   k1: -0.1
   k2: 0.2
   p1: 0.0003
   p2: 0.0006
projection_parameters:
   gamma1: 1200.0
   gamma2: 1201.0
   u0: 367.0
   v0: 248.0
"""
VINS_PINHOLE = """%YAML:1.0
---
imu_topic: "/imu0"
image_topic: "/cam0/image_raw"
model_type: PINHOLE
camera_name: camera
image_width: 752
image_height: 480
distortion_parameters:
   k1: -0.28
   k2: 0.07
   p1: 0.0002
   p2: 0.00002
projection_parameters:
   fx: 458.0
   fy: 457.0
   cx: 367.0
   cy: 248.0
max_cnt: 150
min_dist: 30
F_threshold: 1.0
fisheye: 0
"""
VINS_KB = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
   k2: 0.003
   k3: 0.0007
   k4: -0.002
   k5: 0.0002
   mu: 380.0
   mv: 381.0
   u0: 367.0
   v0: 248.0
"""
EUROC_SENSOR = """%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.01, -0.99, 0.0, -0.02, 0.99, 0.01, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.0, 457.0, 367.0, 248.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 2.0e-05]
"""
SVO = """cameras:
- camera:
    distortion:
      parameters:
        cols: 1
        rows: 4
        data: [-0.28, 0.07, 0.0002, 2.0e-05]
      type: radial-tangential
    image_height: 480
    image_width: 752
    intrinsics:
      cols: 1
      rows: 4
      data: [458.0, 457.0, 367.0, 248.0]
    label: cam0
    line-delay-nanoseconds: 0
    type: pinhole
label: /
"""
OKVIS = """cameras:
     - {T_SC: [0.01, -0.99, 0.0, -0.02, 0.99, 0.01, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0],
        image_dimension: [752, 480],
        distortion_coefficients: [-0.28, 0.07, 0.0002, 2.0e-05],
        distortion_type: radialtangential,
        focal_length: [458.0, 457.0],
        principal_point: [367.0, 248.0]}
camera_params: {camera_rate: 20, sigma_absolute_translation: 0.0}
"""
BASALT = {
    "value0": {
        "T_imu_cam": [{"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}],
        "intrinsics": [
            {
                "camera_type": "ds",
                "intrinsics": {"fx": 350.0, "fy": 351.0, "cx": 367.0, "cy": 248.0, "xi": -0.2, "alpha": 0.57},
            },
            {
                "camera_type": "ds",
                "intrinsics": {"fx": 360.0, "fy": 361.0, "cx": 377.0, "cy": 249.0, "xi": -0.1, "alpha": 0.5},
            },
        ],
        "resolution": [[752, 480], [752, 480]],
        "calib_accel_bias": [0.1, 0.0],
        "imu_update_rate": 200.0,
        "vignette": [],
    }
}
NERFSTUDIO = {
    "camera_model": "OPENCV",
    "w": 752,
    "h": 480,
    "fl_x": 458.0,
    "fl_y": 457.0,
    "cx": 367.0,
    "cy": 248.0,
    "k1": -0.28,
    "k2": 0.07,
    "p1": 0.0002,
    "p2": 0.00002,
    "aabb_scale": 16,
    "applied_transform": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
    "frames": [{"file_path": "images/1.png", "transform_matrix": np.eye(4).tolist()}],
}
POLYCAM = {
    "fx": 458.0,
    "fy": 457.0,
    "cx": 367.0,
    "cy": 248.0,
    "width": 752,
    "height": 480,
    "t_00": 0.1,
    "blur_score": 3.0,
}
ARKIT = {
    "w": 752,
    "h": 480,
    "K": [458.0, 0, 0, 0, 457.0, 0, 367.0, 248.0, 1],
    "fps": 60,
    "poses": [],
    "perFrameIntrinsicCoeffs": [[458.0, 457.0, 367.0, 248.0]],
}
OPENSFM = {
    "v2 unknown unknown 752 480 brown 0.6": {
        "projection_type": "brown",
        "width": 752,
        "height": 480,
        "focal_x": 458.0 / 752,
        "focal_y": 457.0 / 752,
        "c_x": (367.0 - 375.5) / 752,
        "c_y": (248.0 - 239.5) / 752,
        "k1": -0.28,
        "k2": 0.07,
        "k3": 0.0,
        "p1": 0.0002,
        "p2": 0.00002,
    }
}
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>752</width>
  <height>480</height>
  <f>457.0</f>
  <cx>-8.5</cx>
  <cy>8.5</cy>
  <b1>1.0</b1>
  <k1>-0.28</k1>
  <k2>0.07</k2>
  <p1>0.00002</p1>
  <p2>0.0002</p2>
  <date>2026-01-01T00:00:00Z</date>
</calibration>
"""
OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Thu 01 Jan 2026"</calibration_time>
<image_Width>752</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    458. 0. 367. 0. 457. 248. 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix">
  <rows>5</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    -0.28 0.07 2e-04 2e-05 0.01</data></Distortion_Coefficients>
</opencv_storage>
"""
REPLICA = {
    "camera": {
        "w": 752,
        "h": 480,
        "fx": 458.0,
        "fy": 457.0,
        "cx": 367.0,
        "cy": 248.0,
        "scale": 6553.5,
        "model": "pinhole",
    }
}


def opencv(lens: str, n: int, fisheye: str = "") -> str:
    f = {"fx": "380.", "fy": "381."} if fisheye.startswith("fisheye_model: 1") else {"fx": "458.", "fy": "457."}
    return OPENCV_HEAD + fisheye + OPENCV_MATRIX.format(**f, n=n, lens=lens)


THEIA = {
    "final_reproj_error": 0.17, "fps": 59.94, "image_height": 480, "image_width": 752, "intrinsic_type": "FISHEYE",
    "intrinsics": {
        "aspect_ratio": 381.0 / 380.0, "focal_length": 380.0, "principal_pt_x": 367.0, "principal_pt_y": 248.0,
        "radial_distortion_1": 0.003, "radial_distortion_2": 0.0007, "radial_distortion_3": -0.002, "radial_distortion_4": 0.0002, "skew": 0.0,
    },
    "nr_calib_images": 65, "stabelized": False,
}  # fmt: skip
GYROFLOW = {
    "name": "GoPro HERO9", "camera_brand": "GoPro", "camera_model": "HERO9", "lens_model": "Wide", "camera_setting": "4:3",
    "calib_dimension": {"w": 752, "h": 480}, "orig_dimension": {"w": 1504, "h": 960}, "input_horizontal_stretch": 1.0, "num_images": 15,
    "fisheye_params": {
        "RMS_error": 0.9, "camera_matrix": [[380.0, 0.0, 367.0], [0.0, 381.0, 248.0], [0.0, 0.0, 1.0]],
        "distortion_coeffs": [0.003, 0.0007, -0.002, 0.0002], "radial_distortion_limit": None,
    },
}  # fmt: skip
REALSENSE = {"fx": 458.0, "fy": 457.0, "ppx": 367.0, "ppy": 248.0, "width": 752, "height": 480, "model": "distortion.brown_conrady",
             "coeffs": [-0.28, 0.07, 0.0002, 0.00002, 0.0]}  # fmt: skip
FORMATS = [
    ("opencv.yml", opencv("-0.28, 0.07, 0.0002, 0.00002, 0.01", 5, "fisheye_model: 0\n"), FIVE),
    ("opencv_fisheye.yml", opencv("0.003, 0.0007, -0.002, 0.0002", 4, "fisheye_model: 1\n"), FISHEYE),
    ("opencv.xml", OPENCV_XML, FIVE),
    ("ros1.yaml", ROS1_ECHO * 2, RADTAN),
    ("ros2.yaml", ROS2_ECHO, RADTAN),
    ("ros2_whole_region.yaml", ROS2_ECHO.replace("  height: 0\n  width: 0", "  height: 480\n  width: 752"), RADTAN),
    ("ros2_binned_by_one.yaml", ROS2_ECHO.replace("binning_x: 0", "binning_x: 1"), RADTAN),
    ("ost.yaml", ROS_CALIBRATOR, FIVE),
    ("ost.txt", ROS_OST, FIVE),
    ("kalibr.yaml", KALIBR_2.format(camera="pinhole", model="radtan", lens="-0.28, 0.07, 0.0002, 2e-05", intrinsics=PIXELS), RADTAN),
    ("kalibr_equi.yaml", KALIBR.format(camera="pinhole", model="equidistant", lens="0.003, 0.0007, -0.002, 0.0002",
                                       intrinsics="380.0, 381.0, 367.0, 248.0"), FISHEYE),
    ("kalibr_none.yaml", KALIBR.format(camera="pinhole", model="none", lens="", intrinsics=PIXELS), PINHOLE),
    ("kalibr_fov.yaml", KALIBR.format(camera="pinhole", model="fov", lens="0.9", intrinsics=PIXELS),
     FovCamera(752, 480, 458.0, 457.0, 367.0, 248.0, omega=0.9)),
    ("kalibr_omni.yaml", KALIBR.format(camera="omni", model="radtan", lens="-0.1, 0.2, 0.0003, 0.0006",
                                       intrinsics="1.9, 1200.0, 1201.0, 367.0, 248.0"),
     OmniCamera(752, 480, 1200.0, 1201.0, 367.0, 248.0, xi=1.9, k1=-0.1, k2=0.2, p1=0.0003, p2=0.0006)),
    ("kalibr_ds.yaml", KALIBR.format(camera="ds", model="none", lens="", intrinsics="-0.2, 0.57, 350.0, 351.0, 367.0, 248.0"),
     DoubleSphereCamera(752, 480, 350.0, 351.0, 367.0, 248.0, xi=-0.2, alpha=0.57)),
    ("kalibr_eucm.yaml", KALIBR.format(camera="eucm", model="none", lens="", intrinsics="0.6, 1.1, 350.0, 351.0, 367.0, 248.0"),
     EucmCamera(752, 480, 350.0, 351.0, 367.0, 248.0, alpha=0.6, beta=1.1)),
    ("orbslam2.yaml", ORB_SLAM.format(type="PinHole", fx=458.0, fy=457.0, lens=ORB_RADTAN), RADTAN),
    ("orbslam_kb.yaml", ORB_SLAM.format(type="KannalaBrandt8", fx=380.0, fy=381.0, lens=ORB_KB), FISHEYE),
    ("orbslam3.yaml", ORB_SLAM3, FISHEYE),
    ("orbslam2_stereo.yaml", ORB_STEREO, RADTAN),
    ("camera_d.yaml", ORB_SLAM.format(type="PinHole", fx=458.0, fy=457.0, lens="Camera.D: [-0.28, 0.07, 0.0002, 0.00002]"), RADTAN),
    ("openvslam.yaml", OPENVSLAM.format(model="fisheye", lens=ORB_KB), FISHEYE),
    ("stella.yaml", STELLA, DivisionCamera(752, 480, 458.0, 457.0, 367.0, 248.0, k=-0.2)),
    ("vins_mei.yaml", VINS_MEI, OmniCamera(752, 480, 1200.0, 1201.0, 367.0, 248.0, xi=1.9, k1=-0.1, k2=0.2, p1=0.0003, p2=0.0006)),
    ("vins_pinhole.yaml", VINS_PINHOLE, RADTAN),
    ("vins_kb.yaml", VINS_KB, FISHEYE),
    ("sensor.yaml", EUROC_SENSOR, RADTAN),
    ("svo.yaml", SVO, RADTAN),
    ("okvis.yaml", OKVIS, RADTAN),
    ("basalt.json", json.dumps(BASALT), DoubleSphereCamera(752, 480, 350.0, 351.0, 367.0, 248.0, xi=-0.2, alpha=0.57)),
    ("transforms.json", json.dumps(NERFSTUDIO), replace(RADTAN, **HALF)),
    ("polycam.json", json.dumps(POLYCAM), PINHOLE),
    ("arkit.json", json.dumps(ARKIT), PINHOLE),
    ("camera_models.json", json.dumps(OPENSFM), RADTAN),
    ("metashape.xml", METASHAPE, RADTAN),
    ("replica.json", json.dumps(REPLICA), PINHOLE),
    ("cameras.txt", "# Camera list\n# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n"
     "1 OPENCV 752 480 458 457 367 248 -0.28 0.07 0.0002 0.00002\n", replace(RADTAN, **HALF)),
    ("umi.json", json.dumps(THEIA), FISHEYE),
    ("gyroflow.json", json.dumps(GYROFLOW), FISHEYE),
    ("realsense.json", json.dumps(REALSENSE), RADTAN),
    ("dso.txt", "RadTan 458 457 367 248 -0.28 0.07 0.0002 0.00002\n752 480\ncrop\n640 480\n", RADTAN),
    ("lsd_slam.cfg", "458 457 367 248 -0.28 0.07 0.0002 0.00002\n752 480\ncrop\n640 480\n", RADTAN),
    ("omnidir.yml", opencv("-0.1, 0.02, 0.0003, 0.0006", 4, "xi: !!opencv-matrix {rows: 1, cols: 1, dt: d, data: [0.9]}\n"),
     OmniCamera(752, 480, 458.0, 457.0, 367.0, 248.0, xi=0.9, k1=-0.1, k2=0.02, p1=0.0003, p2=0.0006)),
    ("image_size.yml", opencv("-0.28, 0.07, 0.0002, 0.00002, 0.01", 5).replace("image_width: 752\nimage_height: 480", "image_size: [752, 480]"), FIVE),
    ("arkit_kit.json", json.dumps({"intrinsics": [[458, 0, 0], [0, 457, 0], [367, 248, 1]], "imageResolution": [752, 480]}), PINHOLE),
    ("t265.json", json.dumps(REALSENSE | {"fx": 380, "fy": 381, "model": "distortion.kannala_brandt4", "coeffs": [0.003, 0.0007, -0.002, 0.0002, 0]}), FISHEYE),
    ("vikit.yaml", "cam_model: Pinhole\ncam_width: 752\ncam_height: 480\ncam_fx: 458\ncam_fy: 457\ncam_cx: 367\ncam_cy: 248\n"
     "cam_d0: -0.28\ncam_d1: 0.07\ncam_d2: 0.0002\ncam_d3: 0.00002\n", RADTAN),
    ("maplab_unified.yaml", SVO.replace("pinhole", "unified-projection").replace("[458", "[0.9, 458").replace("[-0.28, 0.07, 0.0002, 2.0e-05]", "[0, 0, 0, 0]"),
     OmniCamera(752, 480, 458.0, 457.0, 367.0, 248.0, xi=0.9)),
    ("mast3r_slam.yaml", "width: 752\nheight: 480\ncalibration: [458, 457, 367, 248, -0.28, 0.07, 0.0002, 0.00002, 0.01]\n", FIVE),
    ("mast3r_pinhole.yaml", "width: 752\nheight: 480\ncalibration: [458.0, 457.0, 367.0, 248.0]\n", PINHOLE),
    ("monogs.yaml", "Dataset:\n  type: tum\n  Calibration: {fx: 458, fy: 457, cx: 367, cy: 248, k1: -0.28, k2: 0.07, p1: 0.0002, p2: 0.00002, k3: 0.01, "
     "width: 752, height: 480, depth_scale: 5000.0, distorted: True}\n", FIVE),
    ("radtan_by_keys.yaml", "fx: 458\nfy: 457\ncx: 367\ncy: 248\nk1: -0.28\nk2: 0.07\np1: 0.0002\np2: 0.00002\nwidth: 752\nheight: 480\n", RADTAN),
    ("dso_equi.txt", "EquiDistant 380 381 367 248 0.003 0.0007 -0.002 0.0002\n752 480\nfull\n640 480\n", FISHEYE),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "expected"), FORMATS, ids=[f[0] for f in FORMATS])
def test_a_file_says_what_its_tool_means(tmp_path: Path, name: str, text: str, expected) -> None:
    path = tmp_path / name
    path.write_text(text)
    camera = read_camera_file(path)
    assert type(camera) is type(expected)
    got, wanted = camera.to_dict(), expected.to_dict()
    assert got.keys() == wanted.keys()
    for field in wanted:
        assert got[field] == pytest.approx(wanted[field], abs=1e-9), field


def test_opencv_writes_and_reads_it(tmp_path: Path) -> None:
    """The XML and the JSON of OpenCV's own writer."""
    for suffix in ("xml", "json", "yml"):
        path = tmp_path / f"camera.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 752)
        storage.write("image_height", 480)
        storage.write("fisheye_model", 1)
        storage.write("camera_matrix", FISHEYE.K)
        storage.write("distortion_coefficients", np.array([0.003, 0.0007, -0.002, 0.0002]))
        storage.release()
        assert read_camera_file(path) == FISHEYE


COLMAP = {
    "SIMPLE_PINHOLE": [], "PINHOLE": [], "SIMPLE_RADIAL": [-0.1], "RADIAL": [-0.1, 0.02], "OPENCV": [-0.1, 0.02, 1e-3, -1e-3],
    "OPENCV_FISHEYE": [0.01, -0.002, 3e-4, -1e-4], "FULL_OPENCV": [-0.1, 0.02, 1e-3, -1e-3, 0.003, 0, 0, 0], "FOV": [0.9],
    "SIMPLE_RADIAL_FISHEYE": [0.01], "RADIAL_FISHEYE": [0.01, -0.002], "SIMPLE_DIVISION": [-0.1], "DIVISION": [-0.1],
    "SIMPLE_FISHEYE": [], "FISHEYE": [], "EUCM": [0.6, 1.1],
}  # fmt: skip


@pytest.mark.parametrize("model", COLMAP)
def test_colmap_sees_points_where_we_do(tmp_path: Path, model: str) -> None:
    """Text, binary, and pycolmap's own dictionary; its pixels count from the corner of the first."""
    focal = [400.0] if "f," in theirs(model).params_info else [400.0, 401.0]
    written = theirs(model, [*focal, 330.0, 250.0, *COLMAP[model]])
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera(written)
    reconstruction.write_text(str(tmp_path))
    reconstruction.write_binary(str(tmp_path))
    as_dict = {"model": model, "width": 640, "height": 480, "params": list(written.params)}
    (tmp_path / "camera.json").write_text(json.dumps(as_dict))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3)) + (0, 0, 1)
    for name in ("cameras.txt", "cameras.bin", "camera.json"):
        ours = read_camera_file(tmp_path / name).project(points)
        assert np.isfinite(ours).all()
        np.testing.assert_allclose(ours + 0.5, [written.img_from_cam(p) for p in points], atol=1e-9)


def theirs(model: str, params: list[float] | None = None) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_id(1, getattr(pycolmap.CameraModelId, model), 400.0, 640, 480)
    if params is not None:
        camera.params = params
    return camera


REFUSED = [
    ("umi.json", json.dumps(THEIA | {"intrinsic_type": "DIVISION_UNDISTORTION"}), "'DIVISION_UNDISTORTION'"),
    ("umi.json", json.dumps(THEIA | {"intrinsics": THEIA["intrinsics"] | {"skew": 0.3}}), "skew"),
    ("gyroflow.json", json.dumps(GYROFLOW | {"input_horizontal_stretch": 1.33}), "input_horizontal_stretch is 1.33"),
    ("realsense.json", json.dumps(REALSENSE | {"model": "distortion.inverse_brown_conrady"}), "inverse_brown_conrady"),
    ("pano.yaml", OPENVSLAM.format(model="equirectangular", lens=""), "Camera.model: the camera model 'equirectangular'"),
    ("pano.yaml", 'Camera.model: "equirectangular"\nCamera.cols: 1920\nCamera.rows: 960\n', "'equirectangular'"),
    ("transforms.json", json.dumps(NERFSTUDIO | {"camera_model": "EQUIRECTANGULAR"}), "'EQUIRECTANGULAR'"),
    ("transforms.json", json.dumps(NERFSTUDIO | {"k4": 0.1}), "k4"),
    ("transforms.json", json.dumps(NERFSTUDIO | {"frames": [{"fl_x": 458.0}, {"fl_x": 470.0}]}), "frames.1.fl_x is 470.0"),
    ("transforms.json", json.dumps({"frames": [NERFSTUDIO, NERFSTUDIO | {"k1": -0.2}]}), "frames.1.k1 is -0.2"),
    ("transforms.json", json.dumps({"frames": [NERFSTUDIO, NERFSTUDIO | {"w": 1504}]}), "frames.1.w is 1504"),
    ("ros.yaml", ROS1_ECHO.replace("458.0", "0.0").replace("457.0", "0.0").replace("[0.0, 0.0, 367.0, 0.0, 0.0, 248.0, 0.0, 0.0, 1.0]", str([0] * 9)), "was not calibrated"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "image_shape: [480, 752]\n"), "image_shape looks like"),
    ("orb.yaml", ORB_SLAM.format(type="PinHole", fx=458.0, fy=4570.0, lens=ORB_RADTAN), "should be nearly equal"),
    ("kitti.txt", "P0: 7 0 3 0 0 7 2 0 0 0 1 0\nP1: 8 0 3 9 0 8 2 0 0 0 1 0\n", "P0 to P3 are of cameras that differ"),
    ("ros.yaml", ROS1_ECHO.replace("binning_x: 0", "binning_x: 2"), "binning_x"),
    ("ros.yaml", ROS1_ECHO.replace("x_offset: 0", "x_offset: 40"), "roi.x_offset"),
    ("ros.yaml", ROS1_ECHO.replace("plumb_bob", "thin_prism"), "'thin_prism'"),
    ("ros.yaml", ROS1_ECHO.replace("plumb_bob", "rational_polynomial").replace("2.0e-05, 0.0", "0, 0, 0.1, 0, 0"), "8 distortion"),
    ("ros.yaml", ROS1_ECHO + ROS1_ECHO.replace("458", "459"), "describes 2 cameras"),
    ("ros.yaml", ROS1_ECHO.replace("[458.0, 0.0", "[458.0, 2.0"), "K is not fx 0 cx"),
    ("orb.yaml", ORB_SLAM.format(type="PinHole", fx=458, fy=457, lens=ORB_KB), "Camera.k4"),
    ("orb.yaml", ORB_SLAM.format(type="PinHole", fx=458, fy=457, lens="Camera.lens: wide"), "Camera.lens"),
    ("orb.yaml", ORB_SLAM.format(type="KannalaBrandt8", fx=458, fy=457, lens=""), "has no k1"),
    ("orb.yaml", ORB_SLAM.format(type="PinHole", fx=458, fy=457, lens="Camera.model: fisheye\n" + ORB_RADTAN), "p1"),
    ("kalibr.yaml", KALIBR.format(camera="omni", model="equidistant", lens="0.1, 0, 0, 0", intrinsics=f"1.0, {PIXELS}"), "two models"),
    ("kalibr.yaml", KALIBR.format(camera="pinhole", model="none", lens="0.1, 0, 0, 0", intrinsics=PIXELS), "k1 is 0.1"),
    ("kalibr.yaml", KALIBR.format(camera="ds", model="none", lens="", intrinsics=PIXELS), "should be xi alpha fx fy cx cy"),
    ("vins.yaml", VINS_MEI.replace("MEI", "SCARAMUZZA"), "'SCARAMUZZA'"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "fisheye_model: 2\n"), "fisheye_model"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "tangential: {p3: 0.1}\n"), "p3"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "dist_coeff: [0.1, 0, 0, 0]\n"), "say different things"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "lens_distortion: [0.1, 0, 0, 0]\n"), "lens_distortion looks like"),
    ("opencv.yml", opencv("0, 0, 0, 0, 0", 5, "optics: fisheye\n"), "optics looks like"),
    ("meta.xml", METASHAPE.replace("frame", "spherical"), "'spherical'"),
    ("meta.xml", METASHAPE.replace("<b1>1.0</b1>", "<b2>1.0</b2>"), "b2 looks like"),
    ("meta.xml", METASHAPE.replace("<k1>", "<k4>0.1</k4><k1>"), "k4 is 0.1"),
    ("bomb.xml", '<!DOCTYPE x [<!ENTITY a "b">]><x>&a;</x>', "declares XML entities"),
    ("sfm.json", json.dumps({"a": OPENSFM["v2 unknown unknown 752 480 brown 0.6"] | {"projection_type": "dual"}}), "'dual'"),
    ("two.json", json.dumps(OPENSFM | {"other": OPENSFM["v2 unknown unknown 752 480 brown 0.6"]}), "several cameras"),
    ("basalt.json", json.dumps(BASALT).replace('"ds"', '"pinhole-radtan8"'), "'pinhole-radtan8'"),
    ("cameras.txt", "1 THIN_PRISM_FISHEYE 640 480 400 400 320 240 0 0 0 0 0 0 0 0\n", "'THIN_PRISM_FISHEYE'"),
    ("cameras.txt", "1 FULL_OPENCV 640 480 400 400 320 240 0 0 0 0 0 0.1 0 0\n", "k4 is 0.1"),
    ("cameras.txt", "1 PINHOLE 640 480 400 400 320 240\n2 PINHOLE 640 480 500 500 320 240\n", "describes 2 cameras"),
    ("realsense.json", json.dumps(POLYCAM | {"model": "Inverse Brown Conrady", "coeffs": [0.1, 0, 0, 0, 0]}), "Inverse Brown"),
    ("dso.txt", "Pinhole 458 457 367 248 0.3\n752 480\nnone\n640 480\n", "fifth number of a Pinhole"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "words"), REFUSED, ids=[f"{r[0]}-{r[2]}" for r in REFUSED])
def test_what_is_not_read_is_refused_by_its_name(tmp_path: Path, name: str, text: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_camera_file(path)
    message = str(caught.value)
    assert words in message
    assert str(path) in message
    assert message.endswith(".")


@pytest.mark.parametrize(
    "key", ["distortion_coefficients", "dist_coeff", "dist_coeffs", "dist", "distortion", "D", "distCoeffs"]
)
def test_coefficients_by_any_of_their_names(tmp_path: Path, key: str) -> None:
    path = tmp_path / "camera.yaml"
    head = "image_width: 752\nimage_height: 480\ncamera_matrix: [458, 0, 367, 0, 457, 248, 0, 0, 1]\n"
    path.write_text(f"{head}{key}: [-0.28, 0.07, 0.0002, 0.00002, 0.01]\n")
    assert read_camera_file(path) == FIVE


def test_blenders_synthetic_scenes_have_an_angle_and_no_size(tmp_path: Path) -> None:
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": [{"file_path": "./train/r_0"}]}))
    camera = read_camera_file(path, lambda: (800, 800))
    assert camera.to_dict() == pytest.approx(PinholeCamera(800, 800, 400.0, 400.0, 399.5, 399.5).to_dict())


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("droid.txt", "458 457 367 248 -0.28 0.07 0.0002 0.00002\n", RADTAN),
        ("K.txt", "458 0 367 0\n0 457 248 0\n0 0 1 0\n0 0 0 1\n", PINHOLE),
        ("camera_matrix.csv", "458.0,0.0,367.0\n0.0,457.0,248.0\n0.0,0.0,1.0\n", PINHOLE),
        ("calib.txt", "P0: 458 0 367 0 0 457 248 0 0 0 1 0\nP1: 458 0 367 -386.1 0 457 248 0 0 0 1 0\n", PINHOLE),
    ],
)
def test_numbers_without_a_size_are_of_these_images(tmp_path: Path, name: str, text: str, expected) -> None:
    """A line of DROID-SLAM, ScanNet's matrix, Stray Scanner's, and KITTI's projections."""
    path = tmp_path / name
    path.write_text(text)
    assert read_camera_file(path, lambda: (752, 480)) == expected


def test_a_file_that_does_not_say_the_size_of_its_images(tmp_path: Path) -> None:
    """ORB-SLAM2's files for one camera: the images say it, if the principal point is in their middle."""
    text = ORB_SLAM.format(type="PinHole", fx=458.0, fy=457.0, lens=ORB_RADTAN)
    path = tmp_path / "TUM1.yaml"
    path.write_text(text.replace("Camera.width: 752\n", "").replace("Camera.height: 480\n", ""))
    assert read_camera_file(path, lambda: (752, 480)) == RADTAN
    with pytest.raises(InputError, match="is not near the middle of these of 376 x 240; add image_width"):
        read_camera_file(path, lambda: (376, 240))
    with pytest.raises(InputError, match="does not say the size of the images; add image_width"):
        read_camera_file(path)


def test_the_camera_that_a_run_found_is_given_to_another_which_may_correct_it_once_more(tmp_path: Path) -> None:
    found = correct(PINHOLE, LensCorrection(0.03, 2.0, -1.0, -0.1, 0.02))
    with RunFolder(tmp_path / "run") as folder:
        folder.write_camera(found)
    camera = read_camera_file(tmp_path / "run" / "camera.yaml")
    rays = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (50, 3))
    np.testing.assert_allclose(camera.project(rays), found.project(rays))
    np.testing.assert_allclose(camera.rectify(found.project(rays))[0], found.rectify(found.project(rays))[0])
    again = correct(camera, LensCorrection(log_focal=0.01))
    assert again.K[0, 0] == pytest.approx(PINHOLE.fx * np.exp(0.03 + 0.01))
