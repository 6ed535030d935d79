"""What a driver is, what it may raise, and how one is found.

Law: this file names no device. A driver is found by entry point (group ``jointfit.drivers``), one
at a time and only when asked for, so that a broken plug-in hurts nobody but its users.

A driver has two halves. ``decoder()`` gives the pure half: chunks in, samples in SI out, no clock,
no port. ``run(emit)`` is the reading half: it opens, configures and reads until cancelled. The
daemon feeds every emitted chunk to a fresh decoder; a replay does the same with recorded chunks.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from jointfit_daemon.model import Chunk
from jointfit_daemon.nearest_name import unknown_name

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, TickClock

ENTRY_POINT_GROUP = "jointfit.drivers"

Emit = Callable[[Chunk], None]
"""Hands one chunk to the daemon. Synchronous; what it raises is a bug and must reach the caller."""

Wire = Literal["stream", "datagram", "can"]
"""How chunks are cut: any cut of a byte stream, one datagram each, or runs of CAN records."""


SLOWEST_BAUD, FASTEST_BAUD = 300, 12_000_000
"""Speeds of serial ports, baud; no adapter is faster."""


class DeviceLostError(Exception):
    """The device is absent, taken, unplugged or silent: worth another try."""


class DeviceMisconfiguredError(Exception):
    """The device cannot work with these settings: the message says what to change.

    The source is stopped until another device is on its port, for a minute, or until a reload.
    Whatever may pass by itself (a port taken, no descriptor left, a bus that is down) is a
    ``DeviceLostError``.
    """


class Settings(BaseModel):
    """Base of every table a driver reads from rig.toml: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


_SLCAN_BITRATES = (
    10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000,
)  # fmt: skip
_LONGEST_INTERFACE = 15  # bytes: IFNAMSIZ of the kernel, less its NUL
INTERFACE_NAME_EXPECTED = (
    "expected the name of a network interface, as `ip link` shows it: up to "
    f"{_LONGEST_INTERFACE} bytes without slash or space"
)


def is_interface_name(name: str) -> bool:
    """Return whether the kernel allows `name` for a network interface."""
    if name in {"", ".", ".."} or any(letter in "/:" or letter.isspace() for letter in name):
        return False
    return len(name.encode()) <= _LONGEST_INTERFACE


class CanBusSettings(Settings):
    """One ``[can.NAME]`` table: a bus that several devices may share."""

    # Further keys go to python-can as they are.
    model_config = ConfigDict(frozen=True, extra="allow")

    interface: str = Field(
        "socketcan", description="python-can interface, or `slcan` (our own codec)"
    )
    channel: str = Field(description="`can0`, or the serial port of an SLCAN adapter")
    bitrate: int = Field(
        1_000_000, ge=10_000, le=1_000_000, description="bit/s; ignored where the kernel set it"
    )
    baud: int = Field(
        115_200,
        ge=SLOWEST_BAUD,
        le=FASTEST_BAUD,
        description="speed of an SLCAN adapter's serial port, baud",
    )
    transport: Literal["usb", "uart"] = Field(
        "usb",
        description="what an SLCAN adapter's port is: on `usb` bytes take no time, whatever `baud` "
        "says; on a real `uart` stamps are back-dated by the bytes that came, at `baud`",
    )

    @field_validator("channel")
    @classmethod
    def _channel_that_can_exist(cls, channel: str, info: ValidationInfo) -> str:
        """Refuse what no kernel interface can be called."""
        if not channel:
            raise ValueError("must not be empty")
        if info.data.get("interface") == "socketcan" and not is_interface_name(channel):
            raise ValueError(
                f'{INTERFACE_NAME_EXPECTED}; a serial adapter needs interface = "slcan"'
            )
        return channel

    @field_validator("bitrate")
    @classmethod
    def _bitrate_of_the_adapter(cls, bitrate: int, info: ValidationInfo) -> int:
        """Refuse what an SLCAN adapter has no command for."""
        if info.data.get("interface") == "slcan" and bitrate not in _SLCAN_BITRATES:
            known = ", ".join(map(str, _SLCAN_BITRATES))
            raise ValueError(f"no such bit rate in SLCAN: expected one of {known}")
        return bitrate


class ImuSettings(Settings):
    """Keys that every ``[[imu]]`` table has; a driver's ``Settings`` derives from this."""

    id: str = Field(description="name of the sensor; becomes an MQTT topic")
    segment: str = Field(description="the segment of [chain] it is worn on")
    driver: str = Field(description="driver name, as `jointfit check` lists them")
    rate_hz: float = Field(100.0, gt=0, le=2000, description="samples per second asked of it")
    silence_s: float = Field(1.0, gt=0, description="no byte for this long is a lost device")
    least_delay_ms: tuple[float, float] | None = Field(
        None,
        description="smallest delay from measuring to arrival and its standard deviation, ms; by "
        "default that of the transport",
    )
    lag_ms: float | None = Field(
        None,
        ge=-1000,
        le=1000,
        description="stamp of this sensor minus that of the cameras for the same event, ms, where "
        "it is known: it is used as it is, and the motion only checks it",
    )
    lag_sd_ms: float = Field(0.1, gt=0, le=100, description="standard deviation of `lag_ms`, ms")

    @property
    def serial_bits_per_s(self) -> float | None:
        """What its samples need of a serial line of its own at `baud`; None: no limit is known."""
        return None

    @property
    def can_frames(self) -> tuple[tuple[int, bool], ...]:
        """Frames of one sample on a CAN bus: data bytes, and whether its identifier has 29 bit."""
        return ()


class MocapSettings(Settings):
    """Keys that every ``[mocap]`` table has; a driver's ``Settings`` derives from this."""

    driver: str = Field(description="driver name")
    up_axis: Literal["x", "y", "z"] = Field("y", description="the stream's up axis")
    markers: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, description="markers of each segment, at least three, not on a line"
    )
    rigid_body: dict[str, str] = Field(
        default_factory=dict, description="rigid body of each segment, instead of markers"
    )
    plate: str | None = Field(
        None, description="rigid body of the plate that carries the sensors in the align phase"
    )
    silence_s: float = Field(1.0, gt=0, description="no datagram for this long is a lost server")
    least_delay_ms: tuple[float, float] | None = Field(
        None,
        description="smallest delay from exposure to arrival and its standard deviation, ms; for "
        "servers that answer no echoes",
    )
    sync_line: int | None = Field(
        None, description="the sync line that carries an edge at every exposure, if one is wired"
    )


def device_path(settings: object) -> str | None:
    """Return what a driver with `settings` opens: its `port`, or the channel of its bus.

    None where the table names neither, as that of a network device.
    """
    found = getattr(settings, "port", None) or getattr(
        getattr(settings, "can", None), "channel", None
    )
    return found if isinstance(found, str) else None


class Decoder(Protocol):
    """The pure half of a driver. Never raises on input.

    One that decodes frames it does not hand on counts them, so that none is lost unseen:
    ``unpublished`` (nobody has said yet what is in them), ``duplicates``, ``late``, all int.
    """

    @property
    def tick_clock(self) -> TickClock | None:
        """How the device counts time, as far as known yet."""

    @property
    def messages(self) -> int:
        """Well-formed messages of any kind so far."""

    @property
    def discarded_bytes(self) -> int:
        """Bytes that belong to no message so far."""

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return what `chunk` completed, in wire order."""

    def flush(self) -> list[Decoded]:
        """Give up waiting for the rest of a pending message: end of input, or silence."""


class Driver(Protocol):
    """A driver class as an entry point names it."""

    Settings: ClassVar[type[Any]]
    """Pydantic model of its rig.toml table; derives from ImuSettings or MocapSettings."""
    wire: ClassVar[Wire]

    def __init__(self, settings: Any) -> None: ...

    def decoder(self) -> Decoder:
        """Return a fresh decoder."""

    async def run(self, emit: Emit) -> None:
        """Open, configure, read until cancelled; raise DeviceLostError or DeviceMisconfiguredError.

        Called again, on the same object, for every further attempt.
        """


class UnknownDriverError(LookupError):
    """No installed package registers a driver of this name."""


def driver_names() -> list[str]:
    """Return the names of all registered drivers, without importing any."""
    return sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)})


def find_driver(name: str) -> type[Driver]:
    """Return the driver class registered as `name`; only its own module is imported.

    Raises
    ------
    UnknownDriverError
        Nothing registers that name; the message gives the nearest spelling and the choices.
    """
    found = [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name == name]
    if not found:
        raise UnknownDriverError(unknown_name("driver", name, driver_names()))
    return cast("type[Driver]", found[0].load())
