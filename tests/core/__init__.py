"""Tests of dualslam.core."""
