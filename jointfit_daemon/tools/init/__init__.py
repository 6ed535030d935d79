"""Command `jointfit init`: a dialogue that writes a checked rig.toml.

Questions are data. The engine that selects them is pure: it has no terminal, clock or device.
"""

from jointfit_daemon.tools.init._command import init, rig_path

__all__ = ["init", "rig_path"]
