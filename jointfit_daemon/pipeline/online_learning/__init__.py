"""Online learning: while the cameras see the limb, its soft-tissue models are refitted.

The package selects training frames, tracks the refits, and reports the state.
"""

from jointfit_daemon.pipeline.online_learning._frame_collector import OnlineFrameCollector
from jointfit_daemon.pipeline.online_learning._refits import OnlineRefits, only_models_differ

__all__ = ["OnlineFrameCollector", "OnlineRefits", "only_models_differ"]
