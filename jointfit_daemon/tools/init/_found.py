"""Devices, drivers and names that were found on this machine.

The functions of `_engine.py` receive them in addition to the answers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

Wiring = Literal["serial", "can"]
"""Type of connection of an IMU."""


@dataclass(frozen=True, slots=True)
class KeyChoice:
    """A required driver key whose possible values the dialogue lists."""

    key: str
    values: tuple[Any, ...]
    help: str
    """Description of the key."""

    def meaning(self, value: Any) -> str:
        """Return the part of the description that begins with `value`, or an empty text."""
        starts = [(self.help.find(f"{mark}:"), mark) for mark in (f"`{value}`", f"{value}")]
        at, mark = max(starts)
        if at < 0:
            return ""
        text = self.help[at + len(mark) + 1 :]
        others = [f"; {form}:" for other in self.values for form in (f"`{other}`", f"{other}")]
        ends = [end for other in (*others, ". ") if (end := text.find(other)) >= 0]
        return text[: min(ends, default=len(text))].strip()


@dataclass(frozen=True, slots=True)
class CanSensor:
    """A sensor on a CAN bus, recognized from its frames."""

    driver: str
    ids: tuple[int, ...]
    """CAN identifiers, in the order of the names in the driver's table ``ids``."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Other keys of the sensor's ``[[imu]]`` table."""

    @property
    def text(self) -> str:
        """Driver, identifiers and settings as text."""
        settings = "".join(f", {key} {value}" for key, value in self.settings.items())
        return f"{self.driver} {' '.join(map(hex, self.ids))}{settings}"

    def agrees(self, driver: str, settings: Mapping[str, str]) -> bool:
        """Return whether the driver is `driver` and no setting differs from that in `settings`."""
        pairs = ((str(value), settings.get(key)) for key, value in self.settings.items())
        return driver == self.driver and all(given in {own, None} for own, given in pairs)


@dataclass(frozen=True, slots=True)
class ImuDriver:
    """An installed driver of IMUs, with the keys that the dialogue asks for."""

    name: str
    wiring: Wiring
    baud: int | None = None
    """Default of the driver's key ``baud``; None if the driver has no such key."""
    ids: Mapping[str, int] = field(default_factory=dict)
    """Names and defaults of the CAN identifiers in the driver's table ``ids``; empty if the driver
    has no such table."""
    text: str = ""
    """Description of the devices that the driver reads."""
    choices: tuple[KeyChoice, ...] = ()
    """Required keys of the driver whose possible values the dialogue lists."""
    needs_layout: bool = False
    """Whether the user must describe the frames of the device in the ``[[imu]]`` table."""
    possible: tuple[CanSensor, ...] = ()
    """Sensors that the driver can recognize, with their identifiers; empty if the identifiers have
    defaults."""


@dataclass(frozen=True, slots=True)
class MocapDriver:
    """An installed motion-capture driver."""

    name: str
    port: int | None = None
    """Default of the driver's key `port_key`; None if the driver has no such key."""
    up_axis: str = "y"
    """Default of the driver's key ``up_axis``; ``auto`` if the server announces the axis."""
    port_key: str = "command_port"
    """Name of the driver's key that contains the port of the server."""
    text: str = ""
    """Description of the motion-capture systems that the driver reads."""


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A serial port, a CAN interface, or a motion-capture server."""

    address: str
    """Path of the port, name of the interface, or HOST:PORT of the server."""
    text: str = ""
    """Description for the user: maker and product, state of the interface, or name of the
    application."""


@dataclass(frozen=True, slots=True)
class Found:
    """All devices, drivers and names that were found so far."""

    imu_drivers: tuple[ImuDriver, ...] = ()
    mocap_drivers: tuple[MocapDriver, ...] = ()
    ports: tuple[FoundDevice, ...] = ()
    interfaces: tuple[FoundDevice, ...] = ()
    servers: tuple[FoundDevice, ...] = ()
    can_sensors: Mapping[str, tuple[CanSensor, ...]] = field(default_factory=dict)
    """Recognized sensors, by the name of their CAN bus."""
    bauds: Mapping[str, int] = field(default_factory=dict)
    """Serial speeds at which devices answered, baud, by serial port."""
    recognized: Mapping[str, str] = field(default_factory=dict)
    """Drivers that decoded the data of a device, by serial port."""
    server_drivers: Mapping[str, str] = field(default_factory=dict)
    """Drivers of the found motion-capture servers, by server address."""
    layouts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Keys of ``[[imu]]`` that describe frames, by the path of the file that contains them."""
    markers: tuple[str, ...] = ()
    """Names of the markers in the motion-capture stream."""
    bodies: tuple[str, ...] = ()
    """Names of the rigid bodies in the motion-capture stream."""

    @property
    def addresses(self) -> frozenset[str]:
        """Addresses of all ports and interfaces."""
        return frozenset(device.address for device in (*self.ports, *self.interfaces))
