"""Detectors, descriptors and matchers of kornia.feature. torch is imported in this package only, an extra."""
