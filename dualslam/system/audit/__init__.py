"""Signals that audit a whole run, independent of the gates that placed its frames, and the verdict made of them."""
