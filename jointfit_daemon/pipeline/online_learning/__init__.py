"""Online learning: selection of training frames, refits and their state."""

from jointfit_daemon.pipeline.online_learning._frame_collector import OnlineLearner
from jointfit_daemon.pipeline.online_learning._refits import Learned, models_only

__all__ = ["Learned", "OnlineLearner", "models_only"]
