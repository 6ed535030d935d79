"""Options of a simulated NatNet server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_protocols.natnet import Version
    from jointfit_simulators.devices._natnet_frames import Axis, Hiding, RigidBodyAsset


def same_clock(host_ns: int) -> int:
    """Return `host_ns`, for a server with the clock of the host."""
    return host_ns


@dataclass(frozen=True, slots=True)
class NatNetServerOptions:
    """Constant properties of a server."""

    bodies: tuple[RigidBodyAsset, ...] = ()
    application: str = "Motive"
    bitstream: Version = (3, 1)
    transport: Literal["unicast", "multicast"] = "unicast"
    group: str = "239.255.42.99"
    command_port: int = 0
    """UDP port on the loopback interface; 0 selects a free port."""
    data_port: int = 0
    up_axis: Axis = "y"
    rate_hz: float = 120.0
    """Nominal frame rate, Hz, for `timestamp` and the request ``FrameRate``."""
    clock_hz: int = 10_000_000
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the server clock, both in ns."""
    received_after_ns: int = 4_600_000
    """Time from the exposure to the stamp `received`, ns. The stamp `transmit` is the true time of
    sending."""
    precision_ns: Callable[[int], int] | None = None
    """Conversion from host CLOCK_MONOTONIC to PTP time, both in ns; None for cameras without PTP.
    """
    exposure_stamps: bool = True
    """Whether frames have exposure stamps. USB cameras send 0."""
    hiding: Hiding = "missing"
    """Representation of occluded markers."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probability that a frame is sent after its successor. `loss` and `duplication` are also
    probabilities per frame."""
    hostile: float = 0.0
    """Probability that a frame contains a wrong count or length."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to each frame."""
    keepalive_s: float = 10.0
    """Time without a message after which a unicast client is disconnected, s."""
    copy_to_data_port: bool = False
    """Whether unicast frames are also sent to the client's address at the announced data port."""
    seed: int = 1
