"""Driver for a self-built board, as an example of a driver in a package of its own."""
