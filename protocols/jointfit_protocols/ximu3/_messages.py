r"""Messages of an x-IMU3. Each message is a line that ends with LF.

    { "key": value }                         command of the host, or reply of the device
    ^ | channel | message                    message of another device, through a multiplexer
    Q,<time, us>,<number>,...,<number>\r\n   data in ASCII; the letter is the kind
    D1 | time U8, us | float32 ... | 0A      data in binary; the kind is the letter | 0x80

U8 is an unsigned integer of 8 bytes. Numbers are little-endian. In data messages, the bytes 0A and
DB before the terminator are sent as DB DC and DB DD. There is no checksum. Kind, length and escapes
are the only checks.

Source: x-IMU3-Software of x-io Technologies (MIT), API 1.9.
"""

from __future__ import annotations

import json
import re
import struct
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, NoReturn

if TYPE_CHECKING:
    from collections.abc import Sequence

TICK_NS = 1000
"""Unit of device time, ns."""
BASE_RATE_HZ = 400
"""Base rate, Hz. Every rate of orientations and inertial messages is the base rate divided by an
integer."""
TERMINATOR = 0x0A
ESCAPE = 0xDB
MULTIPLEXER = 0x5E
OBJECT = 0x7B
"""First byte of a command or reply, which is an opening brace."""
MOST_CHANNELS = 3
"""Largest number of multiplexers in series. A message that passed through more of them counts as
corrupt."""
_BINARY = 0x80
_HEAD = struct.Struct("<BQ")
_TICKS = 1 << 64
_PLAUSIBLE_TICKS = 1 << 52
"""Device time below which a message inside a corrupt line is accepted, us, equal to 142 years."""


class DataKind(StrEnum):
    """Kind of a data message, as a letter."""

    QUATERNION = "Q"
    """Quaternion w x y z."""
    MATRIX = "R"
    """Rotation matrix, row by row: xx xy xz yx yy yz zx zy zz."""
    EULER = "A"
    """Roll, pitch, yaw, deg: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    LINEAR_ACCELERATION = "L"
    """Linear acceleration x y z in sensor axes, g; older firmware appends it to a quaternion."""
    EARTH_ACCELERATION = "E"
    """Linear acceleration x y z in the world, g; older firmware appends it to a quaternion."""
    INERTIAL = "I"
    """Angular rate x y z, deg/s; specific force x y z, g."""
    MAGNETIC = "M"
    """Magnetic field x y z, in units of the earth's field."""
    HIGH_G = "H"
    """Specific force x y z, g."""
    SYNC = "Y"
    """Edge on the sync input: 1 rising, 0 falling."""
    TEMPERATURE = "T"
    """Temperature, °C."""
    BATTERY = "B"
    """Battery: charge, percent; voltage, V; state of charging."""
    RSSI = "W"
    """Wi-Fi: signal strength, percent; power, dBm."""
    BUTTON = "O"
    """State of the button: 1 pressed, 0 released."""
    STATUS = "U"
    """State of the orientation filter, as text."""
    NOTIFICATION = "N"
    ERROR = "F"
    ACCESSORY = "S"
    """Bytes that an accessory sends on the serial port of the device."""
    TIMECODE = "C"
    """Linear timecode, as text."""


COUNTS: dict[str, tuple[int, ...]] = {
    DataKind.QUATERNION: (4,), DataKind.MATRIX: (9,), DataKind.EULER: (3,),
    DataKind.LINEAR_ACCELERATION: (3, 7), DataKind.EARTH_ACCELERATION: (3, 7),
    DataKind.INERTIAL: (6,), DataKind.MAGNETIC: (3,), DataKind.HIGH_G: (3,),
    DataKind.SYNC: (1,), DataKind.TEMPERATURE: (1,), DataKind.BATTERY: (3,),
    DataKind.RSSI: (2,), DataKind.BUTTON: (1,),
}  # fmt: skip
"""Permitted numbers of values for each kind. The other kinds contain text."""
LAYOUTS: dict[tuple[int, int], tuple[DataKind, struct.Struct]] = {
    (ord(kind) | _BINARY, _HEAD.size + 4 * count + 1): (
        DataKind(kind), struct.Struct(f"<xQ{count}fx"),
    )
    for kind, counts in COUNTS.items() for count in counts
}  # fmt: skip
"""Kind and layout of binary data messages, by their first byte and length without escapes."""
_TEXTS = {ord(kind): kind for kind in DataKind if kind not in COUNTS}
_KINDS = {ord(kind): kind for kind in DataKind}
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_LETTERS = range(ord("A"), ord("Z") + 1)
_UNKNOWN_ASCII = re.compile(rb"[A-Z],\d{1,16},[^,\r]", re.ASCII)
_MOST_DIGITS = 20
"""Number of digits of the largest time."""


class XImu3Data(NamedTuple):
    """One data message."""

    kind: DataKind
    ticks: int
    """Device time, us."""
    values: tuple[float, ...]
    """Numbers in the order and units of `DataKind`; empty for text."""
    text: bytes = b""
    binary: bool = True
    size: int = 0
    """Length of the message on the wire, bytes."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the terminator. Drivers compute the
    arrival time of the first byte from this number."""
    channel: int | None = None
    """Channel of the multiplexer; None for a message of the device itself."""


class XImu3Reply(NamedTuple):
    """A reply of the device or a command of the host. Both have the same form."""

    key: str
    value: object
    """Current value; None in a command that reads the value."""
    error: str | None = None
    """Reason why the device refused the command."""
    size: int = 0
    end: int = 0
    channel: int | None = None


class MessageFault(NamedTuple):
    """Reason why a line is not a message."""

    reason: str


Line = XImu3Data | XImu3Reply | MessageFault
UNKNOWN = MessageFault("no known message")
UNKNOWN_KIND = "message of unknown kind "
"""Beginning of the reason for a line that has the form of a data message but unknown content."""
_JSON = MessageFault("JSON with other than one key, or malformed")
_STUFFING = MessageFault("escape byte without DC or DD after it")
_LENGTH = MessageFault("binary message of another length")
_ASCII = MessageFault("malformed ASCII message")
_CHANNELS = MessageFault("message of a multiplexer malformed")


def parse_line(line: bytes, end: int = 0) -> Line:
    """Return the message in a line that ends with LF, or the reason why there is none.

    Parameters
    ----------
    line : bytes
        One line on the wire, including its terminator.
    end : int
        Number of bytes fed until the end of the terminator.
    """
    channel, at = None, 0
    while line[at] == MULTIPLEXER:
        if len(line) < at + 4 or at == 2 * MOST_CHANNELS:
            return _CHANNELS
        channel, at = line[at + 1], at + 2

    inner = line[at:] if at else line
    if inner[0] == OBJECT:
        return _parse_reply(inner, len(line), end, channel)
    if ESCAPE in inner:
        plain = unstuff(inner)
        return _STUFFING if plain is None else _parse_data(plain, len(line), end, channel)
    return _parse_data(inner, len(line), end, channel)


def parse_rest(rest: bytes, end: int) -> XImu3Data | XImu3Reply | None:
    """Return the message that the end of a corrupt line contains; None if there is none.

    The rules are stricter than those of `parse_line`, in order to prevent accidental matches. Text
    and multiplexers are rejected, and the time must be plausible. An object must have no blank
    before its key, which also limits the time to search a line of many braces.
    """
    if rest[0] == OBJECT:
        if not rest.startswith(b'{"'):
            return None
    elif rest[0] & 0x7F not in _KINDS:
        return None
    if (rest[0] & 0x7F) in _TEXTS:
        return None
    found = parse_line(rest, end)
    if isinstance(found, XImu3Data):
        return found if found.ticks < _PLAUSIBLE_TICKS else None
    return found if isinstance(found, XImu3Reply) else None


def unstuff(line: bytes) -> bytes | None:
    """Return the bytes of a message without escapes; None if an escape is malformed."""
    plain = line.replace(b"\xdb\xdc", b"\n").replace(b"\xdb\xdd", b"\xdb")
    # Each escape that is followed by its second byte makes the line one byte shorter.
    return plain if len(line) - len(plain) == line.count(ESCAPE) else None


def _parse_data(plain: bytes, size: int, end: int, channel: int | None) -> Line:
    first = plain[0]
    if not first & _BINARY:
        return _parse_ascii(plain, size, end, channel)

    layout = LAYOUTS.get((first, len(plain)))
    if layout is not None:
        read = layout[1].unpack(plain)
        return XImu3Data(layout[0], read[0], read[1:], b"", True, size, end, channel)

    kind = _TEXTS.get(first ^ _BINARY)
    if kind is None:
        return _unknown_binary(plain)
    if len(plain) <= _HEAD.size:
        return _LENGTH
    _, ticks = _HEAD.unpack_from(plain)
    return XImu3Data(kind, ticks, (), plain[_HEAD.size : -1], True, size, end, channel)


def _unknown_binary(plain: bytes) -> MessageFault:
    """Return the reason for a binary line of unknown layout, which newer firmware may send."""
    letter, values = plain[0] ^ _BINARY, (len(plain) - _HEAD.size - 1) / 4
    plausible = values >= 1 and values.is_integer()
    if plausible and letter in _LETTERS and _HEAD.unpack_from(plain)[1] < _PLAUSIBLE_TICKS:
        return MessageFault(f"{UNKNOWN_KIND}{letter:c} with {values:.0f} values")
    return _LENGTH if letter in _KINDS else UNKNOWN


def _parse_ascii(plain: bytes, size: int, end: int, channel: int | None) -> Line:
    kind = _KINDS.get(plain[0])
    if kind is None:
        form = _UNKNOWN_ASCII.match(plain)
        return UNKNOWN if form is None else MessageFault(f"{UNKNOWN_KIND}{plain[0]:c}")
    name, _, rest = plain.rstrip(b"\r\n").partition(b",")
    time, comma, content = rest.partition(b",")
    if len(name) != 1 or not time.isdigit() or not comma or len(time) > _MOST_DIGITS:
        return _ASCII
    ticks = int(time)
    if ticks >= _TICKS:
        return _ASCII
    if kind not in COUNTS:
        return XImu3Data(kind, ticks, (), content, False, size, end, channel)

    numbers = content.split(b",")
    if len(numbers) not in COUNTS[kind] or not all(map(_NUMBER.fullmatch, numbers)):
        return _ASCII
    values = tuple(map(float, numbers))
    return XImu3Data(kind, ticks, values, b"", False, size, end, channel)


def _parse_reply(inner: bytes, size: int, end: int, channel: int | None) -> Line:
    try:
        pairs = json.loads(inner, object_pairs_hook=_pairs, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):  # not JSON, not UTF-8, or nested too deeply
        return _JSON
    if not isinstance(pairs, _Pairs) or len(pairs) != 1:
        return _JSON
    key, value = pairs[0]
    plain = _plain(value)
    error = None
    if isinstance(plain, dict) and isinstance(plain.get("error"), str):
        error = plain["error"]
    return XImu3Reply(key, plain, error, size, end, channel)


class _Pairs(list[tuple[str, object]]):
    """Members of a JSON object. A dict would lose repeated keys."""


def _pairs(members: list[tuple[str, object]]) -> _Pairs:
    return _Pairs(members)


def _plain(value: object) -> object:
    if isinstance(value, _Pairs):
        return {key: _plain(inner) for key, inner in value}
    return [_plain(inner) for inner in value] if isinstance(value, list) else value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def encode_command(key: str, value: object = None) -> bytes:
    """Return a command or reply on the wire.

    A command without a value reads a setting or starts an action.

    Raises
    ------
    ValueError
        `value` cannot be represented in JSON.
    """
    text = json.dumps({key: value}, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def encode_data(
    kind: str, ticks: int, values: Sequence[float], *, binary: bool = True, decimals: int = 4
) -> bytes:
    """Return the bytes of a data message with numbers on the wire.

    Parameters
    ----------
    kind : str
        Letter of the kind; see `DataKind`.
    ticks : int
        Device time, us.
    values : sequence of float
        Values in the units of the kind. Their number must be permitted for the kind.
    binary : bool
        Whether the message is binary (float32) or ASCII.
    decimals : int
        Number of decimals in ASCII.

    Raises
    ------
    ValueError
        The kind does not have this number of values.
    """
    if len(values) not in COUNTS.get(kind, ()):
        raise ValueError(f"{len(values)} values in a message of kind {kind}")
    if not binary:
        numbers = ",".join(f"{value:.{decimals}f}" for value in values)
        return f"{DataKind(kind)},{ticks},{numbers}\r\n".encode()
    return _stuff(_HEAD.pack(ord(kind) | _BINARY, ticks) + struct.pack(f"<{len(values)}f", *values))


def encode_text(kind: str, ticks: int, text: bytes, *, binary: bool = True) -> bytes:
    """Return the bytes of a data message with text on the wire.

    Raises
    ------
    ValueError
        Messages of this kind contain numbers instead of text.
    """
    if kind in COUNTS:
        raise ValueError(f"a message of kind {kind} has numbers, not text")
    if binary:
        return _stuff(_HEAD.pack(ord(kind) | _BINARY, ticks) + text)
    return _stuff(f"{DataKind(kind)},{ticks},".encode() + text + b"\r")


def encode_multiplexed(channel: int, message: bytes) -> bytes:
    """Return a message of another device in the form in which a multiplexer passes it on."""
    return bytes((MULTIPLEXER, channel)) + message


def _stuff(plain: bytes) -> bytes:
    return plain.replace(b"\xdb", b"\xdb\xdd").replace(b"\n", b"\xdb\xdc") + b"\n"
