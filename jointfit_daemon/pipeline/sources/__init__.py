"""Sources: decoding, time stamping, latency priors, sync lines and monitoring of the lag."""

from jointfit_daemon.pipeline.sources._lag_monitor import LagMonitor, known_lags
from jointfit_daemon.pipeline.sources._source_state import SourceState, StampedMeasurement
from jointfit_daemon.pipeline.sources._sync_lines import SyncLines

__all__ = ["LagMonitor", "SourceState", "StampedMeasurement", "SyncLines", "known_lags"]
