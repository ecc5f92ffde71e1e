"""Monocular SLAM on GTSAM submaps that recovers from tracking failure by walking backwards in time."""

__version__ = "0.1.0"
