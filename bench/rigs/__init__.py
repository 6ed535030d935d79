"""Set-ups of experiments: daemon, simulators and broker as processes, or the core with events."""
