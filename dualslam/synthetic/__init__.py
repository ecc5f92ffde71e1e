"""A synthetic world with exact truth: the data that the demo and the tests carry with them."""

from dualslam.synthetic.events import Event, EventKind, parse_events
from dualslam.synthetic.export import render_to_folder
from dualslam.synthetic.sequence import SCENES, SyntheticSequence, make_sequence

__all__ = ["SCENES", "Event", "EventKind", "SyntheticSequence", "make_sequence", "parse_events", "render_to_folder"]
