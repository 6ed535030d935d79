"""The pure core, wired: events in, limb states and notices out."""
