"""Driver for WitMotion IMUs, as an example of a driver in a package of its own."""
