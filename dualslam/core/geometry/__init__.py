"""Lie groups, alignment, triangulation, two-view geometry and pose refinement, in numpy."""
