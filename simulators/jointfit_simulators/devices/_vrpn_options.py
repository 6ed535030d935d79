"""Options of a simulated VRPN server."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from jointfit_simulators.devices._natnet_options import same_clock
from jointfit_simulators.imu_device import WireNoise, clean_wire

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from jointfit_simulators.devices._natnet_frames import Axis


@dataclass(frozen=True, slots=True)
class VrpnServerOptions:
    """Constant properties of a server."""

    bodies: tuple[str, ...] = ()
    """Rigid bodies. Each body has its own tracker, unless `sensors` assigns the body to another
    tracker."""
    sensors: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    """Tracker and sensor number of each body that shares a tracker."""
    markers: tuple[str, ...] = ()
    """Markers that the server sends as trackers without orientation."""
    port: int = 0
    """TCP and UDP port on the loopback interface; 0 selects a free port."""
    connections: frozenset[str] = frozenset({"tcp", "classic"})
    """Accepted types of connection."""
    version: tuple[int, int] = (7, 38)
    up_axis: Axis = "y"
    unit: Literal["m", "mm"] = "m"
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the server's clock, both in ns."""
    spread_us: int = 20
    """Time between successive messages of one frame, µs."""
    described_late: bool = False
    """Whether the description of a tracker is sent immediately before its first pose. Otherwise, it
    is sent when a client connects."""
    answers_ping: bool = True
    velocities: bool = False
    """Whether a velocity follows every pose."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probability that a datagram is sent after its successor. `loss` and `duplication` are also
    probabilities per datagram."""
    hostile: float = 0.0
    """Probability that a message contains a wrong length."""
    segment_bytes: int = 0
    """Size of the TCP segments in which a frame is sent, bytes; 0 sends whole frames."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to the messages of each frame."""
    seed: int = 1
