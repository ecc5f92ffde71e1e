"""A run in three dimensions: while it goes on, in a browser, and afterwards, in the Rerun viewer.

Live: `messages` (what is sent of a run, as arrays), `live` (the run's side: a process of its own that may hang or die),
`live_scene` (what a picture of it holds). `live_page` (the page itself, by viser, an extra that is imported there
alone). Afterwards: `playback` (a finished run in time and space), `recording` (the same for Rerun, an extra that is
imported there alone). `map_page` (the same as a page to turn). `colours` serves both.
"""
