"""A synthetic world with exact truth: the data that the demo and the tests carry with them."""

from dualslam.lab.synthetic.events import parse_events
from dualslam.lab.synthetic.export import render_to_folder
from dualslam.lab.synthetic.sequence import SCENES, SyntheticSequence, make_sequence

__all__ = [
    "SCENES",
    "SyntheticSequence",
    "make_sequence",
    "parse_events",
    "render_to_folder",
]
