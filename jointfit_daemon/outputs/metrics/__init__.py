"""Metrics in the format of Prometheus, collected at each HTTP request; off by default.

``prometheus_client`` is an optional dependency that only `MetricsServer.start` imports.
"""

from jointfit_daemon.outputs.metrics._frame_statistics import FrameStatistics
from jointfit_daemon.outputs.metrics._server import MetricsError, MetricsServer

__all__ = ["FrameStatistics", "MetricsError", "MetricsServer"]
