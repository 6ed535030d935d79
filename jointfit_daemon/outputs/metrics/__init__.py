"""Metrics in the format of Prometheus: collected when they are requested, off by default.

``prometheus_client`` is an extra, imported only by `MetricsServer.start`.
"""

from jointfit_daemon.outputs.metrics._frame_statistics import FrameStatistics
from jointfit_daemon.outputs.metrics._server import MetricsError, MetricsServer

__all__ = ["FrameStatistics", "MetricsError", "MetricsServer"]
