"""Online learning: selection of training frames, refits and their state."""

from jointfit_daemon.pipeline.online_learning._frame_collector import OnlineFrameCollector
from jointfit_daemon.pipeline.online_learning._refits import OnlineRefits, only_models_differ

__all__ = ["OnlineFrameCollector", "OnlineRefits", "only_models_differ"]
