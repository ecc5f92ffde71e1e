"""Files of measurements: one function reads them all, by what the path is."""

from dualslam.io.measurements.files import read_measurements

__all__ = ["read_measurements"]
