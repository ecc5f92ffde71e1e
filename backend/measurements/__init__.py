"""Measurements from outside the images, and the joint graph that puts a map into their frame and unit."""
