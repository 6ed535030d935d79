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
    """Return `host_ns`: the server has the clock of the host."""
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
    """UDP port on loopback; 0: any free port."""
    data_port: int = 0
    up_axis: Axis = "y"
    rate_hz: float = 120.0
    """Nominal frame rate, for `timestamp` and the request ``FrameRate``."""
    clock_hz: int = 10_000_000
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the server clock, both in ns."""
    received_after_ns: int = 4_600_000
    """Delay from exposure to the stamp `received`; `transmit` is the true time of sending."""
    precision_ns: Callable[[int], int] | None = None
    """Conversion from host CLOCK_MONOTONIC to PTP time, both in ns; None: cameras without PTP."""
    exposure_stamps: bool = True
    """Whether frames have exposure stamps; USB cameras send 0."""
    hiding: Hiding = "missing"
    """Representation of occluded markers."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probabilities per frame; a reordered frame is sent after its successor."""
    hostile: float = 0.0
    """Probability per frame of a wrong count or length."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to each frame."""
    keepalive_s: float = 10.0
    """Time without a message after which a unicast client is dropped, s."""
    copy_to_data_port: bool = False
    """Whether unicast frames are also sent to the announced data port of the client's address."""
    seed: int = 1
