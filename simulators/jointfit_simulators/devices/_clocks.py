"""Clock and transport models of virtual devices.

A device clock has an offset, a skew and jitter relative to host CLOCK_MONOTONIC (the true time),
and its transport adds a delay.

Invariant: a device samples at whole periods of its own clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_simulators.settings import Knobs

NS = 1_000_000_000


class SimulatedClock:
    """An oscillator that counts from power-up, slightly wrong.

    Parameters
    ----------
    boot_ns
        Host time of power-up.
    skew
        Relative speed error: +50e-6 gains 50 us a second.
    """

    def __init__(self, boot_ns: int, skew: float) -> None:
        self.boot_ns = boot_ns
        self.skew = skew

    def device_ns(self, host_ns: int) -> int:
        """Return what the clock shows at a host instant."""
        return round((host_ns - self.boot_ns) * (1 + self.skew))

    def host_ns(self, device_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the host instants at which the clock shows `device_ns`."""
        since = np.rint(device_ns / (1 + self.skew)).astype(np.int64)
        return self.boot_ns + since


class ClockFault(NamedTuple):
    """What is asked of one device's clock, instead of what the dice would give it."""

    skew_ppm: float
    """By how much it runs fast."""
    up_s: float | None = None
    """How long it has been up when the run begins; None: as the dice fall."""

    @classmethod
    def parse(cls, text: str) -> ClockFault:
        """Return what ``SKEW_PPM`` or ``SKEW_PPM,UP_S`` asks for; ValueError if nothing."""
        skew_ppm, _, up_s = text.partition(",")
        return cls(float(skew_ppm), float(up_s) if up_s else None)


@dataclass(frozen=True, slots=True)
class PlannedSamples:
    """The samples of one device in one block of time; arrays of shape (n,)."""

    host_ns: NDArray[np.int64]
    """True instants, host clock."""
    device_ns: NDArray[np.int64]
    """What the device stamps on them."""
    due_ns: NDArray[np.int64]
    """When they reach the wire; never before an earlier one."""
    dropped: NDArray[np.bool_]
    """Which are never sent."""


class SampleTiming:
    """A device's sampling: instants, stamps, delays and losses, in blocks.

    Parameters
    ----------
    knobs
        Clock, latency and drop-out knobs.
    name
        The device; its dice are its own.
    latency_ms
        Least delay of its transport.
    now_ns
        Host time at which the run begins.
    """

    def __init__(self, knobs: Knobs, name: str, *, latency_ms: float, now_ns: int) -> None:
        self._random = knobs.random(f"clock {name}")
        skew = self._random.uniform(-1, 1) * knobs.clock_skew_ppm * 1e-6
        up_ns = round(self._random.uniform(0.1, 1.0) * knobs.clock_offset_s * NS)
        self.clock = SimulatedClock(now_ns - up_ns, skew)
        self._jitter_ns = knobs.clock_jitter_us * 1e3
        self._latency_ns = latency_ms * 1e6
        self._late_ns = knobs.latency_jitter_ms * 1e6
        self._dropout = knobs.dropout
        self._last_due_ns = 0

    def ask(self, fault: ClockFault, now_ns: int) -> None:
        """Run as `fault` says, from `now_ns` (the beginning of the run) on."""
        up_ns = now_ns - self.clock.boot_ns if fault.up_s is None else round(fault.up_s * NS)
        self.clock = SimulatedClock(now_ns - up_ns, fault.skew_ppm * 1e-6)

    def device_ns(self, host_ns: int) -> int:
        """Return what the clock shows at a host instant, whatever became of it since the start."""
        return self.clock.device_ns(host_ns)

    def reboot(self, host_ns: int) -> None:
        """Count from 0 again, from `host_ns` on."""
        self.clock = SimulatedClock(host_ns, self.clock.skew)

    def samples(self, begin_ns: int, end_ns: int, period_ns: float) -> PlannedSamples:
        """Return all samples taken from host time `begin_ns` up to `end_ns`."""
        first, end = self.clock.device_ns(begin_ns), self.clock.device_ns(end_ns)
        ticks = np.arange(np.ceil(first / period_ns), np.ceil(end / period_ns))
        true_ns = np.rint(ticks * period_ns).astype(np.int64)
        host_ns = self.clock.host_ns(true_ns)
        n = len(true_ns)
        stamps = true_ns + np.rint(self._random.standard_normal(n) * self._jitter_ns).astype(
            np.int64
        )
        delay = self._latency_ns + self._random.exponential(1.0, n) * self._late_ns
        due = np.maximum.accumulate(np.append(self._last_due_ns, host_ns + delay.astype(np.int64)))
        self._last_due_ns = int(due[-1])
        return PlannedSamples(host_ns, stamps, due[1:], self._random.random(n) < self._dropout)
