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
    """Rigid bodies; each is a tracker of its own, unless `sensors` places it elsewhere."""
    sensors: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    """Tracker and sensor of bodies that share a tracker."""
    markers: tuple[str, ...] = ()
    """Markers that are sent as trackers without orientation."""
    port: int = 0
    """TCP and UDP port on loopback; 0: any free port."""
    connections: frozenset[str] = frozenset({"tcp", "classic"})
    """Accepted forms of connection."""
    version: tuple[int, int] = (7, 38)
    up_axis: Axis = "y"
    unit: Literal["m", "mm"] = "m"
    device_ns: Callable[[int], int] = same_clock
    """Conversion from host CLOCK_MONOTONIC to the server's clock, both in ns."""
    spread_us: int = 20
    """Time between the messages of one frame, µs."""
    described_late: bool = False
    """Whether a tracker is described with its first pose, and not with the connection."""
    answers_ping: bool = True
    velocities: bool = False
    """Whether every pose is followed by a velocity."""
    loss: float = 0.0
    duplication: float = 0.0
    reordering: float = 0.0
    """Probabilities per datagram; a reordered one is sent after its successor."""
    hostile: float = 0.0
    """Probability per message of a wrong length."""
    segment_bytes: int = 0
    """Size of the pieces in which a frame is sent by TCP; 0: whole."""
    wire_noise: WireNoise = clean_wire
    """Noise applied to the messages of each frame."""
    seed: int = 1
