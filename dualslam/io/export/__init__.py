"""A run's map in the formats of other programs. One file for each; `formats.FORMATS` has them by name."""
