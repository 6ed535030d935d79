"""The daemon, simulators and a broker as processes; the core with recorded events."""
