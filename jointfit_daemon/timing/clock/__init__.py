"""Device clocks: the host time of every device sample, with its standard deviation."""

from jointfit_daemon.timing.clock._delay_statistics import DelayPercentiles
from jointfit_daemon.timing.clock._device_clock import DeviceClock
from jointfit_daemon.timing.clock._direct_time import SYNC_STALE_NS
from jointfit_daemon.timing.clock._stamps import SLEW, Stamp
from jointfit_daemon.timing.clock._sync_line import Edge, SyncLine

__all__ = ["SLEW", "SYNC_STALE_NS", "DelayPercentiles", "DeviceClock", "Edge", "Stamp", "SyncLine"]
