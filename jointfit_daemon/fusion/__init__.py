"""One aligned set of orientations in, one limb state out. Pure."""
