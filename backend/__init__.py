"""Factor graphs of submaps and of the atlas over GTSAM: usable by itself, on arrays."""
