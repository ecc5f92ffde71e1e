"""Image patches warped between frames by pose and depth."""
