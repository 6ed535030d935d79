"""Clock and transport models of virtual devices.

A device clock has an offset, a skew and jitter relative to host CLOCK_MONOTONIC, which is the true
time. The transport of a device adds a delay.

Invariant: the sampling times are whole multiples of the sample period on the clock of the device.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_simulators.settings import Knobs


class SimulatedClock:
    """Device clock that counts from power-up, with a skew.

    Parameters
    ----------
    boot_ns
        Host time of power-up, ns.
    skew
        Relative frequency error. A clock with +50e-6 gains 50 us per second.
    """

    def __init__(self, boot_ns: int, skew: float) -> None:
        self.boot_ns = boot_ns
        self.skew = skew

    def device_ns(self, host_ns: int) -> int:
        """Return the device time at a host time."""
        return round((host_ns - self.boot_ns) * (1 + self.skew))

    def host_ns(self, device_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the host times at which the clock shows `device_ns`."""
        return self.boot_ns + np.rint(device_ns / (1 + self.skew)).astype(np.int64)


class ClockFault(NamedTuple):
    """Prescribed clock error of one device, which replaces a random error."""

    skew_ppm: float
    """Skew, ppm; positive if the clock is fast."""
    up_s: float | None = None
    """Time since power-up at the start of the run, s; None for a random time."""

    @classmethod
    def parse(cls, text: str) -> ClockFault:
        """Return the fault from ``SKEW_PPM`` or ``SKEW_PPM,UP_S``; raise ValueError otherwise."""
        skew_ppm, _, up_s = text.partition(",")
        return cls(float(skew_ppm), float(up_s) if up_s else None)


@dataclass(frozen=True, slots=True)
class PlannedSamples:
    """Samples of one device in one block of time. All arrays have the shape (n,)."""

    host_ns: NDArray[np.int64]
    """True sampling times on the host clock, ns."""
    device_ns: NDArray[np.int64]
    """Time stamps of the device, ns."""
    due_ns: NDArray[np.int64]
    """Host times of transmission, ns, which never decrease."""
    dropped: NDArray[np.bool_]
    """Whether the sample is dropped before transmission."""


class SampleTiming:
    """Sampling times, time stamps, delays and drop-outs of one device, in blocks.

    Parameters
    ----------
    knobs
        Magnitudes of clock, latency and drop-out errors.
    name
        Name of the device, which selects the random stream.
    latency_ms
        Minimum delay of the transport, ms.
    now_ns
        Host time at the start of the run, ns.
    """

    def __init__(self, knobs: Knobs, name: str, *, latency_ms: float, now_ns: int) -> None:
        self._random = knobs.random(f"clock {name}")
        skew = self._random.uniform(-1, 1) * knobs.clock_skew_ppm * 1e-6
        up_ns = round(self._random.uniform(0.1, 1.0) * knobs.clock_offset_s * NS_PER_S)
        self.clock = SimulatedClock(now_ns - up_ns, skew)
        self._jitter_ns = knobs.clock_jitter_us * 1e3
        self._latency_ns = latency_ms * 1e6
        self._latency_jitter_ns = knobs.latency_jitter_ms * 1e6
        self._dropout = knobs.dropout
        self._last_due_ns = 0

    def set_fault(self, fault: ClockFault, now_ns: int) -> None:
        """Replace the random clock by the clock of `fault`; the run starts at `now_ns`."""
        up_ns = now_ns - self.clock.boot_ns if fault.up_s is None else round(fault.up_s * NS_PER_S)
        self.clock = SimulatedClock(now_ns - up_ns, fault.skew_ppm * 1e-6)

    def device_ns(self, host_ns: int) -> int:
        """Return the device time at a host time, from the current clock."""
        return self.clock.device_ns(host_ns)

    def reboot(self, host_ns: int) -> None:
        """Restart the clock from 0 at `host_ns`."""
        self.clock = SimulatedClock(host_ns, self.clock.skew)

    def samples(self, begin_ns: int, end_ns: int, period_ns: float) -> PlannedSamples:
        """Return all samples taken from host time `begin_ns` up to `end_ns`."""
        first, end = self.clock.device_ns(begin_ns), self.clock.device_ns(end_ns)
        ticks = np.arange(np.ceil(first / period_ns), np.ceil(end / period_ns))
        true_ns = np.rint(ticks * period_ns).astype(np.int64)
        host_ns = self.clock.host_ns(true_ns)

        n = len(true_ns)
        jitter = np.rint(self._random.standard_normal(n) * self._jitter_ns).astype(np.int64)
        delay = self._latency_ns + self._random.exponential(1.0, n) * self._latency_jitter_ns

        # The transport preserves the order of the samples.
        due = np.maximum.accumulate(np.append(self._last_due_ns, host_ns + delay.astype(np.int64)))
        self._last_due_ns = int(due[-1])
        dropped = self._random.random(n) < self._dropout
        return PlannedSamples(host_ns, true_ns + jitter, due[1:], dropped)
