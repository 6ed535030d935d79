"""The daemon, simulators and a broker as processes, and the core fed with recorded events."""
