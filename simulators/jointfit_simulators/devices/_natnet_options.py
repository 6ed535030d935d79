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
    """Return `host_ns`: a server whose clock is the host's."""
    return host_ns


@dataclass(frozen=True, slots=True)
class NatNetServerOptions:
    """Everything about a server that does not change while it runs."""

    bodies: tuple[RigidBodyAsset, ...] = ()
    application: str = "Motive"
    bitstream: Version = (3, 1)
    transport: Literal["unicast", "multicast"] = "unicast"
    group: str = "239.255.42.99"
    command_port: int = 0
    """0: any free port of loopback."""
    data_port: int = 0
    up_axis: Axis = "y"
    rate_hz: float = 120.0
    """Nominal: for `timestamp` and the request ``FrameRate``; frames come as they are pushed."""
    clock_hz: int = 10_000_000
    device_ns: Callable[[int], int] = same_clock
    """Server clock, ns, at a host CLOCK_MONOTONIC instant: offset and skew live here."""
    received_after_ns: int = 4_600_000
    """From exposure to the stamp `received`; `transmit` is the true time of sending."""
    precision_ns: Callable[[int], int] | None = None
    """PTP time, ns, of cameras on PTP at a host CLOCK_MONOTONIC instant; None: they are not."""
    exposure_stamps: bool = True
    """False: USB cameras, exposure is 0."""
    hiding: Hiding = "missing"
    """What a hidden marker looks like."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probabilities for each frame; a reordered one leaves after its successor."""
    hostile: float = 0.0
    """Probability that a frame gets a wrong count or length."""
    wire_noise: WireNoise = clean_wire
    """What the wire does to each frame."""
    keepalive_s: float = 10.0
    """A unicast client silent for this long is dropped."""
    copy_to_data_port: bool = False
    """Unicast frames also to the client's address at the announced data port."""
    seed: int = 1
