"""Streams of IMU samples, one per device.

Samples are planned in blocks (computed in advance) and sent one by one.

Invariant: a sample contains its sampling time, even if it is sent late. Every sample is counted
once: by the device as sent, or by `ImuStream` as dropped out, refused or unheard.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.devices import OrientationSensor, SampleTiming, SensorFaults
from jointfit_simulators.imu_device import ImuDevice

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.imu_device import Quaternion
    from jointfit_simulators.scene._opened_port import OpenedPort
    from jointfit_simulators.settings import Knobs


SampleCallback = Callable[[str, int, int], None]
"""Callback for every sent sample. The arguments are the name of the device, the transmitted sample
number, and the true host time, ns."""

_MOST_EDGES = 4096
"""Maximum number of planned sync edges. Older edges are dropped."""


class SceneImuDevice(ImuDevice, Protocol):
    """Virtual IMU with faults that a scene can trigger."""

    def edge(self, device_ns: int) -> None:
        """Add an edge on the sync input at a device time; do nothing without a sync input."""

    @property
    def counter(self) -> int:
        """Number of the next sample."""

    @property
    def line_ns(self) -> int:
        """Transmission time of a sample from first to last byte, ns; 0 on a wire without delay."""

    def lose(self, count: int) -> None:
        """Do not send the next `count` samples; the sample counter counts them nevertheless."""

    def power_cycle(self) -> None:
        """Interrupt the power supply; clock and counter restart."""

    def unplug(self) -> None:
        """Disconnect the wire."""

    def plug(self) -> None:
        """Connect the wire."""


class ImuStream:
    """Stream of one sensor, with orientation errors, clock and device.

    Parameters
    ----------
    knobs
        Settings with the magnitudes of all errors.
    name
        Sensor id.
    device
        Device that sends the samples.
    latency_ms
        Minimum delay of the transport, ms.
    shared_wire
        Whether other devices use the wire. If so, unplugging stops this sensor only.
    now_ns
        Host time at the start of the run, ns.
    port
        Serial port of the device; None on a wire that can detect whether the host receives.
    """

    def __init__(
        self,
        knobs: Knobs,
        name: str,
        device: SceneImuDevice,
        *,
        latency_ms: float,
        shared_wire: bool,
        now_ns: int,
        port: OpenedPort | None = None,
    ) -> None:
        self.name, self.device = name, device
        self.on_sample: SampleCallback | None = None
        """Callback for every sent sample."""

        self.sensor, self.faults = OrientationSensor(knobs, name), SensorFaults()
        self.timing = SampleTiming(knobs, name, latency_ms=latency_ms, now_ns=now_ns)
        self._default_hz, self._shared = knobs.rate_hz, shared_wire
        self._unplugged = False
        self._port = port
        self._planned: deque[tuple[int, int, Quaternion | None]] = deque()
        self._edges: deque[int] = deque(maxlen=_MOST_EDGES)
        self.dropped_out = 0
        """Number of samples that a measuring device did not send, because `Knobs.dropout` dropped
        them or the recorded trial has no orientation."""
        self.unheard = 0
        """Number of samples that were taken while the device was unplugged, paused or not
        measuring, or before the first opening of the port."""
        self.refused = 0
        """Number of samples that a full line rejected."""

    def add_edges(self, edges_ns: NDArray[np.int64]) -> None:
        """Plan edges of the sync line at the given host times, ns."""
        self._edges.extend(edges_ns.tolist())

    def plan(self, begin_ns: int, end_ns: int) -> NDArray[np.int64]:
        """Plan the samples of a block; return their true host times, ns."""
        rate_hz = self.device.rate_hz or self._default_hz
        self._block = self.timing.samples(begin_ns, end_ns, NS_PER_S / rate_hz)
        return self._block.host_ns

    def fill(self, t_s: Array, q_base_sensor: Array) -> list[int]:
        """Add orientations to the planned samples; return the transmission times, ns."""
        measured = self.faults.apply(t_s, self.sensor.report(t_s, q_base_sensor))
        lost = self._block.dropped | ~np.isfinite(measured[:, 0])
        for true_ns, stamp, q, dropped in zip(
            self._block.host_ns.tolist(), self._block.device_ns.tolist(), measured.tolist(),
            lost.tolist(), strict=True,
        ):  # fmt: skip
            orientation = None if dropped else cast("Quaternion", tuple(q))
            self._planned.append((true_ns, stamp, orientation))

        # The host receives a sample with the last byte of the sample.
        return cast("list[int]", (self._block.due_ns + self.device.line_ns).tolist())

    def emit(self, *, sending: bool = True) -> None:
        """Send the next sample, or drop it if the device cannot send."""
        true_ns, stamp, q = self._planned.popleft()
        while self._edges and self._edges[0] <= true_ns:
            self.device.edge(self.timing.device_ns(self._edges.popleft()))

        if self._unplugged or not sending or not self.device.streaming or not self._is_read():
            self.unheard += 1
            return
        if q is None:
            self.dropped_out += 1
            self.device.lose(1)
            self.device.push(stamp, (1.0, 0.0, 0.0, 0.0))
            return

        before, number = self.device.sent, self.device.counter
        self.device.push(stamp, q)
        if self.device.sent == before:
            self.refused += 1
        elif self.on_sample is not None:
            self.on_sample(self.name, number, true_ns)

    def _is_read(self) -> bool:
        if self._port is not None and self._port.is_read:
            self._port = None  # the host reads from now on
        return self._port is None

    def discard(self) -> None:
        """Discard the planned samples that are not yet sent."""
        self._planned.clear()

    def unplug(self) -> None:
        """Disconnect the device from its wire."""
        self._unplugged = True
        if not self._shared:
            self.device.unplug()

    def plug(self) -> None:
        """Connect the device to its wire."""
        self._unplugged = False
        if not self._shared:
            self.device.plug()

    def status(self) -> dict[str, object]:
        """Return the counters, as JSON values."""
        return {
            "streaming": self.device.streaming and not self._unplugged,
            "rate_hz": self.device.rate_hz,
            "sent": self.device.sent,
            "dropped_out": self.dropped_out,
            "refused": self.refused,
            "unheard": self.unheard,
        }
