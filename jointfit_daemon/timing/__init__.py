"""Timing: device clocks, lag between systems, and alignment of streams to frames."""
