"""Devices, drivers and names that were found on this machine: the second input of the engine."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

Wiring = Literal["serial", "can"]
"""Connection of an IMU."""


@dataclass(frozen=True, slots=True)
class ImuDriver:
    """An installed driver of IMUs, as far as the dialogue asks for its keys."""

    name: str
    wiring: Wiring
    baud: int | None = None
    """Default of its key ``baud``; None without that key."""
    ids: Mapping[str, int] = field(default_factory=dict)
    """Names and defaults of the CAN identifiers in its table ``ids``; empty without that table."""


@dataclass(frozen=True, slots=True)
class MocapDriver:
    """An installed driver of motion capture."""

    name: str
    port: int | None = None
    """Default of its key ``command_port``; None without that key."""
    up_axis: str = "y"
    """Default of its key ``up_axis``; ``auto`` if the server announces the axis."""


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A serial port, a CAN interface, or a server of motion capture."""

    address: str
    """Path, name of the interface, or HOST:PORT."""
    text: str = ""
    """Description: maker and product, state of the interface, name of the application."""


@dataclass(frozen=True, slots=True)
class Found:
    """Everything that was found so far."""

    imu_drivers: tuple[ImuDriver, ...] = ()
    mocap_drivers: tuple[MocapDriver, ...] = ()
    ports: tuple[FoundDevice, ...] = ()
    interfaces: tuple[FoundDevice, ...] = ()
    servers: tuple[FoundDevice, ...] = ()
    ids: Mapping[str, tuple[tuple[int, ...], ...]] = field(default_factory=dict)
    """Sets of CAN identifiers of sensors that were received, by bus."""
    bauds: Mapping[str, int] = field(default_factory=dict)
    """Speeds at which devices answered, by serial port, baud."""
    markers: tuple[str, ...] = ()
    """Names of the markers in the stream of the cameras."""
    bodies: tuple[str, ...] = ()
    """Names of the rigid bodies in the stream of the cameras."""

    @property
    def addresses(self) -> frozenset[str]:
        """Addresses of all ports and interfaces."""
        return frozenset(device.address for device in (*self.ports, *self.interfaces))
