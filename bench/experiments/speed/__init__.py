"""CPU time, latency and memory."""
