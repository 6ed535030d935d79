"""Sources: decoding and time stamping, latency priors, sync lines and lag monitoring."""

from jointfit_daemon.pipeline.sources._lag_monitor import LagWatch, known_lags
from jointfit_daemon.pipeline.sources._source_state import SourceState, Stamped
from jointfit_daemon.pipeline.sources._sync_lines import SyncLines

__all__ = ["LagWatch", "SourceState", "Stamped", "SyncLines", "known_lags"]
