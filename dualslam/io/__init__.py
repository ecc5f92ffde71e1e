"""Everything that is read and written: sequences of frames, camera files, trajectories and run folders."""

from dualslam.io.camera_files import read_camera_file
from dualslam.io.map_files import load_map, load_submap, save_map, save_submap
from dualslam.io.open_sequence import open_sequence
from dualslam.io.run_folder import FrameRow, RunFolder, RunRecord
from dualslam.io.sequence import RecordedSequence
from dualslam.io.trajectory_files import Trajectory, read_kitti, read_tum, write_kitti, write_tum

__all__ = [
    "FrameRow",
    "RecordedSequence",
    "RunFolder",
    "RunRecord",
    "Trajectory",
    "load_map",
    "load_submap",
    "open_sequence",
    "read_camera_file",
    "read_kitti",
    "read_tum",
    "save_map",
    "save_submap",
    "write_kitti",
    "write_tum",
]
