"""The steps of a frame through the system, one module for each: `dualslam.system` says which comes when."""
