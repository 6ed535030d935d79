"""Wire formats, sans-IO: the same codec serves driver and simulator."""
