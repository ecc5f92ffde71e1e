"""Worlds with exact truth, for tests: ours, and those of front ends and back ends elsewhere.

Nothing here needs a test runner, an image or a network. `graph_scene` feeds a factor graph, `link_worlds` makes pairs
of submaps to link (`adversaries` spoils them), `two_maps` two views and two maps of one scene. `point_world` runs the
whole system on points that a camera passes.
"""
