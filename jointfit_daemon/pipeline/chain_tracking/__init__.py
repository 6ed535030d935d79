"""Inverse kinematics of a chain model in operation, and detection of faulty markers."""

from jointfit_daemon.pipeline.chain_tracking._chain_tracker import ChainTracker
from jointfit_daemon.pipeline.chain_tracking._marker_monitor import MarkerMonitor, MarkerReport

__all__ = ["ChainTracker", "MarkerMonitor", "MarkerReport"]
