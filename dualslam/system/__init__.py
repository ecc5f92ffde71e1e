"""The algorithm, in the numbered steps of a frame; `system.py` comes first."""
