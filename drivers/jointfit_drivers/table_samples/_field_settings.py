"""Keys of ``fields`` in the ``[[imu]]`` table of a device that the table describes."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from jointfit_daemon.driver import Settings
from jointfit_drivers.gateway_orientation import GatewaySettings
from jointfit_protocols.table import WIDTHS, Checksum, ChecksumKind

_MOST_BYTES = 4095
"""Largest offset of a field in a frame, bytes."""


def check_hexadecimal(text: str) -> str:
    """Return `text` unchanged if it contains bytes in hexadecimal.

    Raises
    ------
    ValueError
        The text contains something else.
    """
    try:
        bytes.fromhex(text)
    except ValueError:
        raise ValueError('expected bytes in hexadecimal, such as "AA 55"') from None
    return text


class FieldSettings(Settings):
    """One quantity, or some of its components: place, type, scale and unit."""

    order: str | None = Field(
        None,
        description='components in the order of sending; default: "wxyz", or "xyz" for vectors',
        examples=["wxyz"],
    )
    offset: Annotated[int, Field(ge=0, le=_MOST_BYTES)] | tuple[int, ...] | None = Field(
        None,
        description="first byte in the frame, from 0, of components that follow each other; or a "
        "list with the first byte of each component",
    )
    bit: int = Field(
        0,
        ge=0,
        le=63,
        description="first bit after `offset`: counted from the least significant bit if "
        "little-endian, from the most significant bit if big-endian",
    )
    type: str | None = Field(
        None,
        description="u1 to u64, i2 to i64 (any number of bits), f16, f32 or f64",
        examples=["i16"],
    )
    byte_order: Literal["little", "big"] | None = Field(
        None, description="default: `byte_order` of the table"
    )
    scale: float | None = Field(
        None, description="value of one count, in `unit`; default: 1", examples=[0.0001]
    )
    divisor: float | None = Field(None, gt=0, description="counts per unit, instead of `scale`")
    zero: float = Field(0.0, description="value of the count 0, in `unit`")
    unit: str | None = Field(
        None,
        description="for rate: rad/s, deg/s, mdeg/s, mrad/s; for acceleration: m/s2, g, mg; for "
        "time: s, ms, 100us, us, ns",
    )
    modulus: int | None = Field(
        None,
        gt=1,
        description="for time and counter: number of values before they begin at 0 again; "
        "default: number of values of an integer type; in text lines 2^32 for a time in us or ms; "
        "otherwise the values never begin again",
    )
    mask: int | None = Field(None, gt=0, description="for valid: bits that are evaluated")
    equals: int | None = Field(
        None, description="for valid: value of these bits in a valid sample; default: any but 0"
    )


def as_parts(value: Any) -> Any:
    """Return `value` as an array, because a quantity may be sent in several parts.

    Arrays are converted to tuples, because pydantic does not know at this point that they come from
    JSON.
    """
    if isinstance(value, (list, tuple)):
        return tuple(as_parts(each)[0] if isinstance(each, dict) else each for each in value)
    if not isinstance(value, dict):
        return value
    part = {key: tuple(each) if isinstance(each, list) else each for key, each in value.items()}
    return (part,)


def parts_of(field: type[Settings]) -> BeforeValidator:
    """Return the validator of a quantity, which accepts one table or an array of tables."""
    either = field | tuple[field, ...]  # type: ignore[valid-type]  # a type at run time
    return BeforeValidator(as_parts, json_schema_input_type=either)


class ChecksumSettings(Settings):
    """Checksum of a frame or line."""

    kind: ChecksumKind = Field(description=f"one of {', '.join(WIDTHS)}", examples=["sum8"])
    first: int = Field(
        0,
        ge=0,
        description="first byte of the frame that the checksum includes; the last one is the byte "
        "before the checksum",
    )
    byte_order: Literal["little", "big"] | None = Field(
        None,
        description="default: `byte_order` of the table. For fletcher16, `little` means that the "
        "plain sum comes first",
    )
    polynomial: int | None = Field(
        None,
        gt=0,
        description="polynomial of a CRC, not reflected; default: 0x07, 0x1021 or 0x04C11DB7",
    )
    init: int = Field(0, ge=0, description="initial value")
    reflected: bool = Field(False, description="for a CRC: process the least significant bit first")
    xor_out: int = Field(0, ge=0, description="value that is combined with the result by XOR")
    modulus: Literal[255, 256] = Field(256, description="modulus of fletcher16")

    def checksum(self, byte_order: Literal["little", "big"]) -> Checksum:
        """Return the parameters of the checksum; `byte_order` is the default of its byte order."""
        keys = self.model_dump()
        return Checksum(**keys | {"byte_order": self.byte_order or byte_order})

    def faults(self) -> list[tuple[str, str]]:
        """Return the keys whose values exceed the width of the checksum, each with its fault."""
        if None in (self.kind, self.init, self.xor_out):
            return []
        most = 1 << 8 * WIDTHS[self.kind]
        return [
            (name, f"0x{value:X} does not fit {self.kind}: expected less than 0x{most:X}")
            for name in ("polynomial", "init", "xor_out")
            if (value := getattr(self, name)) is not None and value >= most
        ]


class TableImuSettings(GatewaySettings):
    """Common keys of all devices that a table describes."""

    byte_order: Literal["little", "big"] = Field(
        "little", description="byte order of fields without a `byte_order` of their own"
    )
    world: Literal["ENU", "NED", "NWU"] = Field(
        "ENU",
        description="directions of the x, y and z axes of the device's world: E east, N north, W "
        "west, U up, D down",
    )
    direction: Literal["sensor_to_world", "world_to_sensor"] = Field(
        "sensor_to_world",
        description="whether the quaternion maps sensor to world coordinates, or the reverse",
    )
