"""Time: device clocks, lag between systems, alignment of streams to frames."""
