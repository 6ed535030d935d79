"""Live outlet to the Lab Streaming Layer, off by default.

``pylsl`` is an optional dependency that only `LslOutlet.start` imports.
"""

from jointfit_daemon.outputs.lsl._lsl_outlet import LslError, LslOutlet

__all__ = ["LslError", "LslOutlet"]
