"""Live outlet to the Lab Streaming Layer, off by default.

``pylsl`` is an extra, imported only by `LslOutlet.start`.
"""

from jointfit_daemon.outputs.lsl._lsl_outlet import LslError, LslOutlet

__all__ = ["LslError", "LslOutlet"]
