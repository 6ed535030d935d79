"""The driver interface: settings, decoder, errors, and lookup by entry point.

Invariant: this module contains no code for a particular device model. Drivers are registered in the
entry point group ``jointfit.drivers``. A driver is imported when a rig first uses it, so a broken
plug-in affects only rigs that use it.

A driver has two parts. ``decoder()`` returns the pure part, which converts chunks (bytes with their
arrival time) to samples in SI units. The pure part reads neither a clock nor a port. ``run(emit)``
opens and configures the device, and reads until cancelled. The daemon creates a decoder when a
source opens, and feeds all emitted chunks to it. A replay feeds the recorded chunks to a decoder
instead.
"""

from __future__ import annotations

import functools
import importlib.metadata
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from jointfit_daemon.model import Chunk
from jointfit_daemon.nearest_name import unknown_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from importlib.metadata import EntryPoints

    from jointfit_daemon.model import Decoded, TickClock

ENTRY_POINT_GROUP = "jointfit.drivers"
"""Entry point group in which a package registers its drivers."""

Emit = Callable[[Chunk], None]
"""Function that passes one chunk to the daemon synchronously. A driver must not catch exceptions of
this function, because they are bugs."""

Wire = Literal["stream", "datagram", "can"]
"""Content of a chunk: any part of a byte stream, one datagram, or a sequence of CAN records."""


SLOWEST_BAUD, FASTEST_BAUD = 300, 12_000_000
"""Range of serial port speeds, baud; no adapter is faster."""


class DeviceLostError(Exception):
    """The device is absent, in use, unplugged or silent; a retry may succeed."""


class DeviceAbsentError(DeviceLostError):
    """The port of the device is unplugged, or does not exist.

    Further attempts fail for the same reason until the port appears, so only the first failure is
    reported.
    """


class DeviceMisconfiguredError(Exception):
    """The device cannot work with these settings; the message names the setting to change.

    The source pauses for at most a minute. It continues earlier after a reload of rig.toml, or if
    another device appears on its port. Raise `DeviceLostError` for faults that can end without a
    change of the settings: a port in use, no free file descriptor, or a bus that is down.
    """


class Settings(BaseModel):
    """Base class of all tables of rig.toml. Instances are frozen, and unknown keys are rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def contradictions(self) -> Iterable[tuple[str, str]]:
        """Yield each key whose value contradicts another value, with the fault and its remedy.

        Override this method instead of adding a model validator. The check of rig.toml also calls
        this method for tables with other faults; values that cannot be read are then None.
        """
        return ()

    @model_validator(mode="after")
    def _without_contradictions(self) -> Self:
        for key, text in self.contradictions():
            raise PydanticCustomError(CONTRADICTION, "{key}: {text}", {"key": key, "text": text})
        return self


CONTRADICTION = "contradiction"
"""Type of the pydantic error that `Settings.contradictions` causes."""


class CanBusError(ValueError):
    """A ``[can.NAME]`` table cannot be used on this machine; raised by validators of drivers.

    Parameters
    ----------
    faults
        Text with the fault and its remedy for each wrong key of the table.
    """

    def __init__(self, faults: Mapping[str, str]) -> None:
        texts = [text if key == "interface" else f"{key}: {text}" for key, text in faults.items()]
        super().__init__("; ".join(texts))
        self.faults = dict(faults)


_SLCAN_BITRATES = (
    10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000,
)  # fmt: skip
SERIAL_ADAPTERS = ("slcan", "serial", "seeedstudio", "robotell")
"""CAN interfaces whose channel is a serial port."""
_LONGEST_INTERFACE = 15
"""Longest name of a network interface, bytes. The constant IFNAMSIZ of the kernel also counts the
terminating NUL."""
INTERFACE_NAME_EXPECTED = (
    "expected the name of a network interface, as `ip link` shows it: up to "
    f"{_LONGEST_INTERFACE} bytes without slash or space"
)


def host_fault(host: str) -> str | None:
    """Return why `host` is neither an IP address nor a host name; None if `host` is valid."""
    with suppress(ValueError):
        ip_address(host)
        return None
    labels = host.removesuffix(".").split(".")
    if labels[-1].isdigit():
        return "expected an IP address of four numbers from 0 to 255, such as 192.168.1.20"
    if not all(_HOST_LABEL.fullmatch(label) for label in labels):
        return "expected one address or name without spaces, slashes and port, such as 192.168.1.20"
    return None


_HOST_LABEL = re.compile(r"(?!-)[\w-]{1,63}(?<!-)")
"""Part of a host name between dots."""


_NO_PORT = re.compile(r"(v|vx|sl)?can\d+|eth\d+|tty\w+|COM\d+", re.IGNORECASE)
"""Pattern of names that are often given instead of a path: network interfaces, Windows ports, and
device files without their folder."""


def port_path_fault(path: str) -> str | None:
    """Return why `path` cannot be the device file of a serial port; None if it can be."""
    if not path.strip():
        return "must not be empty: expected a serial port, such as /dev/ttyUSB0"
    if _NO_PORT.fullmatch(path):
        return "expected the path of a serial port, such as /dev/ttyUSB0 (see ls /dev/serial/by-id)"
    return None


def is_interface_name(name: str) -> bool:
    """Return whether the kernel permits `name` for a network interface."""
    if name in {"", ".", ".."} or any(letter in "/:" or letter.isspace() for letter in name):
        return False
    return len(name.encode()) <= _LONGEST_INTERFACE


class CanBusSettings(Settings):
    """One ``[can.NAME]`` table, which describes a bus with one or several devices."""

    # Other keys are passed to python-can.
    model_config = ConfigDict(frozen=True, extra="allow")

    interface: str = Field(
        "socketcan", description="python-can interface, or `slcan` (our own codec)"
    )
    channel: str = Field(description="`can0`, or the serial port of an SLCAN adapter")
    bitrate: int = Field(
        1_000_000,
        ge=10_000,
        le=1_000_000,
        description="speed of the bus and of all its devices, bit/s; for `socketcan`, the command "
        "`ip link set can0 up type can bitrate 1000000` sets it, and this key is used only to "
        "check the load",
    )
    baud: int = Field(
        115_200,
        ge=SLOWEST_BAUD,
        le=FASTEST_BAUD,
        description="speed of an SLCAN adapter's serial port, baud",
    )
    transport: Literal["usb", "uart"] = Field(
        "usb",
        description="port of an SLCAN adapter: `usb` transfers without delay, whatever `baud` is; "
        "for a `uart`, the duration of the received bytes at `baud` is subtracted from the stamps",
    )

    @field_validator("channel")
    @classmethod
    def _check_channel(cls, channel: str, info: ValidationInfo) -> str:
        """Reject names that the kernel does not permit."""
        if not channel:
            raise ValueError("must not be empty")
        interface = info.data.get("interface")
        if interface in SERIAL_ADAPTERS and (fault := port_path_fault(channel)) is not None:
            raise ValueError(f'{fault}; a network interface needs interface = "socketcan"')
        if interface == "socketcan" and not is_interface_name(channel):
            raise ValueError(
                f'{INTERFACE_NAME_EXPECTED}; a serial adapter needs interface = "slcan"'
            )
        return channel

    @field_validator("bitrate")
    @classmethod
    def _check_bitrate(cls, bitrate: int, info: ValidationInfo) -> int:
        """Reject bit rates for which SLCAN has no command."""
        if info.data.get("interface") == "slcan" and bitrate not in _SLCAN_BITRATES:
            known = ", ".join(map(str, _SLCAN_BITRATES))
            raise ValueError(f"not a bit rate of SLCAN: expected one of {known}")
        return bitrate


class ImuSettings(Settings):
    """Common keys of all ``[[imu]]`` tables; the ``Settings`` of an IMU driver derive from this."""

    id: str = Field(description="name of the sensor; becomes an MQTT topic")
    segment: str = Field(description="segment of [chain] to which the sensor is attached")
    driver: str = Field(description="driver name; `jointfit check` lists all names")
    rate_hz: float = Field(
        100.0, gt=0, le=2000, description="sample rate requested of the device, Hz"
    )
    silence_s: float = Field(
        1.0, gt=0, description="time without a byte after which the device counts as lost, s"
    )
    least_delay_ms: tuple[float, float] | None = Field(
        None,
        description="smallest delay from measurement to arrival and its standard deviation, ms; "
        "default: the values of the transport",
    )
    lag_ms: float | None = Field(
        None,
        ge=-1000,
        le=1000,
        description="known lag, ms: stamp of this sensor minus stamp of the cameras for the same "
        "event; the lag that the daemon estimates from motion then only serves as a check",
    )
    lag_sd_ms: float = Field(0.1, gt=0, le=100, description="standard deviation of `lag_ms`, ms")

    @property
    def serial_bits_per_s(self) -> float | None:
        """Bit rate that the samples need on a serial line, bit/s; None without a limiting line."""
        return None

    @property
    def can_frames(self) -> tuple[tuple[int, bool], ...]:
        """CAN frames of one sample.

        Each item consists of the number of data bytes of a frame, and a flag that is true if the
        identifier of the frame has 29 bits.
        """
        return ()


class MocapSettings(Settings):
    """Common keys of all ``[mocap]`` tables; the ``Settings`` of a driver derive from this."""

    driver: str = Field(description="driver name")
    up_axis: Literal["x", "y", "z"] = Field("y", description="vertical axis of the stream")
    markers: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, description="markers of each segment: at least three, not collinear"
    )
    rigid_body: dict[str, str] = Field(
        default_factory=dict, description="rigid body of each segment, instead of markers"
    )
    plate: str | None = Field(
        None,
        min_length=1,
        description="rigid body of the plate that carries the sensors in the align phase",
    )
    silence_s: float = Field(
        1.0, gt=0, description="time without a datagram after which the server counts as lost, s"
    )
    least_delay_ms: tuple[float, float] | None = Field(
        None,
        description="smallest delay from exposure to arrival and its standard deviation, ms; for "
        "servers that do not answer requests for their time",
    )
    sync_line: int | None = Field(
        None, description="number of the sync line with an edge at every exposure, if connected"
    )


def device_path(settings: object) -> str | None:
    """Return the device file or network interface in the settings of a driver.

    It is the `port`, or the channel of the CAN bus. The result is None for settings that have
    neither, such as the settings of a network device.
    """
    found = getattr(settings, "port", None) or getattr(
        getattr(settings, "can", None), "channel", None
    )
    return found if isinstance(found, str) else None


class Decoder(Protocol):
    """The pure part of a driver. No input raises an exception.

    Some decoders decode motion-capture frames that they do not return. They count the withheld
    frames in three attributes of type int: ``unpublished`` (frames whose layout is not known yet),
    ``duplicates`` and ``late``.

    Some data cannot be decoded without earlier messages, such as the list of marker names. The
    decoder of such data has an attribute ``description`` of type tuple of bytes. The attribute
    contains the newest messages that describe the data, in the order in which a new decoder needs
    them. A recording that starts while the driver runs begins with these messages. Without this
    attribute, such a recording begins with the chunks that arrived before the first measurement.
    """

    @property
    def tick_clock(self) -> TickClock | None:
        """Time base of the device; None while unknown."""

    @property
    def messages(self) -> int:
        """Number of well-formed messages so far."""

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far that belong to no message."""

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the items that `chunk` completes, in wire order."""

    def flush(self) -> list[Decoded]:
        """Discard an incomplete message at the end of input or after silence.

        Return the items that the remaining bytes contain.
        """


class Driver(Protocol):
    """The interface of a driver class, as registered by an entry point."""

    Settings: ClassVar[type[Any]]
    """Pydantic model of the driver's table; a subclass of `ImuSettings` or `MocapSettings`."""
    wire: ClassVar[Wire]
    """Content of the driver's chunks."""

    def __init__(self, settings: Any) -> None: ...

    def decoder(self) -> Decoder:
        """Return a new decoder."""

    async def run(self, emit: Emit) -> None:
        """Open and configure the device, and read until cancelled.

        After a failure the daemon calls this method again on the same object.

        Raises
        ------
        DeviceLostError
            The device is absent, in use or silent.
        DeviceMisconfiguredError
            The device cannot work with the settings.
        """


class UnknownDriverError(LookupError):
    """No installed package registers a driver with this name."""


def entry_points(*, group: str) -> EntryPoints:
    """Return the entry points of a group.

    The result is cached, because the search of `sys.path` takes 8 ms.
    """
    return _entry_points_on(tuple(sys.path), group)


@functools.cache
def _entry_points_on(_path: tuple[str, ...], group: str) -> EntryPoints:
    return importlib.metadata.entry_points(group=group)


def driver_names() -> list[str]:
    """Return the names of all registered drivers, without importing them."""
    return sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)})


def find_driver(name: str) -> type[Driver]:
    """Return the driver class registered as `name`, without importing other drivers.

    Raises
    ------
    UnknownDriverError
        The name is not registered; the message contains the most similar name and all names.
    """
    found = [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name == name]
    if not found:
        raise UnknownDriverError(unknown_name("driver", name, driver_names()))
    return cast("type[Driver]", found[0].load())
