"""Everything that is read and written: sequences of frames, camera files, trajectories and run folders."""

from dualslam.io.camera_files import read_camera_file
from dualslam.io.open_sequence import open_sequence
from dualslam.io.sequence import RecordedSequence
from dualslam.io.trajectory_files import Trajectory, read_kitti, read_tum, write_kitti, write_tum

__all__ = [
    "RecordedSequence",
    "Trajectory",
    "open_sequence",
    "read_camera_file",
    "read_kitti",
    "read_tum",
    "write_kitti",
    "write_tum",
]
